"""The files of an agent: whole, checked, and never executed."""

import hashlib
import json
import pickle

import pytest
import torch
from safetensors.torch import save

from torchrl_tit.agents import AgentError, load_agent
from torchrl_tit.agents.folder import CARD, CONTENTS, MANIFEST, WEIGHTS, read_agent, write_agent
from torchrl_tit.agents.loading import find_agent

WEIGHT = torch.tensor([1.0, 2.0])
EVALUATION = {
    **{"env": "CartPole-v1", "episodes": 1, "seed": 1, "steps": 5},
    **{"returns": [9], "mean": 9, "std": 0},
}
FILES = {
    "recipe.json": b'{"seed": 1}',
    "versions.json": b'{"torch": 1}',
    "evaluation.json": json.dumps(EVALUATION).encode(),
    CARD: "# Ä\n".encode(),
    WEIGHTS: save({"weight": WEIGHT}),
}


def evaluation(**changes):
    return json.dumps({**EVALUATION, **changes}).encode()


@pytest.fixture
def agent(tmp_path):
    write_agent(tmp_path / "agent", FILES, steps=7)
    return tmp_path / "agent"


def with_manifest(agent, **changes):
    """Rewrites the manifest, with a checksum that fits it."""
    manifest = {**json.loads((agent / MANIFEST).read_text()), **changes}
    manifest.pop("sha256")
    manifest["sha256"] = hashlib.sha256(json.dumps(manifest).encode()).hexdigest()
    (agent / MANIFEST).write_text(json.dumps(manifest))


def test_round_trip(agent, tmp_path):
    assert {path.name for path in agent.iterdir()} == {*CONTENTS, MANIFEST}
    files = read_agent(agent)
    assert (files.folder, files.steps) == (agent, 7)
    assert (files.evaluation, files.versions) == (EVALUATION, {"torch": 1})
    assert files.recipe == FILES["recipe.json"]
    assert files.weights.keys() == {"weight"}
    assert torch.equal(files.weights["weight"], WEIGHT)
    listed = json.loads((agent / MANIFEST).read_text())["files"]
    for name in CONTENTS:  # as `sha256sum` prints it
        assert listed[name]["sha256"] == hashlib.sha256((agent / name).read_bytes()).hexdigest()


@pytest.mark.parametrize("name", [*CONTENTS, MANIFEST])
def test_a_file_that_was_changed(agent, name):
    content = (agent / name).read_bytes()
    changed = content.replace(b"# ", b"##").replace(b"1", b"2").replace(b"[0,8]", b"[8,0]")
    assert len(changed) == len(content)
    assert changed != content
    (agent / name).write_bytes(changed)
    with pytest.raises(AgentError, match=rf"cannot be used: ({name} was changed|it has version 2)"):
        load_agent(agent)
    (agent / name).unlink()
    with pytest.raises(AgentError, match=rf"{name} is missing|no {name}"):
        read_agent(agent)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"format": "other"}, "does not say that it is a torchrl-tit agent"),
        ({"version": 2}, "it has version 2, and this torchrl-tit reads 1"),
        ({"files": {}}, "agent.json does not list README.md"),
        ({"files": []}, r"agent.json is not an agent's: Expected `object`.* at `\$.files`"),
        (
            {"files": dict.fromkeys(CONTENTS, "x")},
            "agent.json is not an agent's: Expected `object`",
        ),
        ({"steps": "many"}, r"agent.json is not an agent's: Expected `int`.* at `\$.steps`"),
        ({"steps": float("inf")}, "agent.json is not an agent's: Expected `int`"),
        ({"steps": -1}, "agent.json is not an agent's: Expected `int` >= 0"),
    ],
)
def test_manifests_of_others(agent, changes, reason):
    with_manifest(agent, **changes)
    with pytest.raises(AgentError, match=reason):
        read_agent(agent)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        (WEIGHTS, pickle.dumps(print), "model.safetensors is not a file of safetensors"),
        ("evaluation.json", b"[]", "evaluation.json is not a JSON object"),
        ("evaluation.json", b'{"env": "CartPole-v1"}', "missing required field `episodes`"),
        ("evaluation.json", evaluation(returns=[]), "does not have a return for each of its 'epi"),
        ("versions.json", b"[" * 10_000, "versions.json is not valid JSON"),
    ],
)
def test_files_of_another_kind(tmp_path, name, content, reason):
    write_agent(tmp_path / "agent", {**FILES, name: content}, steps=7)
    with pytest.raises(AgentError, match=reason):
        read_agent(tmp_path / "agent")


def test_a_file_that_would_fill_the_memory(agent):
    with (agent / MANIFEST).open("wb") as file:
        file.truncate(10**12)  # takes no space
    with pytest.raises(AgentError, match=r"agent.json has 1000000000000 bytes, more than"):
        read_agent(agent)


def test_other_files_are_not_read(agent):
    (agent / "policy.pkl").write_bytes(b"cos\nabort\n(tR.")
    (agent / "__init__.py").write_text("raise SystemExit\n")
    assert read_agent(agent).steps == 7


def test_nothing_is_left_of_a_folder_that_cannot_be_written(agent, tmp_path, monkeypatch):
    with pytest.raises(FileExistsError, match="exists already"):
        write_agent(agent, FILES, steps=8)
    assert read_agent(agent).steps == 7
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        write_agent(tmp_path / "missing" / "agent", FILES, steps=7)

    def full(*arguments):
        raise OSError(28, "no space left on device")

    monkeypatch.setattr("torchrl_tit.files.fsync_file", full)
    with pytest.raises(OSError, match="no space left"):
        write_agent(tmp_path / "half", FILES, steps=7)
    assert list(tmp_path.iterdir()) == [agent]


def test_names_that_do_not_exist(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for source in ("cartpol", "some/folder", ""):
        with pytest.raises(AgentError, match=f"no agent or folder '{source}'|neither an agent"):
            load_agent(source)
    with pytest.raises(AgentError, match="did you mean cartpole"):
        load_agent("cartpol")
    (tmp_path / "empty").mkdir()
    with pytest.raises(AgentError, match="empty is neither an agent nor a run"):
        load_agent("empty")
    (tmp_path / "cartpole").mkdir()  # a name of ours goes before a folder
    assert find_agent("cartpole") != tmp_path / "cartpole"
    with pytest.raises(AgentError, match="neither an agent nor a run"):
        find_agent("./cartpole")

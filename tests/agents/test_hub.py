"""Agents in repositories of the Hugging Face Hub, on a stand-in for it."""

import sys
from typing import Any

import huggingface_hub
import pytest
from huggingface_hub import errors

from recipes.cli import main
from recipes.core.numbers import plus_minus
from tests.agents.hub import LocalHub
from tests.agents.runs import make_run
from tests.recipes.commands import fails
from torchrl_tit.agents import AgentError, load_agent
from torchrl_tit.agents.folder import CARD, CONTENTS, MANIFEST, WEIGHTS


@pytest.fixture
def hub(tmp_path, monkeypatch):
    stand_in = LocalHub(tmp_path / "hub")
    stand_in.install(monkeypatch)
    return stand_in


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("runs") / "run")


def test_upload_and_download(hub, run, tmp_path, capsys):
    out = tmp_path / "kept"
    main(["share", str(run), "me/cart-pole", "--out", str(out), "--private", "--license", "mit"])
    printed = capsys.readouterr().out
    assert f"written to {out}" in printed
    assert "uploaded to https://hub/me/cart-pole/commit/1\n" in printed
    assert "load_agent('hf:me/cart-pole') loads it" in printed
    assert hub.private == {"me/cart-pole": True}
    assert {path.name for path in out.iterdir()} == {*CONTENTS, MANIFEST}
    uploaded = hub.commits["me/cart-pole"][-1]
    assert uploaded == {".gitattributes": hub.commits["me/cart-pole"][0][".gitattributes"]} | {
        path.name: path.read_bytes() for path in out.iterdir()
    }

    agent = load_agent("hf:me/cart-pole")
    assert agent.name == "hf:me/cart-pole"
    assert agent.evaluate().tolist() == agent.evaluation["returns"]
    main(["play", "hf:me/cart-pole@1", "--episodes", "1"])
    assert capsys.readouterr().out.startswith("hf:me/cart-pole@1: return ")


def test_the_card_has_metadata_that_the_hub_reads(hub, run):
    main(["share", str(run), "me/small", "--license", "mit"])
    card: Any = huggingface_hub.ModelCard(hub.commits["me/small"][-1][CARD].decode())
    data = card.data.to_dict()
    assert (data["library_name"], data["license"]) == ("torchrl-tit", "mit")
    assert {"reinforcement-learning", "CartPole-v1", "ppo"} <= {*data["tags"]}
    [result] = card.data.eval_results
    evaluation = load_agent("hf:me/small").evaluation
    assert result.metric_value == f"{evaluation['mean']:.2f} +/- {evaluation['std']:.2f}"
    assert (result.metric_type, result.dataset_name) == ("mean_reward", "CartPole-v1")
    assert 'load_agent("hf:me/small")' in card.text
    assert f"**{plus_minus(evaluation['mean'], evaluation['std'])}**" in card.text
    assert "(5 to 7)" in card.text  # the seeds of three episodes


def test_an_agent_is_shared_as_it_is(hub, run, tmp_path, capsys):
    main(["share", str(run), "--out", str(tmp_path / "agent")])
    main(["share", str(tmp_path / "agent"), "me/again"])
    files = {path.name: path.read_bytes() for path in (tmp_path / "agent").iterdir()}
    assert files.items() <= hub.commits["me/again"][-1].items()
    assert "is an agent already" in fails(
        capsys, "share", tmp_path / "agent", "--out", tmp_path / "b"
    )
    (tmp_path / "agent" / CARD).write_text("another")
    assert f"{CARD} was changed" in fails(capsys, "share", tmp_path / "agent", "me/changed")
    assert "me/changed" not in hub.commits


def test_what_was_changed_on_the_hub(hub, run):
    main(["share", str(run), "me/small"])
    last = hub.commits["me/small"][-1]
    hub.commits["me/small"] += [{**last, CARD: b"edited"}, {**last, WEIGHTS: b"else"}, {}]
    for revision, reason in ((2, f"{CARD} was changed"), (3, f"{WEIGHTS} was changed")):
        with pytest.raises(AgentError, match=reason):
            load_agent(f"hf:me/small@{revision}")
    with pytest.raises(AgentError, match=r"not an agent: the repository holds no agent\.json"):
        load_agent("hf:me/small")
    assert load_agent("hf:me/small@1").steps == 7


def test_what_the_hub_refuses(hub, run, capsys):
    assert "there is no repository 'me/unknown'" in fails(capsys, "play", "hf:me/unknown")
    main(["share", str(run), "me/small"])
    capsys.readouterr()
    assert "has no revision '9'" in fails(capsys, "play", "hf:me/small@9")
    for name in ("small", "me/small/more", "../small", "me/", ""):
        assert "expected user/name" in fails(capsys, "play", f"hf:{name}")
        assert "expected user/name" in fails(capsys, "share", run, name)
    hub.failure = errors.LocalEntryNotFoundError("cannot reach\nthe Hub")
    assert "is not on this machine yet" in fails(capsys, "play", "hf:me/small")
    hub.failure = RuntimeError("its HTTP client\nhas errors of its own")
    line = fails(capsys, "share", run, "me/other")
    assert "for hf:me/other failed: its HTTP client has errors of its own" in line
    assert "me/other" not in hub.commits


def test_without_huggingface_hub(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "huggingface_hub.errors", None)
    for words in (["play", "hf:me/small"], ["share", run, "--out", tmp_path / "agent"]):
        assert "pip install 'torchrl-tit[share]'" in fails(capsys, *words)
    assert not any(tmp_path.iterdir())

"""Files of policies: what they hold, and that they act without this library."""

import json
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.envs import Compose, TargetReturn

from tests.export.policies import make_policy, program_of, shake
from tests.recipes.ppo import tasks  # noqa: F401 - registers its tasks
from torchrl_tit.envs import make_env
from torchrl_tit.evaluation import evaluate
from torchrl_tit.export import NotTheSameError, export_policy
from torchrl_tit.export import policy as exporting
from torchrl_tit.modules import DTHead, make_dt_actor
from torchrl_tit.networks import DecisionTransformer
from torchrl_tit.settings import LSTM, MLP, Flat, Linear
from torchrl_tit.transforms import SequenceHistory

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


def act(example: str, file: Path, without: tuple[str, ...]) -> str:
    """Runs an example on a file, in a Python that has none of these packages."""
    code = (
        "import runpy, sys\n"
        f"sys.modules.update(dict.fromkeys({without!r}))\n"  # importing them fails
        f"sys.argv = [{example!r}, {str(file)!r}]\n"
        f"runpy.run_path({str(EXAMPLES / example)!r}, run_name='__main__')\n"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=file.parent)
    assert done.returncode == 0, done.stderr
    return done.stdout


OURS = ("torchrl_tit", "recipes", "torchrl", "tensordict")


@pytest.mark.parametrize(
    ("example", "without"), [("act_from_pt2.py", OURS), ("act_from_onnx.py", (*OURS, "torch"))]
)
@pytest.mark.parametrize(("env", "hides"), [("CartPole-v1", True), ("Taxi-v4", False)])
def test_the_examples_play_the_episode_that_the_policy_plays(
    example, without, env, hides, tmp_path
):
    if "onnx" in example:
        pytest.importorskip("onnxruntime")
        pytest.importorskip("onnxscript")
    policy, task = small(env=env, hide_velocities=hides)
    file = tmp_path / f"policy.{example.split('_')[-1].removesuffix('.py')}"
    facts = {"task": {"id": env, "max_episode_steps": 60}}
    said = export_policy(policy, task, file, step_by_step=True, facts=facts)
    assert said["difference"] < 1e-5
    shorter = partial(make_env, env, num_frames=3, hide_velocities=hides)
    returns = evaluate(partial(shorter, max_episode_steps=60), policy, 1, seed=0)
    assert act(example, file, without) == f"return {returns.item():g}\n"
    assert str(Path.cwd()).encode() not in file.read_bytes()  # nothing of this machine
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


def small(**settings):
    return make_policy(frame=Flat(), history=MLP(hidden_dim=4), **settings)


def test_what_a_file_says_and_how_many_it_takes(tmp_path):
    policy, task = small()
    file = tmp_path / "policy.pt2"
    said = export_policy(policy, task, file, sample=True, facts={"recipe": "mine"})
    about = {"torchrl_tit.json": ""}
    program = torch.export.load(file.open("rb"), extra_files=about).module()
    facts = json.loads(about["torchrl_tit.json"])
    assert said == {**facts, "difference": said["difference"]}
    assert facts == {
        "version": 1,
        "inputs": {
            "history": {"shape": [3, 4], "dtype": "float32"},
            "noise": {"shape": [2], "dtype": "float32"},
        },
        "outputs": {
            "action": {"shape": [], "dtype": "int64"},
            "logits": {"shape": [2], "dtype": "float32"},
        },
        "state": [],
        "noise": "gumbel",
        "num_frames": 3,
        "padding": "same",
        "torch": torch.__version__,
        "recipe": "mine",
    }
    for size in (1, 7):
        outputs = program(noise=torch.zeros(size, 2), history=torch.randn(size, 3, 4))
        assert outputs["action"].shape == (size,)


@pytest.mark.parametrize(
    ("num_frames", "settings", "read", "step_by_step"),
    [
        (5, {}, 2, False),  # it can act on fewer steps than it learns from
        (4, {"max_ep_len": 7}, 4, True),  # beyond max_ep_len, it has no time step
        (1, {}, 1, True),  # there are no earlier frames
    ],
)
def test_a_decision_transformer(num_frames, settings, read, step_by_step, tmp_path):
    network = DecisionTransformer((4,), action_dim=2, num_frames=num_frames, **settings)
    policy = make_dt_actor(network, DTHead(network.features_dim, 2, "discrete")).eval()

    def task(copies):
        transforms = TargetReturn(50.0), SequenceHistory(read)
        return make_env("CartPole-v1", copies).append_transform(Compose(*transforms))

    said = export_policy(policy, task, tmp_path / "policy.pt2", step_by_step=step_by_step)
    assert said["difference"] < 1e-5
    if not step_by_step:  # the file says how many steps it reads
        assert said["inputs"]["observation"]["shape"] == [read, 4]
        assert said["num_frames"] == read


def test_actions_of_several_dimensions(tmp_path):
    policy, task = make_policy("BoxActions-v0", Linear(embed_dim=4))
    said = export_policy(policy, task, tmp_path / "policy.pt2", step_by_step=True)
    assert said["outputs"]["action"]["shape"] == [2, 2]


def test_nothing_is_left_of_a_file_that_acts_differently(tmp_path, monkeypatch):
    policy, task = small()

    def damage(program):
        shake(program)
        return trace(program)

    trace = exporting.trace
    monkeypatch.setattr(exporting, "trace", damage)
    with pytest.raises(NotTheSameError, match="expected at most 1e-05, so nothing was written"):
        export_policy(policy, task, tmp_path / "policy.pt2")
    assert not any(tmp_path.iterdir())


def test_an_onnx_file_refuses_what_the_runtime_would_misread(tmp_path):
    """And it passes NaN on, as the live policy does."""
    pytest.importorskip("onnxscript")
    onnxruntime = pytest.importorskip("onnxruntime")
    policy, task = make_policy(
        "MultiDiscreteActions-v0",
        Linear(embed_dim=4),
        LSTM(hidden_dim=4),
        num_frames=1,
        mask_actions=True,
    )
    export_policy(policy, task, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    names = [output.name for output in session.get_outputs()]

    def run(inputs):
        outputs = session.run(names, {name: x.numpy() for name, x in inputs.items()})
        return dict(zip(names, map(torch.from_numpy, outputs), strict=True))

    program = program_of(policy, task)
    given = program.examples(3)
    given["observation_state_0"][1, 0] = torch.nan
    with torch.no_grad():
        live = program(given)
    acted = run(given)
    assert live["logits"].isnan().flatten(1).any(1).tolist() == [False, True, False]
    assert live["next_recurrent_state_c"].isnan().flatten(1).any(1).tolist() == [False, True, False]
    for name, entry in live.items():
        assert torch.equal(acted[name].isnan(), entry.isnan()), name
    for name, entry in given.items():
        with pytest.raises(onnxruntime.capi.onnxruntime_pybind11_state.Fail):
            run({**given, name: entry[:1]})
    with pytest.raises(onnxruntime.capi.onnxruntime_pybind11_state.InvalidArgument):
        run({name: entry[:0] for name, entry in given.items()})

    forbidden = program.examples(1)
    forbidden["action_mask"].zero_()
    with pytest.raises(ValueError, match="allows no action"):
        program(forbidden)
    assert run(forbidden)["action"].tolist() == [[0, 0, 0]]  # a file cannot raise this error


class Determinant(nn.Module):
    """What ONNX has no operator for."""

    def forward(self, x):
        return x + torch.linalg.eigvalsh(x.unsqueeze(-1) * x.unsqueeze(-2))


class Branch(nn.Module):
    """What no program can follow."""

    def forward(self, x):
        return x if x.sum() > 0 else -x


@pytest.mark.parametrize(
    ("layer", "suffix", "message"),
    [
        (Determinant(), "onnx", "ONNX has no operator for aten.* export to .pt2 instead"),
        (Branch(), "pt2", "torch.export cannot trace this policy: Could not guard on data-depend"),
    ],
)
def test_what_cannot_be_expressed(layer, suffix, message, tmp_path):
    if suffix == "onnx":
        pytest.importorskip("onnxscript")
    policy, task = small()
    network = policy.module[0].module
    network.head = nn.Sequential(network.head, layer)
    with pytest.raises(ValueError, match=message) as raised:
        export_policy(policy, task, tmp_path / f"policy.{suffix}")
    assert "\n" not in str(raised.value)
    assert not any(tmp_path.iterdir())


def test_bad_input(tmp_path):
    policy, task = small()
    file = tmp_path / "policy.pt2"
    file.write_bytes(b"mine")
    with pytest.raises(FileExistsError, match="exists already"):
        export_policy(policy, task, file)
    assert file.read_bytes() == b"mine"
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        export_policy(policy, task, tmp_path / "missing" / "policy.pt2")
    with pytest.raises(ValueError, match=r"'policy.txt' tells no format: end it with .pt2 or .on"):
        export_policy(policy, task, tmp_path / "policy.txt")
    headless = TensorDictSequential(policy.module[0])
    with pytest.raises(ValueError, match="writes no 'action'"):
        export_policy(headless, task, tmp_path / "other.pt2")
    assert [path.name for path in tmp_path.iterdir()] == ["policy.pt2"]


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    policy, task = small()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"onnx, onnxscript, onnxruntime: pip install 'torchrl-ti"):
        export_policy(policy, task, tmp_path / "policy.onnx")
    assert not any(tmp_path.iterdir())

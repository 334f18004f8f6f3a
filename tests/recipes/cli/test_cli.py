"""The command line, and recipes as JSON."""

import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_tit
from recipes.cli import main
from recipes.core.recipe_json import recipe_from_json, recipe_to_json, settings_to_dict
from recipes.core.registry import get_recipe
from tests.recipes.commands import Command, fails

SHORT = [
    "--total-steps", "64", "--steps-per-batch", "64", "--minibatch-size", "32", "--epochs", "1",
    "--evaluation-episodes", "2",
]  # fmt: skip


BACKBONE = settings_to_dict(get_recipe("ppo/mlp").backbone)


def test_list_and_show(capsys):
    main(["list", "cql/*-medium-v0/mlp"])
    assert capsys.readouterr().out.split() == [
        f"cql/{task}-medium-v0/mlp" for task in ("halfcheetah", "hopper", "walker2d")
    ]
    main(["list", "PPO/CartPole/MLP"])  # as Gymnasium writes names
    assert capsys.readouterr().out == "ppo/cartpole/mlp\nppo/cartpole/mlp-protocol\n"
    main(["list", "cartpole"])
    names = capsys.readouterr().out.split()
    assert "ppo/cartpole/enhanced-tit" in names
    assert all("cartpole" in name for name in names)
    main(["show", "ppo/cartpole/enhanced-tit"])
    assert json.loads(capsys.readouterr().out)["backbone"]["frame"]["encoder"] == "inner"


def test_train_evaluate_and_resume(capsys, tmp_path):
    run = tmp_path / "run"
    words = ["train", "ppo/cartpole/enhanced-tit", "--out", str(run), "--num-envs", "2"]
    main([*words, "--backbone.frame.embed-dim", "16", "--seed", "3", *SHORT])
    out = capsys.readouterr().out
    assert f"learning curve: {run / 'learning_curve.png'}" in out.splitlines()[-1]
    recipe = json.loads((run / "recipe.json").read_text())
    assert (recipe["seed"], recipe["num_envs"]) == (3, 2)
    assert recipe["backbone"]["frame"]["embed_dim"] == 16

    other = tmp_path / "other.json"
    main(["evaluate", str(run), "--episodes", "3", "--seed", "7", "--out", str(other)])
    evaluation = json.loads(other.read_text())
    assert (evaluation["episodes"], evaluation["seed"], evaluation["steps"]) == (3, 7, 64)
    assert json.loads((run / "evaluation.json").read_text())["episodes"] == 2

    capsys.readouterr()
    main(["train", "--resume", str(run)])  # there is nothing left to do
    assert "complete" in capsys.readouterr().out

    again = tmp_path / "again"  # a run can be started again from its recipe
    main(["train", str(run / "recipe.json"), "--out", str(again)])
    assert json.loads((again / "recipe.json").read_text()) == recipe
    first, second = ((r / "evaluation.json").read_text() for r in (run, again))
    assert first == second

    picture = tmp_path / "comparison.png"
    assert "are the same run" in fails(capsys, "compare", str(run), str(again))
    main(["compare", str(run), "--out", str(picture)])
    assert picture.read_bytes().startswith(b"\x89PNG")

    line = fails(capsys, *words)
    assert "exists already" in line
    assert "--resume" in line

    assert "length is --total-steps, not" in fails(
        capsys, "train", "--resume", str(run), "--total-updates", "128"
    )
    main(["train", "--resume", str(run), "--total-steps", "128"])  # further than it was to go
    assert "decay_learning_rate depends on total_steps" in capsys.readouterr().err
    assert json.loads((run / "recipe.json").read_text()) == {**recipe, "total_steps": 128}
    assert json.loads((run / "evaluation.json").read_text())["steps"] == 128


def test_help_explains_every_field(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["train", "ppo/cartpole/enhanced-tit", "--help"])
    assert exit_.value.code == 0
    out = capsys.readouterr().out
    for option in ("--seed", "--out", "--device", "--threads", "--backbone.frame.embed-dim"):
        assert option in out
    assert "Width D of a token" in out
    assert "\n\nThe defaults are those of the paper" in out  # not indented, as in the source


def test_version(capsys):
    main(["--version"])
    assert capsys.readouterr().out == f"torchrl-tit {torchrl_tit.__version__}\n"
    assert torchrl_tit.__version__ == importlib.metadata.version("torchrl-tit")


def test_a_reader_who_is_gone_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    words = [sys.executable, "-m", "recipes", "--help"]
    done = subprocess.run(words, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_evaluation_of_ones_own_does_not_replace_the_runs(capsys, tmp_path):
    run = tmp_path / "run"
    main(["train", "ppo/cartpole/mlp", "--out", str(run), *SHORT])
    own = (run / "evaluation.json").read_bytes()
    names = {
        "evaluation_episodes-3.json": ["--episodes", "3"],
        "evaluation_seed-7.json": ["--seed", "7"],
        "evaluation.json": ["--seed", "1000000", "--episodes", "2"],
    }
    for name, options in names.items():
        main(["evaluate", str(run), *options])
        assert capsys.readouterr().out.endswith(f"written to {run / name}\n")
    for name in ("evaluation.json", "evaluation_best.json"):
        line = fails(capsys, "evaluate", run, "--seed", 7, "--out", run / name)
        assert line.endswith("leave it out for evaluation_seed-7.json")
    assert (run / "evaluation.json").read_bytes() == own
    assert json.loads((run / "evaluation_seed-7.json").read_text())["seed"] == 7


@pytest.mark.parametrize(
    "option", [["--backbone.frame.embed-dim", "wide"], ["--no-such-field", "1"]]
)
def test_wrong_types_and_unknown_options(option, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as exit_:
        main(["train", "ppo/cartpole/enhanced-tit", *option])
    assert exit_.value.code == 2
    captured = capsys.readouterr()
    assert option[0] in captured.err + captured.out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_envz": 2}, r"unknown field 'num_envz'.*did you mean num_envs"),
        ({"num_envs": "2"}, r"field 'num_envs' is '2'.*int"),
        ({"algorithm": "pppo"}, r"unknown algorithm 'pppo'.*ppo"),
        (
            {"backbone": {"frame": {"encoder": "inner", "embed_dim": 1.5}}},
            r"frame\.embed_dim' is 1",
        ),
        ({"backbone": {"frame": {"encoder": "iner"}}}, r"unknown frame encoder 'iner'.*inner"),
        ({"backbone": {"frame": {"embed_dim": 8}}}, r"field 'backbone\.frame\.encoder'"),
        ({"backbone": {"frame": "inner"}}, r"field 'backbone\.frame': expected an object"),
        ({"backbone": {"frame": {"encoder": "inner"}}}, r"backbone lacks the field 'history'"),
        *(
            ({"backbone": BACKBONE | {"frames": frames}}, rf"field 'backbone\.frames{message}")
            for frames, message in [
                ({"image": {"encoder": "innr"}}, r"\.image\.encoder': unknown frame encod"),
                (["inner"], r"': expected an object, not \['inner'\]"),
            ]
        ),
        ({"backbone": {"network": ["mlp"]}}, r"unknown field 'backbone\.network'"),
        ({"epochs": 1e30}, r"epochs must be at most 1000000000000, not 1e\+30"),
        (
            {"device": "GPU 1"},
            r"device must be auto or a device of PyTorch, such as .* not 'GPU 1'",
        ),
    ],
)
def test_json_with_wrong_fields_is_refused(change, message):
    fields = json.loads(recipe_to_json(get_recipe("ppo/cartpole/enhanced-tit"))) | change
    with pytest.raises(ValueError, match=message):
        recipe_from_json(json.dumps(fields), "recipe.json")


def test_more_than_the_memory_holds_is_one_line(tmp_path):
    words = ["train", "ppo/cartpole/mlp", "--backbone.history.hidden-dim", 65536, "--out"]
    process = Command([*words, tmp_path / "run"], tmp_path / "errors", memory=2 * 10**9)
    assert process.wait() == 2
    [line] = process.errors.read_text().splitlines()
    assert line.startswith("error: there is not enough memory: a smaller network, num_frames")
    assert not (tmp_path / "run").exists()


ROOT = Path(__file__).parents[3]
SLOW = ("torch", "torchrl", "tensordict", "gymnasium", "matplotlib", "scipy", "optuna", "ray")


@pytest.mark.parametrize("words", [["list"], ["evaluate", "--help"]], ids=" ".join)
def test_no_slow_import(words):
    program = f"""
import sys
from recipes.cli import main
try:
    main({words!r})
except SystemExit as stop:
    assert not stop.code, stop.code
print(*(name for name in {SLOW!r} if name in sys.modules), file=sys.stderr)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout
    assert done.stderr == "\n"


def test_the_library_and_its_settings_are_imported_without_pytorch():
    program = "import sys, torchrl_tit, torchrl_tit.settings; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr

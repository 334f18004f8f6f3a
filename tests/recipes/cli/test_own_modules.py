"""Modules and files of recipes of a user's own, on the command line."""

import json
import sys

import pytest

from recipes.cli import main
from recipes.core.registry import get_recipe
from recipes.core.run import Run
from recipes.tools.sweeps import sweep
from tests.recipes.cli.test_cli import SHORT
from tests.recipes.commands import fails
from tests.recipes.small import TINY

OWN = """
from dataclasses import dataclass, replace

from torchrl_tit.frames.linear import LinearFrameEncoder
from torchrl_tit.recipes import get_recipe, register_recipes
from torchrl_tit.settings import Linear

@dataclass(frozen=True, kw_only=True)
class Own(Linear, name="own", builds=f"{__name__}:OwnEncoder"):
    '''A linear layer under another name.'''

class OwnEncoder(LinearFrameEncoder):
    pass

_base = get_recipe("ppo/cartpole/mlp")
one = replace(_base, name="", env="Acrobot-v1")
register_recipes(replace(one, name="own/acrobot"))
"""

SEVERAL = """
from torchrl_tit.recipes import get_recipe
first = get_recipe("ppo/cartpole/mlp")
more = {"second": get_recipe("ppo/acrobot/mlp")}
_hidden = first
numbers = {"a": 1}
"""


@pytest.fixture(autouse=True)
def _files(own_modules):
    (own_modules / "own.py").write_text(OWN)
    (own_modules / "several.py").write_text(SEVERAL)
    (own_modules / "empty.py").write_text("x = 1\n")
    (own_modules / "raises.py").write_text("1 / 0\n")


@pytest.mark.parametrize(
    "words",
    [["--import", "own", "list", "own"], ["list", "own", "--import=own.py"]],
    ids=["before the command", "after it"],
)
def test_an_imported_module_adds_recipes(words, capsys):
    main(words)
    assert capsys.readouterr().out == "own/acrobot\n"


def test_a_recipe_is_read_from_a_file_that_is_run(capsys):
    main(["show", "own.py"])
    fields = json.loads(capsys.readouterr().out)
    assert (fields["name"], fields["env"]) == ("one", "Acrobot-v1")  # named after the variable
    main(["show", "several.py:second"])
    assert json.loads(capsys.readouterr().out)["name"] == "ppo/acrobot/mlp"


def test_a_sweep_takes_all_recipes_of_a_file_and_its_processes_the_imports(own_modules):
    jobs = sweep.make_jobs(["several.py"], [0], own_modules / "runs")
    assert [job.arguments()[1] for job in jobs] == ["several.py:first", "several.py:second"]
    assert jobs[0].arguments()[-2:] == ["--import", "several.py"]
    Run.create(jobs[1].folder, jobs[1].recipe)
    resume = ["train", "--resume", str(jobs[1].folder), "--import", "several.py"]
    assert jobs[1].arguments() == resume


def test_a_run_with_own_parts_says_what_to_import(own_modules, capsys, monkeypatch):
    words = ["train", "ppo/cartpole/mlp", *SHORT, "--backbone.frame", "own", "--out", "run"]
    main([*words, "--num-envs", "1", "--import", "own"])
    assert json.loads((own_modules / "run" / "imports.json").read_text()) == ["own"]
    assert json.loads((own_modules / "run" / "recipe.json").read_text())["backbone"]["frame"] == {
        "encoder": "own", "embed_dim": 32, "bias": False, "activation": "none",
    }  # fmt: skip
    capsys.readouterr()
    # As in a process that does not know the module.
    forget(monkeypatch)
    for command in (["evaluate"], ["train", "--resume"], ["play", "--out", "a.gif"]):
        line = fails(capsys, *command, "run")
        assert "field 'backbone.frame.encoder': unknown frame encoder 'own'" in line
        assert line.endswith(
            "(one of your own needs `--import MODULE`); the run began with `--import own`"
        )
        assert "own" not in sys.modules
    main(["evaluate", "run", "--import", "own", "--episodes", "1"])
    assert "over 1 episodes" in capsys.readouterr().out


def forget(monkeypatch):
    from torchrl_tit.settings import FrameSettings

    FrameSettings.registered.pop("own")
    del sys.modules["own"]
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", "")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["list", "--import"], "--import needs the name of a module"),
        (["list", "--import", "--help"], "--import needs the name of a module"),
        (["--import", "nowhere", "list"], "error: there is no module 'nowhere', looked for in"),
        (["train", "raises.py"], "module 'raises' cannot be imported: ZeroDivisionError"),
        (["train", "empty.py"], "empty.py defines no recipe: assign one, such as PPO(...)"),
        (["train", "nowhere.py:one"], "there is no file nowhere.py"),
        (["train", "several.py"], "defines 2 recipes: name several.py:first or several.py:second"),
        (["sweep", "several.py:fist"], "several.py defines no recipe 'fist': did you mean first"),
        (["train", "own/acrobt"], "unknown recipe 'own/acrobt'"),
        (
            ["train", "ppo/cartpole/mlp", "--backbone.frame", "own"],
            "--backbone.frame has no choice 'own': ",
        ),
        (["train", "ppo/cartpole/mlp", "--backbone.frame", "own"], "needs `--import MODULE`"),
        (["train", "ppo/cartpole/mlp", "--init-from", "."], ". is not a run folder: there is no"),
        (["train", "ppo/cartpole/mlp", "--init-from", "run"], "holds no checkpoint"),
    ],
)
def test_bad_input_is_one_line(words, message, own_modules, capsys):
    Run.create(own_modules / "run", TINY)
    assert message in fails(capsys, *words)
    assert not (own_modules / "runs").exists()


def test_a_module_that_only_a_file_names_is_not_imported(own_modules, capsys):
    fields = json.loads(main_output(capsys, "show", "ppo/cartpole/mlp"))
    (own_modules / "task.json").write_text(json.dumps(fields | {"env": "own:Line-v0"}))
    line = fails(capsys, "train", "task.json")
    assert line.endswith("to allow it, add `--import own`")
    assert "own" not in sys.modules
    # Typed, it is the user's word.
    assert "own neither registers 'Line-v0'" in fails(
        capsys, "train", "ppo/cartpole/mlp", "--env", "own:Line-v0"
    )
    assert get_recipe("own/acrobot")


def main_output(capsys, *words):
    main(list(words))
    return capsys.readouterr().out

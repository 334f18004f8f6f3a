"""Files of others name what runs code: every way in refuses them, and runs nothing."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import pytest

from recipes.cli import main
from recipes.core.recipe_json import recipe_from_json, recipe_to_json
from recipes.core.registry import RECIPES, get_recipe
from recipes.core.trust import WRAPPERS, allow_names, check_names, may_name_task
from tests.recipes.commands import fails
from torchrl_tit.agents.folder import CONTENTS, RECIPE, read_agent, write_agent
from torchrl_tit.agents.loading import find_agent
from torchrl_tit.settings.imports import allow, allowed_modules, resolve

NAME = "ppo/cartpole/mlp"
MODULE = """
import gymnasium
open("ran", "w").close()
gymnasium.register("Mine-v0", "gymnasium.envs.classic_control:CartPoleEnv")
"""

HOSTILE: dict[str, tuple[dict[str, Any], str]] = {
    "a task": ({"env": "evilmod:Mine-v0"}, "evilmod"),
    "a program": ({"env": "subprocess:getoutput", "env_settings": ["cmd=touch ran"]}, "subprocess"),
    "a task for TorchRL": (
        {"env": "torchrl.envs:GymEnv", "env_settings": ['env_name="evilmod:Mine-v0"']},
        "torchrl.envs",
    ),
    "a task for Gym": (
        {"env": "GymV26Environment-v0", "env_settings": ["env_id=evilmod:Mine-v0"]},
        "gymnasium.envs",
    ),
    "an older task for Gym": ({"env": "GymV21Environment-v0"}, "gymnasium.envs"),
    "a task without its version": ({"env": "GymV26Environment"}, "gymnasium.envs"),
    "a setting": ({"env_settings": ["task=evilmod:Mine-v0"]}, "evilmod"),
    "a nested setting": ({"env_settings": ["of={'a': ['evilmod:Mine-v0']}"]}, "evilmod"),
    "the name of a setting": ({"env_settings": ["of={'evilmod:Mine-v0': 1}"]}, "evilmod"),
    "a file": (
        {"env": "Ant-v5", "env_settings": ["xml_file=/etc/evil.xml"]},
        "gymnasium.envs.mujoco.ant_v5",
    ),
    "bytes": ({"env_settings": ["of=b'evil'"]}, "gymnasium.envs.classic_control.cartpole"),
    "a wrapper": ({"wrappers": ["evilmod:Wrapper"]}, "evilmod"),
    "a wrapper that writes": ({"wrappers": ["minari:DataCollector"]}, "minari"),
    "a wrapper that films": (
        {"wrappers": ["gymnasium.wrappers:RecordVideo(video_folder='ran')"]},
        "gymnasium.wrappers",
    ),
    "a transform that downloads": (
        {"wrappers": ["torchrl.envs:R3MTransform(model_name='resnet18')"]},
        "torchrl.envs",
    ),
    "an argument": (
        {"wrappers": ["gymnasium.wrappers:FilterObservation(filter_keys=['evilmod:x'])"]},
        "evilmod",
    ),
    "an address": ({"ray": "evil.example:6379"}, "ray"),
}

WAYS = [
    "show FILE",
    "train FILE --out new",
    "sweep FILE --out new",
    "tune FILE --out new",
    "data collect CartPole-v1 --sets expert --agent FILE --out new",
    "data collect CartPole-v1 --sets expert --agent RUN --out new",
    "train --resume RUN",
    f"train {NAME} --init-from RUN --out new",
    "evaluate RUN",
    "explain RUN --out a.gif",
    "compare RUN",
    "table .",
    "report RUN --out a.html",
    "share RUN --out new",
    "export AGENT --out a.onnx",
    "play AGENT",
    "play RUN",
]


@pytest.fixture
def folder(own_modules: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(str(own_modules))
    (own_modules / "evilmod.py").write_text(MODULE)
    return own_modules


def write(folder: Path, changes: dict[str, Any]) -> None:
    """Writes a recipe as a file, as a run folder and as an agent."""
    text = json.dumps(json.loads(recipe_to_json(get_recipe(NAME))) | changes)
    (folder / "file.json").write_text(text)
    (folder / "run").mkdir()
    (folder / "run" / "recipe.json").write_text(text)
    agent = find_agent("cartpole")
    contents = {name: (agent / name).read_bytes() for name in CONTENTS}
    write_agent(folder / "agent", contents | {RECIPE: text.encode()}, read_agent(agent).steps)


@pytest.mark.parametrize("what", HOSTILE)
def test_every_way_in_refuses_it(what, folder, capsys):
    changes, module = HOSTILE[what]
    write(folder, changes)
    before = sorted(folder.rglob("*"))
    paths = {"FILE": "file.json", "RUN": "run", "AGENT": "agent"}
    for way in WAYS:
        with pytest.raises(SystemExit) as exit_:
            main([paths.get(word, word) for word in way.split()])
        printed = capsys.readouterr()
        assert exit_.value.code == 2, way
        assert printed.err.count("\n") == 1, (way, printed.err)
        assert printed.err.startswith("error: "), way
        assert f"to allow it, add `--import {module}`" in printed.err, (way, printed.err)
        assert not printed.out, way
        left = [path for path in sorted(folder.rglob("*")) if path.name not in (".lock", "new")]
        assert left == before, way
    assert "evilmod" not in sys.modules
    assert not (folder / "ran").exists()


def test_a_search_space_is_a_file_too(folder, capsys):
    (folder / "space.json").write_text(
        json.dumps({"env": {"type": "categorical", "choices": ["CartPole-v1", "evilmod:Mine-v0"]}})
    )
    assert "space.json names 'evilmod:Mine-v0'" in fails(
        capsys, "tune", NAME, "--space", "space.json", "--out", "new"
    )
    assert not (folder / "ran").exists()


def test_named_recipes_pass_without_a_word():
    for name, recipe in RECIPES.items():
        assert recipe_from_json(recipe_to_json(recipe), name) == recipe
    assert allowed_modules() == []


def test_wrappers_on_the_list_exist():
    for module, names in WRAPPERS.items():
        for name in names:
            assert isinstance(resolve(f"{module}:{name}"), type)


@pytest.mark.parametrize("what", HOSTILE)
def test_what_the_user_says_is_allowed(what):
    changes, _ = HOSTILE[what]
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in changes.items()}
    recipe = replace(get_recipe(NAME), **fields)
    allow_names(recipe)  # as if it had been typed
    check_names(recipe, "recipe.json")


def test_each_module_needs_its_own_word():
    gym = replace(get_recipe(NAME), env="torchrl.envs:GymEnv", env_settings=("env_name=evil:X",))
    allow("torchrl.envs")
    with pytest.raises(ValueError, match=r"'evil:X'.* add `--import evil`"):
        check_names(gym, "recipe.json")
    allow("evil")
    check_names(gym, "recipe.json")


def test_what_was_typed_is_asked_for_again(folder, capsys):
    short = ["--total-steps", "128", "--steps-per-batch", "128", "--evaluation-episodes", "1"]
    words = ["--wrappers", "gymnasium.wrappers:RecordEpisodeStatistics", "--env", "evilmod:Mine-v0"]
    settings = ["--env-settings", "max_episode_steps=20", "--compile", "off", "--num-envs", "1"]
    main(["train", NAME, *short, *words, *settings, "--out", "run"])
    assert (folder / "ran").exists()
    named = json.loads((folder / "run" / "imports.json").read_text())
    assert sorted(named) == ["evilmod", "gymnasium.wrappers"]
    imports = [word for module in named for word in ("--import", module)]
    main(["evaluate", "run", *imports])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHRL_TIT_IMPORTS", "")
        with pytest.raises(SystemExit):
            main(["evaluate", "run"])
    line = capsys.readouterr().err.splitlines()[-1]
    assert "add `--import evilmod`" in line
    assert "the run began with `--import" in line


def test_names_that_the_running_program_has_registered(monkeypatch):
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    gymnasium.register("Own-v0", lambda **_: None)  # type: ignore[arg-type]
    gymnasium.register("Lazy-v0", "not_loaded:Task")
    registry = gymnasium.envs.registration.registry
    monkeypatch.setattr(gymnasium, "registry", registry)
    assert may_name_task("Own-v0")
    assert not may_name_task("Lazy-v0")
    assert not may_name_task("GymV26Environment-v0")

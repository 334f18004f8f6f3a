"""What earlier versions wrote can be used: recipes of 0.1.0, and a run and an agent of 8688efa."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from recipes.cli import main
from recipes.core.metrics import read_metrics
from recipes.core.numbers import number
from recipes.core.recipe_json import recipe_from_json, recipe_to_json
from recipes.core.registry import RECIPES
from recipes.core.run import Run
from recipes.core.runner import evaluate
from recipes.ppo import PPO
from torchrl_tit import load_agent

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parents[1] / "data" / "previous_version"
RETURNS = json.loads((DATA / "run" / "evaluation.json").read_text())["returns"]
WRITTEN = {
    f"{path.stem}-{number}": line
    for path in sorted(DATA.glob("recipes*.jsonl"))
    for number, line in enumerate(path.read_text().splitlines())
}
OF_ALGORITHMS = {recipe.algorithm: recipe for recipe in RECIPES.values()}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return shutil.copytree(DATA / "run", tmp_path / "run")


@pytest.mark.parametrize("which", WRITTEN)
def test_a_recipe_of_each_algorithm_and_network_loads(which):
    written = json.loads(WRITTEN[which])
    recipe = recipe_from_json(WRITTEN[which], "recipe.json")
    # What the version before wrote is what is named so today; on games, with the paper's settings.
    games = isinstance(recipe, PPO) and recipe.env.startswith("ALE/")
    now = RECIPES[f"{recipe.name}-protocol" if games else recipe.name]
    recipe = replace(recipe, name=now.name)
    if recipe.name == "dqn/cartpole/enhanced-tit":  # has the network of PPO's recipes today
        recipe = replace(recipe, backbone=now.backbone)
    assert recipe.backbone == now.backbone
    assert (recipe.algorithm, recipe.env) == (written["algorithm"], written["env"])
    if recipe.name.startswith("dqn/cartpole/"):  # has CleanRL's settings today
        others = "total_steps random_steps steps_per_batch updates_per_step buffer_size batch_size "
        others += "learning_rate loss_function final_epsilon exploration_fraction target_interval"
        recipe = replace(recipe, **{field: getattr(now, field) for field in others.split()})
    assert recipe.final_step == now.final_step
    if isinstance(recipe, PPO) and isinstance(now, PPO):
        # The size of an update is set by other settings now; a run keeps those that it had.
        fields = ("minibatch_size", "target_kl", "initial_std", "learning_rate")
        recipe = replace(recipe, **{field: getattr(now, field) for field in fields})
    assert recipe == now or which.startswith("recipes-0.1.0"), "another setting than before"


@pytest.mark.parametrize(
    ("written", "field"),
    [(one, field) for one in OF_ALGORITHMS.values() for field in type(one).removed],
    ids=lambda value: value if isinstance(value, str) else value.algorithm,
)
def test_a_removed_field_is_read_only_where_it_did_nothing(written, field):
    fields, nothing = json.loads(recipe_to_json(written)), type(written).removed[field]
    assert recipe_from_json(json.dumps({**fields, field: nothing}), "recipe.json") == written
    message = f"^recipe.json .*{field!r} no longer exists, and only {re.escape(repr(nothing))}.*$"
    with pytest.raises(ValueError, match=message):
        recipe_from_json(json.dumps({**fields, field: "other"}), "recipe.json")


@pytest.mark.parametrize("kind", ["run", "agent"])
def test_an_agent_plays_as_it_did(kind, capsys):
    assert load_agent(DATA / kind).evaluate().tolist() == RETURNS
    main(["play", str(DATA / kind), "--episodes", "3"])
    assert f"return {number(sum(RETURNS) / 3)}" in capsys.readouterr().out


def test_a_run_is_evaluated_and_trained_further(run):
    before = read_metrics(run / "metrics.csv")
    assert evaluate(Run.open(run))["returns"] == RETURNS
    assert evaluate(Run.open(run), best=True)["steps"] == 512
    # In a new process, which has imported no algorithm before it reads the run's recipe.
    words = ["train", "--resume", str(run), "--total-steps", "640"]
    subprocess.run([sys.executable, "-m", "recipes", *words], cwd=ROOT, check=True)
    after = read_metrics(run / "metrics.csv")
    assert [str(row) for row in after[: len(before)]] == [str(row) for row in before]
    assert after[-1]["step"] == json.loads((run / "evaluation.json").read_text())["steps"] == 640


def test_a_run_is_packaged(run, tmp_path):
    main(["share", str(run), "--out", str(tmp_path / "agent")])
    assert load_agent(tmp_path / "agent").evaluate().tolist() == RETURNS

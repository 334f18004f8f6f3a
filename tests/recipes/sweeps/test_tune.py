"""Hyperparameter search: spaces as data, pruning, and searches that were killed."""

import csv
import json
import math
import signal
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from recipes.cli import main
from recipes.core.numbers import number
from recipes.core.recipe_json import recipe_from_json, recipe_to_json
from recipes.core.registry import get_recipe
from recipes.core.run import Run
from tests.recipes.commands import Command, fails
from tests.recipes.small import TINY
from tests.recipes.sweeps.sweep_runs import fork_worker
from torchrl_tit.settings.networks import mlp

optuna = pytest.importorskip("optuna")

from recipes.tools.sweeps import tune  # noqa: E402
from recipes.tools.sweeps.search_space import load_space, with_values  # noqa: E402
from recipes.tools.sweeps.tune import Search, Settings  # noqa: E402

RECIPE = replace(TINY, name="ppo/cartpole/mine", backbone=mlp(), total_steps=256)
SPACE: dict[str, Any] = {
    "learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True},
    "epochs": {"type": "int", "low": 1, "high": 2},
    "backbone.history.activation": {"type": "categorical", "choices": ["tanh", "relu"]},
}
SETTINGS = Settings(RECIPE, SPACE)


@pytest.fixture
def files(tmp_path):
    (tmp_path / "recipe.json").write_text(recipe_to_json(RECIPE))
    (tmp_path / "space.json").write_text(json.dumps({k: SPACE[k] for k in list(SPACE)[:2]}))
    return tmp_path


def words(files, trials):
    paths = [str(files / "recipe.json"), "--space", str(files / "space.json")]
    return ["tune", *paths, "--trials", str(trials), "--out", str(files / "out")]


@pytest.fixture
def naps(monkeypatch):
    """No waiting; a search without an end runs out of naps."""
    left = iter(range(30))
    monkeypatch.setattr(time, "sleep", lambda _: next(left))


class Process:
    """A worker's process that has ended, or that goes on until it is stopped."""

    def __init__(self, returncode=None):
        self.returncode = returncode
        self.signals = []

    def poll(self):
        return self.returncode

    def send_signal(self, number):
        self.signals.append(number)

    def wait(self):
        pass


def complete(job, mean=None):
    """Completes a run; its return is its learning rate."""
    run = Run.create(job.folder, job.recipe)
    mean = job.recipe.learning_rate if mean is None else mean
    numbers = {"episodes": 1, "seed": 0, "returns": [mean], "mean": mean, "std": 0.0}
    run.save_evaluation({"env": job.recipe.env, "steps": job.recipe.final_step, **numbers})
    run.curve.touch()
    (job.folder / "metrics.csv").write_text("step,time,return_mean\n64,0,10\n128,0,12\n")
    return Process(0)


def read(file):
    return list(csv.DictReader(file.open()))


@pytest.fixture
def searched(tmp_path, naps, monkeypatch):
    """The folder of a search with two complete trials, and its study."""
    monkeypatch.setattr(tune, "start", complete)
    with Search(tmp_path / "out", SETTINGS) as search:
        assert search.run(2, workers=1) == []
    return tmp_path / "out", search.study


@pytest.mark.slow
def test_a_search_that_was_killed_goes_on(files, capsys, monkeypatch):
    out = files / "out"
    process = Command(words(files, 2), files / "errors")
    deadline = time.monotonic() + 120
    while not (out / "trial-0" / "seed-0" / "recipe.json").exists():
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    process.wait()
    # Its worker has a session of its own, and holds the folder until it is done.
    while not (out / "trial-0" / "seed-0" / "learning_curve.png").exists():
        assert time.monotonic() < deadline
        time.sleep(0.1)
    drawn = (out / "trial-0.json").read_text()

    monkeypatch.setattr(tune, "start", fork_worker)
    main(words(files, 2))
    assert (out / "trial-0.json").read_text() == drawn
    assert sorted(path.name for path in out.glob("trial-*/")) == ["trial-0", "trial-1"]
    best = recipe_from_json((out / "best.json").read_bytes(), "best.json")
    means = [
        json.loads((out / f"trial-{n}/seed-0/evaluation.json").read_text())["mean"] for n in (0, 1)
    ]
    chosen = means.index(max(means))
    assert best == recipe_from_json((out / f"trial-{chosen}.json").read_bytes(), "")
    assert best.name == f"ppo/cartpole/mine/trial-{chosen}"
    assert f"best of 2 trials: {number(max(means))} with learning_rate" in capsys.readouterr().out

    main(["table", str(out)])  # where each trial stands under its name
    assert "| ppo/cartpole/mine/trial-1 | 1 |" in capsys.readouterr().out
    assert "holds a search with other settings" in fails(capsys, *words(files, 2), "--seeds", "1")


def test_trials_are_recorded_and_their_study_is_made_again(searched, monkeypatch):
    folder, study = searched
    rows = read(folder / "trials.csv")
    assert [row["state"] for row in rows] == ["complete"] * 2
    for row, trial in zip(rows, study.trials, strict=True):
        assert float(row["value"]) == trial.value == trial.params["learning_rate"]
        assert row["backbone.history.activation"] == trial.params["backbone.history.activation"]
        assert (int(row["epochs"]), row["step"]) == (trial.params["epochs"], "128")
    best = json.loads((folder / "best.json").read_text())
    assert best["learning_rate"] == study.best_value

    monkeypatch.setattr(tune, "tqdm", partial(tune.tqdm, disable=True))  # as TQDM_DISABLE=1 does
    monkeypatch.setattr(tune, "start", lambda job: Process(2))
    with Search(folder, SETTINGS) as search:
        for again, before in zip(search.study.trials, study.trials, strict=True):
            assert (again.params, again.value) == (before.params, before.value)
            assert again.intermediate_values == before.intermediate_values == {64: 10, 128: 11}
        assert search.run(3, workers=1) == [2]
    third = read(folder / "trials.csv")[2]
    assert (third["state"], third["value"]) == ("fail", "")
    assert third["learning_rate"] not in [row["learning_rate"] for row in rows]
    # As the version before wrote it: with what is left out in ours.
    spelled = SPACE | {"epochs": SPACE["epochs"] | {"step": 1, "log": False}}
    (folder / "space.json").write_text(json.dumps(spelled))
    with Search(folder, SETTINGS) as search:  # complete: nothing is run again
        assert search.run(3, workers=1) == [2]
    assert not (folder / "importance.csv").exists(), "two complete trials say nothing"


@pytest.mark.parametrize("kills", [1, 2])
def test_a_trial_whose_process_is_killed_is_resumed_once(tmp_path, naps, monkeypatch, kills):
    codes = [-9] * kills

    def start(job):
        return Process(codes.pop()) if codes else complete(job)

    monkeypatch.setattr(tune, "start", start)
    with Search(tmp_path, SETTINGS) as search:
        assert search.run(1, workers=1) == [[], [0]][kills - 1]


def test_a_trial_below_the_median_is_pruned(tmp_path, naps, monkeypatch):
    """Earlier trials are told; the new one's metrics are written by hand."""
    settings = Settings(RECIPE, SPACE, startup_trials=2, warmup=0.4)
    process, rows = Process(), ["step,time,return_mean", "64,0,10"]

    def start(job):
        job.folder.mkdir(parents=True)
        monkeypatch.setattr(time, "sleep", lambda _: write_more(job.folder / "metrics.csv"))
        return process

    def write_more(path: Path):
        assert len(rows) < 10
        path.write_text("\n".join([*rows, ""]))
        rows.append(f"{64 * len(rows)},0,12")

    monkeypatch.setattr(tune, "start", start)
    with Search(tmp_path, settings) as search:
        for _ in range(2):
            trial = search.study.ask(search.space)
            for step in (64, 128, 192):
                trial.report(100.0, step)
            search.study.tell(trial, 100.0)
        search.run(3, workers=1)
    assert process.signals == [signal.SIGINT]
    assert search.study.trials[-1].intermediate_values == {64: 10, 128: (10 + 12) / 2}
    last = read(tmp_path / "trials.csv")[-1]
    assert (last["state"], last["value"], last["step"]) == ("pruned", "11.0", "128")
    for index in (0, 1):  # told, not run: they would be begun again
        (tmp_path / "trials.csv").write_text(
            (tmp_path / "trials.csv").read_text().replace(f"{index},complete", f"{index},fail")
        )
    with Search(tmp_path, settings) as search:
        pruned = search.study.trials[-1]
    assert (pruned.state.name, pruned.intermediate_values) == ("PRUNED", {128: 11})


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"learning_rat": SPACE["learning_rate"]}, "unknown field 'learning_rat'"),
        ({"seed": SPACE["epochs"]}, "unknown field 'seed'"),
        ({"epochs": {"type": "int", "low": 0, "high": 3}}, "epochs must be at least 1, not 0"),
        ({"epochs": {"type": "float", "low": 1, "high": 3.5}}, "field 'epochs' is 3.5"),
        ({"epochs": {"type": "float", "low": 1, "high": 3}}, "field 'epochs' is 3.0"),
        ({"evaluation_seed": SPACE["epochs"]}, "unknown field 'evaluation_seed'"),
        ({"epochs": {"type": "int", "low": 3, "high": 1}}, "`low <= high` must hold"),
        ({"gamma": {"type": "uniform", "low": 0}}, "gamma is none of categorical, float, int"),
        ({"gamma": [1, 2]}, "is not a search space"),
        ({"gamma": [1, 2]}, "gamma has [1, 2], not a range such as"),
        ({"gamma": {"low": 0, "high": 1}}, "gamma has {'low': 0, 'high': 1}, not a range"),
        ({"gamma": {"type": "float", "low": 0}}, "gamma has the type float, but no high"),
        ({"gamma": {"type": "categorical", "choices": "abc"}}, "gamma are 'abc', not a list"),
        ({"gamma": {"type": "float", "low": 0, "high": 1, "lag": True}}, "gamma: "),
        ({"env": {"type": "categorical", "choices": ["Acrobot-v1"]}}, "searches 'env', but trials"),
        ({}, "names no field"),
    ],
)
def test_bad_spaces_are_refused_before_anything_runs(space, message, files, capsys):
    (files / "space.json").write_text(json.dumps(space))
    assert message in fails(capsys, *words(files, 2))
    assert not (files / "out").exists()


def test_values_that_do_not_go_together_fail_the_trial_only(tmp_path, naps):
    recipe = get_recipe("ppo/cartpole/enhanced-tit")
    space = {"backbone.history.num_heads": {"type": "categorical", "choices": [3]}}
    with Search(tmp_path, Settings(recipe, space)) as search:  # 3 does not divide the width
        assert search.run(1, workers=1) == [0]
    assert "width 32" in (tmp_path / "trial-0/error.log").read_text()
    with Search(tmp_path, Settings(recipe, space)) as search:
        assert [trial.state.name for trial in search.study.trials] == ["FAIL"]


def test_a_run_that_a_killed_search_left_at_work_is_waited_for(tmp_path, monkeypatch):
    with Search(tmp_path, SETTINGS) as search:
        recipe = search.recipe(0, search.study.ask(search.space).params)
        search._write_trials()  # and killed
    events = []

    def sleep(_):
        events.append("wait")
        if len(events) == 3:
            left.__exit__()

    def start(job):
        events.append(f"start {job.folder.parent.name}")
        return Process(2)

    monkeypatch.setattr(tune, "start", start)
    with Run.create(tmp_path / "trial-0" / "seed-0", recipe) as left:
        monkeypatch.setattr(time, "sleep", sleep)
        with Search(tmp_path, SETTINGS) as search:
            assert search.run(1, workers=1) == [0]
    assert events == ["wait"] * 3 + ["start trial-0", "wait"]


def test_a_run_that_another_process_starts_first_is_waited_for(tmp_path, naps, monkeypatch):
    """One that a killed search left behind: until it writes its first file, it cannot be seen."""

    def start(job):
        complete(job)
        return Process(2)  # refused

    monkeypatch.setattr(tune, "start", start)
    with Search(tmp_path, SETTINGS) as search:
        assert search.run(1, workers=1) == []
        (trial,) = search.study.trials
        assert trial.value == trial.params["learning_rate"]


def test_no_more_trials_than_workers_go_on(tmp_path, naps, monkeypatch):
    begun = []
    with Search(tmp_path, SETTINGS) as search:
        for _ in range(3):  # at work when the search was killed
            search.study.ask(search.space)
        search._write_trials()

    def start(job):
        begun.append(job.folder.name)
        return Process(2)

    monkeypatch.setattr(tune, "start", start)
    with Search(tmp_path, SETTINGS) as search:
        assert search.run(2, workers=1) == [0, 1]
    assert len(begun) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"learning_rate": "1e9"}, r"isn't contained in the distribution FloatDistribution"),
        ({"backbone.history.activation": "sin"}, r"KeyError: 'sin'"),
        ({"value": "nan"}, "trial 0 has the return nan, not a finite number"),
        ({"state": "done"}, "KeyError: 'DONE'"),
        ({"trial": "7"}, "trial 0 is missing"),
        ({"step": None}, "KeyError: 'step'"),
    ],
)
def test_trials_that_the_search_did_not_write_are_refused(searched, change, message):
    folder, _ = searched
    path = folder / "trials.csv"
    rows = [row | change for row in read(path)]
    names = [name for name in rows[0] if rows[0][name] is not None]
    with path.open("w") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    with pytest.raises(ValueError, match=rf"trials\.csv is not an intact .*{message}") as error:
        Search(folder, SETTINGS).__enter__()
    assert "\n" not in str(error.value)
    path.write_bytes(b"trial,\xff\0\n")
    with pytest.raises(ValueError, match=r"trials\.csv is not an intact"):
        Search(folder, SETTINGS).__enter__()


def test_a_trial_is_not_credited_with_the_run_of_another(searched):
    folder, _ = searched
    for old, new in (("trial-0", "other"), ("trial-1", "trial-0"), ("other", "trial-1")):
        (folder / old).rename(folder / new)
    with pytest.raises(ValueError, match=r"trial-0/seed-0 holds a run of .* with other settings"):
        Search(folder, SETTINGS).__enter__()
    (folder / "space.json").write_text('{"epochs": [1, 2]}')
    with pytest.raises(ValueError, match=r"space\.json cannot be read"):
        Search(folder, SETTINGS).__enter__()
    (folder / "settings.json").unlink()
    with pytest.raises(ValueError, match=r"settings\.json is missing"):
        Search(folder, SETTINGS).__enter__()


@pytest.mark.parametrize("mean", [math.nan, "high"])
def test_an_evaluation_that_cannot_be_read_fails_the_trial(mean, tmp_path, naps, monkeypatch):
    monkeypatch.setattr(tune, "start", partial(complete, mean=mean))
    with Search(tmp_path, SETTINGS) as search:
        assert search.run(1, workers=1) == [0]
    assert "seed-0 is not complete" in (tmp_path / "trial-0" / "error.log").read_text()


def test_one_process_at_a_time(tmp_path):
    other = Search(tmp_path, SETTINGS)
    with Search(tmp_path, SETTINGS), pytest.raises(RuntimeError, match="in use by another process"):
        other.__enter__()
    with other:
        pass


@pytest.mark.parametrize(
    "name", ["ppo/acrobot/enhanced-tit", "ppo/hopper/mlp", "ppo/pong/nature-cnn"]
)
def test_every_default_space_fits_its_recipes(name):
    recipe = get_recipe(name)
    ranges = load_space(None, recipe).items()
    values = {field: x["choices"][-1] if "choices" in x else x["high"] for field, x in ranges}
    assert with_values(recipe, values, Path("here")) != recipe


def test_other_algorithms_need_a_space():
    with pytest.raises(ValueError, match="there is no default search space for the algorithm dt"):
        load_space(None, get_recipe("dt/hopper-medium-v2/dt"))


def test_fields_are_options(files, naps, capsys, monkeypatch):
    monkeypatch.setattr(tune, "start", complete)
    typed = ["--env", "Acrobot-v1", "--seed", "3", "--backbone.network", "lstm"]
    main([*words(files, 2), *typed])
    recipe = recipe_from_json((files / "out" / "best.json").read_bytes(), "best.json")
    assert (recipe.env, recipe.seed) == ("Acrobot-v1", 3)
    assert (files / "out" / "trial-1" / "seed-3").exists(), "what is reported is what was trained"
    assert recipe.backbone.history.name == "lstm"
    assert "other settings" in fails(capsys, *words(files, 2))  # without these fields
    assert "--evn" in fails(capsys, *words(files, 2), "--evn", "Acrobot-v1")

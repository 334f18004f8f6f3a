"""Hyperparameter search: spaces as data, pruning, and searches that were killed."""

import json
import math
import signal
import time
from functools import partial
from pathlib import Path

import filelock
import pytest
from tqdm import tqdm

from recipes.cli import main
from recipes.ppo import PPO
from recipes.recipe_json import recipe_from_json, recipe_to_json
from recipes.registry import get_recipe
from recipes.run import Run
from recipes.sweeps.search_space import load_space, with_values
from recipes.sweeps.tune import Search, Settings
from tests.recipes.commands import Command
from tests.recipes.sweeps.sweep_runs import fork_worker
from torchrl_tit.settings.networks import mlp

optuna = pytest.importorskip("optuna")

RECIPE = PPO(
    name="ppo/cartpole/mine",
    env="CartPole-v1",
    backbone=mlp(),
    total_steps=256,
    steps_per_batch=64,
    epochs=1,
    evaluation_episodes=2,
    checkpoint_interval=64,
)
SPACE = {
    "learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True},
    "epochs": {"type": "int", "low": 1, "high": 2},
    "backbone.history.hidden_dim": {"type": "categorical", "choices": [8, 16]},
}


@pytest.fixture
def files(tmp_path):
    (tmp_path / "recipe.json").write_text(recipe_to_json(RECIPE))
    space = {k: v for k, v in SPACE.items() if not k.startswith("backbone")}
    (tmp_path / "space.json").write_text(json.dumps(space))
    return tmp_path


def words(files, trials):
    paths = [str(files / "recipe.json"), "--space", str(files / "space.json")]
    return ["tune", *paths, "--trials", str(trials), "--out", str(files / "out")]


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

    monkeypatch.setattr("recipes.sweeps.tune.start", fork_worker)
    main(words(files, 2))
    assert (out / "trial-0.json").read_text() == drawn
    assert sorted(path.name for path in out.glob("trial-*/")) == ["trial-0", "trial-1"]
    best = recipe_from_json((out / "best.json").read_bytes(), "best.json")
    means = [
        json.loads((out / f"trial-{n}/seed-0/evaluation.json").read_text())["mean"] for n in (0, 1)
    ]
    winner = recipe_from_json((out / f"trial-{means.index(max(means))}.json").read_bytes(), "")
    assert best == winner
    assert isinstance(best, PPO)
    assert best.name == f"ppo/cartpole/mine/trial-{means.index(max(means))}"
    assert 1e-4 <= best.learning_rate <= 1e-2
    assert f"best of 2 trials: {max(means):.1f} with learning_rate" in capsys.readouterr().out

    main(["table", str(out)])  # where each trial stands under its name
    assert "| ppo/cartpole/mine/trial-1 | 1 |" in capsys.readouterr().out
    main(words(files, 2))  # complete: nothing is run again
    assert len(list(out.glob("trial-*/"))) == 2
    with pytest.raises(SystemExit):
        main([*words(files, 2), "--seeds", "1"])
    assert "holds a search with other settings" in capsys.readouterr().err


def test_a_trial_below_the_median_is_pruned(tmp_path, monkeypatch):
    """Earlier trials are told; the new one's metrics are written by hand."""
    space = load_space(None, RECIPE)
    search = Search(tmp_path, Settings(RECIPE, space, startup_trials=2, warmup=0.25))
    for _ in range(2):
        trial = ask(search)
        for step in (64, 128, 192):
            trial.report(100.0, step)
        search.study.tell(trial, 100.0)
        (tmp_path / f"trial-{trial.number}.json").write_text(recipe_to_json(RECIPE))

    stopped = []

    class Process:
        returncode = None

        def poll(self):
            return None

        def send_signal(self, number):
            stopped.append(number)

        def wait(self):
            pass

    def start(job):
        job.folder.mkdir(parents=True)
        rows = "step,time,return_mean\n64,0,10\n"
        (job.folder / "metrics.csv").write_text(rows)
        monkeypatch.setattr(time, "sleep", lambda _: write_more(job.folder / "metrics.csv"))
        return Process()

    def write_more(path: Path):
        path.write_text("step,time,return_mean\n64,0,10\n128,0,12\n")

    monkeypatch.setattr("recipes.sweeps.tune.start", start)
    search.run(3, workers=1)
    assert stopped == [signal.SIGINT]
    last = search.study.trials[-1]
    assert last.state == optuna.trial.TrialState.PRUNED
    assert last.intermediate_values == {128: (10 + 12) / 2}
    rows = (tmp_path / "trials.csv").read_text().splitlines()
    assert [row.split(",")[:3] for row in rows[1:]] == [
        ["0", "complete", "100.0"],
        ["1", "complete", "100.0"],
        ["2", "pruned", "11.0"],
    ]


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({"learning_rat": {"type": "float", "low": 0, "high": 1}}, "unknown field 'learning_rat'"),
        (
            {"backbone.history.depth": {"type": "int", "low": 0, "high": 1}},
            "unknown field 'backbone.history.depth'",
        ),
        ({"seed": {"type": "int", "low": 0, "high": 1}}, "unknown field 'seed'"),
        ({"epochs": {"type": "int", "low": 0, "high": 3}}, "epochs must be at least 1, not 0"),
        ({"epochs": {"type": "float", "low": 1, "high": 3.5}}, "field 'epochs' is 1.0"),
        ({"epochs": {"type": "int", "low": 3, "high": 1}}, "low must be below high, not 3 and 1"),
        ({"gamma": {"type": "float", "low": 0, "high": 1, "log": True}}, "low must be above 0"),
        ({"gamma": {"type": "categorical", "choices": []}}, "is not a search space"),
        ({"gamma": {"type": "uniform", "low": 0}}, "is not a search space"),
        ({"gamma": [1, 2]}, "is not a search space"),
        ({}, "names no field"),
    ],
)
def test_bad_spaces_are_refused_before_anything_runs(space, message, files, capsys):
    (files / "space.json").write_text(json.dumps(space))
    with pytest.raises(SystemExit) as stop:
        main(words(files, 2))
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
    assert not (files / "out").exists()


def test_values_that_do_not_go_together_fail_the_trial_only(tmp_path):
    recipe = get_recipe("ppo/cartpole/enhanced-tit")
    (tmp_path / "space.json").write_text(
        json.dumps({"backbone.history.num_heads": {"type": "categorical", "choices": [1, 3]}})
    )
    space = load_space(tmp_path / "space.json", recipe)
    search = Search(tmp_path / "out", Settings(recipe, space))
    search.study.enqueue_trial({"backbone.history.num_heads": 3})  # does not divide the width
    assert search.run(1, workers=1) == [0]
    assert "width 32" in (tmp_path / "out/trial-0/error.log").read_text()


def ask(search):
    """Draws a trial with all its values."""
    trial = search.study.ask()
    for field, values in search.settings.space.items():
        values.suggest(trial, field)
    return trial


class FailingWorker:
    """A worker's process that fails at once."""

    returncode = 2

    def poll(self):
        return self.returncode


def test_a_run_that_a_killed_search_left_at_work_is_waited_for(tmp_path, monkeypatch):
    search = Search(tmp_path, Settings(RECIPE, load_space(None, RECIPE)))
    recipe = search.recipe(0, ask(search).params)
    events = []

    def sleep(_):
        events.append("wait")
        if len(events) == 3:
            left.__exit__()

    def start(job):
        events.append(f"start {job.folder.parent.name}")
        return FailingWorker()

    monkeypatch.setattr("recipes.sweeps.tune.start", start)
    with Run.create(tmp_path / "trial-0" / "seed-0", recipe) as left:
        monkeypatch.setattr(time, "sleep", sleep)
        assert search.run(1, workers=1) == [0]
    assert events == ["wait"] * 3 + ["start trial-0", "wait"]


def test_no_more_trials_than_workers_go_on(tmp_path, monkeypatch):
    search = Search(tmp_path, Settings(RECIPE, load_space(None, RECIPE)))
    for _ in range(3):  # at work when the search was killed
        search.study.ask()
    begun = []

    def start(job):
        begun.append(job.folder.parent.name)
        return FailingWorker()

    monkeypatch.setattr("recipes.sweeps.tune.start", start)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    assert search.run(2, workers=1) == [0, 1]
    assert begun == ["trial-0", "trial-1"]


def test_without_a_progress_view(tmp_path, monkeypatch):
    """TQDM_DISABLE=1 switches it off."""
    (tmp_path / "space.json").write_text(json.dumps({"epochs": SPACE["epochs"]}))
    space = load_space(tmp_path / "space.json", RECIPE)
    naps = iter(range(20))  # a search without an end runs out of them
    monkeypatch.setattr("recipes.sweeps.tune.tqdm", partial(tqdm, disable=True))
    monkeypatch.setattr("recipes.sweeps.tune.start", lambda job: FailingWorker())
    monkeypatch.setattr(time, "sleep", lambda _: next(naps))
    assert Search(tmp_path / "out", Settings(RECIPE, space)).run(2, workers=1) == [0, 1]


@pytest.mark.parametrize("line", ['{"op_code": 99, "worker_id": "w"}', "{}", "[]", "trial 7"])
def test_a_journal_that_optuna_did_not_write_is_named(tmp_path, line):
    settings = Settings(RECIPE, load_space(None, RECIPE))
    Search(tmp_path, settings)
    with (tmp_path / "study.log").open("a") as file:
        file.write(f"{line}\n")
    before = (tmp_path / "study.log").read_bytes()
    with pytest.raises(ValueError, match=r"study\.log is not an intact journal") as error:
        Search(tmp_path, settings)
    assert "\n" not in str(error.value)
    assert (tmp_path / "study.log").read_bytes() == before


def search_with_a_trial(folder):
    """A search that has told Optuna of one trial."""
    (folder / "space.json").write_text(json.dumps(SPACE))
    settings = Settings(RECIPE, load_space(folder / "space.json", RECIPE))
    search = Search(folder / "out", settings)
    search.study.tell(ask(search), 7.5)
    return settings, folder / "out" / "study.log"


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("learning_rate", 1e9, "trial 0 has learning_rate 1000000000.0, not in the search space"),
        ("learning_rate", math.nan, "learning_rate nan, not in the search space"),
        ("learning_rate", "fast", "learning_rate 'fast', not in the search space"),
        ("backbone.history.hidden_dim", 9, "IndexError: .* out of range"),
        ("values", [math.nan], "trial 0 has the return nan, not a finite number"),
        ("values", ["high"], "trial 0 has the return 'high', not a finite number"),
        ("directions", [1], "its study does not maximize one value"),
        ("study_name", "other", "it holds the study 'other', not 'ppo/cartpole/mine'"),
    ],
)
def test_a_journal_that_the_search_did_not_write_is_refused(tmp_path, field, value, message):
    settings, journal = search_with_a_trial(tmp_path)
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    for line in lines:
        if line.get("param_name") == field:
            line["param_value_internal"] = value
        elif field in line:
            line[field] = value
    journal.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    with pytest.raises(ValueError, match=rf"out/study\.log is not .*{message}") as error:
        Search(tmp_path / "out", settings)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("cut", [1, 40, -1])
def test_a_half_written_last_line_of_the_journal_is_removed(tmp_path, cut):
    settings, journal = search_with_a_trial(tmp_path)
    content = journal.read_bytes()
    last = content.splitlines(keepends=True)[-1]
    journal.write_bytes(content.removesuffix(last) + last[:cut])
    with pytest.warns(UserWarning, match=r"removed the last line of .*study\.log"):
        search = Search(tmp_path / "out", settings)
    (trial,) = search.study.trials
    assert trial.state == optuna.trial.TrialState.RUNNING  # its end was not recorded
    search.study.tell(0, 7.5)
    assert Search(tmp_path / "out", settings).study.best_value == 7.5


def test_a_lock_that_a_killed_search_left_behind_is_removed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = Settings(RECIPE, load_space(None, RECIPE))
    Search(Path("out"), settings)
    Path("out/study.log.lock").symlink_to("out/study.log")  # relative: it leads nowhere
    search = Search(Path("out"), settings)
    search.study.ask()
    assert not Path("out/study.log.lock").is_symlink()


def test_a_resumed_search_draws_other_values(tmp_path):
    settings, _ = search_with_a_trial(tmp_path)
    search = Search(tmp_path / "out", settings)
    assert ask(search).params != search.study.trials[0].params


class DoneWorker:
    """A worker's process that has completed its run."""

    returncode = 0

    def poll(self):
        return 0


def complete(job, mean=None):
    """Completes a run; its return is its learning rate."""
    run = Run.create(job.folder, job.recipe)
    mean = job.recipe.learning_rate if mean is None else mean
    numbers = {"episodes": 1, "seed": 0, "returns": [mean], "mean": mean, "std": 0.0}
    run.save_evaluation({"env": job.recipe.env, "steps": job.recipe.final_step, **numbers})
    run.curve.touch()
    return DoneWorker()


def test_a_trial_is_not_credited_with_the_run_of_another(tmp_path, monkeypatch):
    monkeypatch.setattr("recipes.sweeps.tune.start", complete)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    settings = Settings(RECIPE, load_space(None, RECIPE))
    search = Search(tmp_path, settings)
    search.run(2, workers=1)
    best = (tmp_path / "best.json").read_text()
    assert json.loads(best)["learning_rate"] == search.study.best_value
    files = [tmp_path / f"trial-{number}.json" for number in (0, 1)]
    texts = [file.read_text() for file in files]
    for file, text in zip(files, reversed(texts), strict=True):
        file.write_text(text)
    Search(tmp_path, settings).best()
    assert (tmp_path / "best.json").read_text() == best

    (tmp_path / "trial-0").rename(tmp_path / "other")
    (tmp_path / "trial-1").rename(tmp_path / "trial-0")
    (tmp_path / "other").rename(tmp_path / "trial-1")
    with pytest.raises(ValueError, match=r"trial-0/seed-0 holds a run with other settings"):
        Search(tmp_path, settings)
    (tmp_path / "study.log").unlink()
    search = Search(tmp_path, settings)
    with pytest.raises(ValueError, match=r"trial-0/seed-0 holds a run of .* with other settings"):
        search.run(2, workers=1)
    assert search.best() is None


def test_a_search_without_its_settings_is_refused(tmp_path):
    settings = Settings(RECIPE, load_space(None, RECIPE))
    Search(tmp_path, settings)
    (tmp_path / "settings.json").unlink()
    with pytest.raises(ValueError, match=r"settings\.json is missing"):
        Search(tmp_path, settings)


@pytest.mark.parametrize("mean", [math.nan, 1e300, "high"])
def test_an_evaluation_that_cannot_be_read_fails_the_trial(mean, tmp_path, monkeypatch):
    naps = iter(range(20))  # a trial that is started again and again runs out of them
    monkeypatch.setattr("recipes.sweeps.tune.start", partial(complete, mean=mean))
    monkeypatch.setattr(time, "sleep", lambda _: next(naps))
    search = Search(tmp_path, Settings(RECIPE, load_space(None, RECIPE)))
    assert search.run(1, workers=1) == [0]
    assert "seed-0 is not complete" in (tmp_path / "trial-0" / "error.log").read_text()


def test_one_process_at_a_time(tmp_path):
    search = Search(tmp_path, Settings(RECIPE, load_space(None, RECIPE)))
    with (
        filelock.FileLock(tmp_path / ".lock"),
        pytest.raises(RuntimeError, match="is in use by another process"),
    ):
        search.run(1, workers=1)
    assert not search.study.trials


def test_seeds_that_cannot_be_are_refused_before_anything_runs(files, capsys):
    with pytest.raises(SystemExit):
        main([*words(files, 1), "--seeds", "0", "-1"])
    assert "seed must be at least 0, not -1" in capsys.readouterr().err
    assert not (files / "out").exists()


@pytest.mark.parametrize(
    "name",
    ["ppo/acrobot/enhanced-tit", "ppo/pong/vanilla-tit", "ppo/hopper/mlp", "ppo/pong/nature-cnn"],
)
def test_every_default_space_fits_its_recipes(name):
    recipe = get_recipe(name)
    space = load_space(None, recipe)
    values = {field: values.examples()[-1] for field, values in space.items()}
    assert with_values(recipe, values, Path("here")) != recipe


def test_other_algorithms_need_a_space():
    with pytest.raises(ValueError, match="there is no default search space for the algorithm dt"):
        load_space(None, get_recipe("dt/hopper-medium-v2/dt"))

"""The trials of a search as CSV, and how much each field mattered."""

import csv

import pytest

optuna = pytest.importorskip("optuna")

from recipes.sweeps.trials import importances, write_trials  # noqa: E402

FIELDS = ["learning_rate", "epochs", "backbone.trunks"]


def make_study(trials):
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(trials):
        trial = study.ask()
        rate = trial.suggest_float("learning_rate", 0, 1)
        trial.suggest_int("epochs", 1, 9)
        trial.suggest_categorical("backbone.trunks", ["shared", "separate"])
        trial.report(rate / 2, 64)
        study.tell(trial, 100 * rate)
    return study


def test_every_trial_has_a_row(tmp_path):
    study = make_study(3)
    pruned = study.ask()
    pruned.suggest_int("epochs", 1, 9)
    pruned.report(12.5, 64)
    study.tell(pruned, state=optuna.trial.TrialState.PRUNED)
    study.tell(study.ask(), state=optuna.trial.TrialState.FAIL)
    running = study.ask()
    write_trials(study, FIELDS, tmp_path)
    rows = list(csv.DictReader((tmp_path / "trials.csv").open()))
    assert [row["trial"] for row in rows] == ["0", "1", "2", "3", "4", str(running.number)]
    states = ["complete"] * 3 + ["pruned", "fail", "running"]
    assert [row["state"] for row in rows] == states
    for row, trial in zip(rows[:3], study.trials, strict=False):
        assert float(row["value"]) == trial.value
        assert float(row["learning_rate"]) == trial.params["learning_rate"]
        assert row["backbone.trunks"] == trial.params["backbone.trunks"]
        assert (row["step"], row["started"][:2]) == ("64", "20")
        assert float(row["seconds"]) >= 0
    assert (rows[3]["value"], rows[3]["learning_rate"]) == ("12.5", "")
    assert rows[4]["value"] == rows[5]["value"] == rows[5]["seconds"] == ""
    assert not (tmp_path / "importance.csv").exists(), "three complete trials say nothing"


def test_the_field_that_decides_is_the_most_important(tmp_path):
    study = make_study(30)
    write_trials(study, FIELDS, tmp_path)
    rows = list(csv.DictReader((tmp_path / "importance.csv").open()))
    assert rows[0]["field"] == "learning_rate"
    shares = [float(row["importance"]) for row in rows]
    assert sorted(row["field"] for row in rows) == sorted(FIELDS)
    assert shares[0] > 0.6
    assert sum(shares) == pytest.approx(1)


def test_equal_values_say_nothing():
    study = optuna.create_study()
    for _ in range(5):
        trial = study.ask()
        trial.suggest_float("learning_rate", 0, 1)
        study.tell(trial, 1.0)
    assert importances(study) == {}

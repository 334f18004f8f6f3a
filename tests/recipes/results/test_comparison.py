"""Is it better? Over seeds and over tasks, against numbers worked out by hand."""

import numpy as np
import pytest
from scipy.stats import trim_mean

from recipes.cli import main
from recipes.tools.results.comparison import compare, interquartile_mean, probability_of_improvement
from tests.recipes.commands import fails
from tests.recipes.results.report_runs import metrics_of, write_run

TIT, MLP = "ppo/cartpole/enhanced-tit", "ppo/cartpole/mlp"


def test_a_difference_that_every_seed_shows():
    found = compare([10.0] * 5, [7.0] * 5)
    assert (found.difference.middle, found.difference.low, found.difference.high) == (3, 3, 3)
    assert found.improvement == 1
    assert found.p == pytest.approx(2 / 252)  # of the ways to choose 5 of 10, this and its reverse
    assert found.runs == 4
    few = compare([4.0, 5.0, 6.0], [1.0, 2.0, 3.0])
    assert few.p == pytest.approx(2 / 20)
    assert np.isnan(few.difference.low)


def test_a_difference_that_needs_more_seeds():
    ours = [0.0, 1.0, 2.0, 3.0, 4.0]
    found = compare([1.0, 2.0, 3.0, 4.0, 5.0], ours)
    # (1.9600 + 0.8416)**2 * (2.5 + 2.5) / 1**2 = 39.2
    assert (found.difference.middle, found.runs) == (1, 40)
    assert found.difference.low < 0 < found.p
    # Of 25 pairs, 1 + 2 + 3 + 4 + 5 are better, and 4 are ties.
    assert found.improvement == (15 + 4 / 2) / 25
    same = compare(ours, ours)
    assert (same.improvement, same.p) == (0.5, 1)
    assert np.isnan(same.runs)
    assert np.isnan([compare([1.0], [2.0]).p, compare([1.0], [2.0]).runs]).all()


def test_all_tasks_count_equally_and_runs_are_drawn_within_their_task():
    assert interquartile_mean({"a": [0.0, 1.0], "b": [2.0, 3.0]}).middle == 1.5
    assert interquartile_mean({"a": [0.0] * 4, "b": [1.0, 3.0]}).middle == 0.5
    found = interquartile_mean({task: [task, task] for task in (1.0, 2.0, 3.0, 4.0)})
    assert (found.middle, found.low, found.high) == (2.5, 2.5, 2.5)
    ours = {"a": [2.0, 3.0], "b": [1.0, 1.0]}
    others = {"b": [0.0, 0.0], "a": [1.0, 3.0]}
    assert np.isnan(probability_of_improvement(ours, others).low)  # of four runs each
    ours["b"].append(1.0)
    assert np.isnan(probability_of_improvement(ours, others).low)
    others["b"].append(0.0)
    improved = probability_of_improvement(ours, others)
    assert improved.middle == (0.625 + 1) / 2
    assert (improved.low, improved.high) == (0.5, 1)
    single = {"a": [2.0, 3.0], "b": [1.0]}
    assert str(interquartile_mean(single)) == "1.5"  # no interval
    assert np.isnan(probability_of_improvement(single, others).low)


def test_a_summary_is_of_half_of_the_runs_however_many_there_are():
    """Else networks with more runs would be compared by another statistic."""
    runs = [1.0, 2.0, 3.0, 4.0, 100.0, 100.0]
    middle = (2.0 / 2 + 3 + 4 + 100 / 2) / 3  # a quarter is one run and a half
    for repeated in ({"a": runs}, {"a": runs * 4}, {"a": runs, "b": runs}):
        assert interquartile_mean(repeated).middle == pytest.approx(middle)
    groups = {count: np.random.default_rng(count).normal(size=count) for count in range(7, 12)}
    equal = np.concatenate([x.repeat(4 * 27720 // count) for count, x in groups.items()])
    found = interquartile_mean({count: x.tolist() for count, x in groups.items()})
    assert found.middle == pytest.approx(trim_mean(equal, 0.25))


def test_compare_says_which_is_better(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for seed in range(5):
        write_run(tmp_path / "tit" / str(seed), TIT, seed, [480.0 + seed])
        write_run(tmp_path / "mlp" / str(seed), MLP, seed, [490.0 + seed])
    main(["compare", "mlp"])
    assert "better" not in capsys.readouterr().out
    main(["compare", "tit", "mlp"])
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ppo")]
    assert rows[0] == f"| {TIT} | 5 | 482 ± 2 |  |  |  |  |"
    assert rows[1].startswith(f"| {MLP} | 5 | 492 ± 2 | 10.0 [8")
    assert rows[1].endswith("| 1 | 0.00794 | 4 |")


def test_compare_names_what_does_not_count_and_what_differs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for seed, rows in enumerate([60, 60, 20]):
        write_run(tmp_path / "tit" / str(seed), TIT, seed, metrics=metrics_of(seed, rows))
    write_run(tmp_path / "hidden", MLP, hide_velocities=True)
    main(["compare", "tit"])
    said = capsys.readouterr().err
    assert f"{TIT}, seed 2 is at 20,480 of 61,440 steps: bold lines leave it out" in said
    main(["compare", "tit", "hidden"])
    assert "has another task than ppo/cartpole/enhanced-tit: hide_vel" in capsys.readouterr().err


@pytest.fixture
def tasks(tmp_path):
    """Runs of two networks on CartPole and Acrobot, and of one on MountainCar."""
    means = {"cartpole": (500.0, 250.0), "acrobot": (-80.0, -90.0), "mountaincar": (-110.0,)}
    for task, values in means.items():
        for network, mean in zip(("enhanced-tit", "mlp"), values, strict=False):
            for seed in range(2):
                folder = tmp_path / task / network / str(seed)
                write_run(folder, f"ppo/{task}/{network}", seed, [mean])
    return tmp_path


def test_summary(tasks, capsys):
    main(["summary", str(tasks), "--networks", "mlp", "enhanced-*"])
    printed = capsys.readouterr()
    # (250 - 23.68) / (500 - 23.68) = 0.475; (-90 + 497.08) / (-73.506 + 497.08) = 0.961
    assert "| mlp | 2 | 4 | 0.718 |  |" in printed.out
    assert "| enhanced-* | 2 | 4 | 0.992 | 1 |" in printed.out
    assert "MountainCar-v0 is left out of enhanced-*: not all networks have" in printed.err
    file = tasks / "mine.csv"
    file.write_text(
        "env,random,best\nCartPole-v1,0,1000\nAcrobot-v1,-180,-80\nMountainCar-v0,0,1\n"
    )
    main(["summary", str(tasks), "--networks", "mlp", "--references", str(file)])
    assert "MountainCar-v0" not in capsys.readouterr().err
    main(["summary", str(tasks / "cartpole"), "--references", str(file)])
    assert "| mlp | 1 | 2 | 0.25 |" in capsys.readouterr().out


def test_a_summary_says_which_settings_differ(tasks, capsys):
    main(["summary", str(tasks)])
    assert "settings" not in capsys.readouterr().err
    for seed in range(2):
        changes = {"total_steps": 122_880, "epochs": 5}
        write_run(tasks / "long" / str(seed), "ppo/cartpole/lstm", seed, [1.0], **changes)
    main(["summary", str(tasks / "cartpole"), str(tasks / "long")])
    said = capsys.readouterr().err
    assert "lstm has changed settings on CartPole-v1: total_steps 122880, epochs 5\n" in said
    assert "runs of CartPole-v1 have different lengths: 100352, 122880 steps\n" in said
    assert "algorithms" not in said
    assert "normalized as" not in said
    write_run(tasks / "hidden", "ppo/cartpole/mlp", 0, [1.0], hide_velocities=True)
    main(["summary", str(tasks / "hidden")])
    said = capsys.readouterr().err
    assert "CartPole-v1 of mlp is normalized as the task without its hide_velocities\n" in said
    write_run(tasks / "dqn", "dqn/cartpole/mlp", 0, [-80.0], env="Acrobot-v1")
    main(["summary", str(tasks / "cartpole" / "mlp"), str(tasks / "dqn")])
    assert "several algorithms count together: dqn, ppo\n" in capsys.readouterr().err


def test_what_cannot_be_summarized(tasks, capsys):
    write_run(tasks / "more", "ppo/cartpole/mlp", 0, [1.0], epochs=5)
    write_run(tasks / "own" / "a", "ppo/enhanced-tit", 0, [1.0], env="Taxi-v4")
    (tasks / "bad.csv").write_text("env,random\nCartPole-v1,0\n")
    (tasks / "flat.csv").write_text("env,random,best\nCartPole-v1,5,5\n")
    (tasks / "endless.csv").write_text("env,random,best\nCartPole-v1,5,inf\n")
    only = [str(tasks / "cartpole")]
    for words, message in {
        (str(tasks / "more"), *only): "mlp has two settings on CartPole-v1",
        (str(tasks / "own"),): "no reference returns for Taxi-v4: give a CSV file",
        (*only, "--networks", "lstm"): "no evaluated run of lstm",
        (*only, "--references", str(tasks / "bad.csv")): "bad.csv must be a CSV file with the",
        (*only, "--references", str(tasks / "flat.csv")): "is not for CartPole-v1",
        (*only, "--references", str(tasks / "endless.csv")): "finite, but is not for CartPole-v1",
        (str(tasks / "mountaincar"), str(tasks / "cartpole" / "mlp")): "no task has runs of all",
    }.items():
        assert message in fails(capsys, "summary", *words)

"""From run folders to the paper's tables."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from recipes.cli import main
from recipes.recipe_json import recipe_to_json
from recipes.registry import RECIPES, get_recipe
from recipes.results import plot
from recipes.results.reported import paper_results, published_results
from recipes.results.table import make_table, to_csv, to_markdown
from recipes.run import Run
from torchrl_tit.settings import Linear
from torchrl_tit.settings.networks import enhanced_tit, mlp


def write_run(folder, of, seed, returns, **fields):
    recipe = replace(get_recipe(of), seed=seed, **fields)
    folder.mkdir(parents=True)
    (folder / "recipe.json").write_text(recipe_to_json(recipe))
    if returns is not None:
        returns = returns * (recipe.evaluation_episodes // len(returns))
        evaluation = {
            "mean": float(np.mean(returns)),
            "std": float(np.std(returns)),
            "episodes": recipe.evaluation_episodes,
            "seed": recipe.evaluation_seed,
            "env": recipe.env,
            "returns": returns,
            "steps": recipe.final_step,
        }
        (folder / "evaluation.json").write_text(json.dumps(evaluation))
    return folder


@pytest.fixture
def runs(tmp_path):
    name = "ppo/acrobot/enhanced-tit"
    for seed, mean in enumerate([-80, -90, -500, -85, -81]):
        write_run(tmp_path / name / str(seed), name, seed, [mean - 10.0, mean + 10.0])
    protocol = "ppo/cartpole/vanilla-tit-protocol"
    write_run(tmp_path / protocol / "0", protocol, 0, [500.0, 400.0])
    write_run(tmp_path / protocol / "1", protocol, 1, None)
    hidden = "ppo/cartpole-no-velocity/mlp"
    write_run(tmp_path / hidden / "0", hidden, 0, [40.0])
    return tmp_path


def test_numbers(runs):
    cells, notes = make_table([runs])
    acrobot, cartpole, hidden = cells
    assert (acrobot.recipe, acrobot.runs) == ("ppo/acrobot/enhanced-tit", 5)
    assert acrobot.mean == pytest.approx(-836 / 5)
    assert acrobot.std == pytest.approx(np.std([-80, -90, -500, -85, -81]))
    assert acrobot.std_episodes == pytest.approx(10)
    assert acrobot.iqm == pytest.approx((-81 - 85 - 90) / 3)  # a quarter is cut at both ends
    assert acrobot.low < acrobot.iqm < acrobot.high
    assert (acrobot.paper_mean, acrobot.paper_std) == (-81, 17)
    # A recipe with other settings stands beside the paper's value of the plain one.
    assert (cartpole.paper_mean, cartpole.table) == (500, "online, arrays")
    assert np.isnan([cartpole.low, cartpole.high, hidden.paper_mean]).all()
    assert hidden.table == "not in the paper"
    (note,) = notes
    assert "vanilla-tit-protocol/1 is left out: it has no evaluation yet" in note


def test_scores_count_where_there_are_some(tmp_path):
    name = "ppo/acrobot/mlp"
    for seed, best in enumerate([50.0, 60.0]):
        folder = write_run(tmp_path / str(seed), name, seed, [1.0, 3.0])
        evaluation = json.loads((folder / "evaluation.json").read_text())
        evaluation |= {"score": {"best": best, "last": 1.0}, "score_std": 4.0}
        (folder / "evaluation.json").write_text(json.dumps(evaluation))
    ((cell,), _) = make_table([tmp_path])
    assert (cell.mean, cell.std, cell.std_episodes) == (55, 5, 4)


def test_offline_results_stand_beside_the_papers(tmp_path):
    """Best normalised scores, in the paper's order, each network beside its own number."""
    numbers = {"mlp": (58.8, 12.7), "enhanced-tit": (99.2, 1.7)}
    for network in numbers:
        for seed, best in enumerate([70.0, 80.0, 90.0]):
            name = f"cql/hopper-medium-replay-v0/{network}"
            folder = write_run(tmp_path / network / str(seed), name, seed, [1000.0, 1200.0])
            evaluation = json.loads((folder / "evaluation.json").read_text())
            evaluation |= {"score": {"best": best, "last": 30.0}, "score_std": 3.0}
            (folder / "evaluation.json").write_text(json.dumps(evaluation))
    cells, notes = make_table([tmp_path])
    assert not notes
    for cell, (network, paper) in zip(cells, numbers.items(), strict=True):
        assert (cell.table, cell.recipe.rsplit("/")[-1], cell.runs) == ("offline", network, 3)
        assert (cell.mean, cell.std) == pytest.approx((80, np.std([70, 80, 90])))
        assert (cell.steps, cell.std_episodes) == (500_000, 3)
        assert (cell.paper_mean, cell.paper_std) == paper
    text = to_markdown(cells)
    assert "### Offline" in text
    assert "| cql/hopper-medium-replay-v0/enhanced-tit | 3 | 80.0 ± 8.2 | 3.0 |" in text
    assert text.count("| 99.2 ± 1.7 |") == 1


def test_other_data_do_not_stand_beside_the_papers_numbers(tmp_path):
    name = "dt/hopper-medium-replay-v2/dt"
    known = {"hopper-medium-replay-v2": True, "data/hopper_medium_replay-v2.hdf5": True}
    for number, (dataset, expected) in enumerate({**known, "mine.hdf5": False}.items()):
        folder = tmp_path / str(number)
        write_run(folder, name, 0, [1000.0, 1200.0], dataset=dataset)
        ((cell,), _) = make_table([folder])
        assert (cell.table == "offline") == expected
        assert (cell.paper_mean == 71.0) == expected
    write_run(tmp_path / "other", "dt/walker2d-medium-replay-v2/dt", 0, [1.0])
    cells, _ = make_table([tmp_path / "2", tmp_path / "other"])
    assert [cell.table for cell in cells] == ["offline", "not in the paper"]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"learning_rate": 1e-3, "total_steps": 1000}, True),
        ({"env": "CartPole-v1"}, False),
        ({"env_settings": ("max_episode_steps=9",)}, False),
        ({"wrappers": ("gymnasium.wrappers:TimeLimit(max_episode_steps=9)",)}, False),
        ({"hide_velocities": True}, False),
        ({"backbone": mlp(hidden_dim=256)}, False),
        ({"name": "ppo/acrobot/mine"}, False),
    ],
)
def test_another_task_or_network_does_not_stand_beside_the_papers(changes, expected, tmp_path):
    write_run(tmp_path / "run", "ppo/acrobot/mlp", 0, [-80.0], **changes)
    ((cell,), _) = make_table([tmp_path])
    assert (cell.table == "online, arrays") == expected
    assert (cell.paper_mean == cell.paper_mean) == expected


def test_scores_and_returns_are_not_of_one_measure(tmp_path):
    name = "cql/hopper-medium-v0/mlp"
    for number, env in enumerate(["Hopper-v4", "Reacher-v5"]):
        folder = write_run(tmp_path / str(number), name, 0, [10.0], env=env)
        evaluation = json.loads((folder / "evaluation.json").read_text())
        evaluation |= {"score": {"best": 10.0, "last": 10.0}, "score_std": 0.0}
        (folder / "evaluation.json").write_text(json.dumps(evaluation))
    cells, _ = make_table([tmp_path])
    assert [cell.measure for cell in cells] == ["normalized score", "return"]
    picture = tmp_path / "table.png"
    figures: list[Figure] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot, "save_figure", lambda figure, _: figures.append(figure))
        plot.plot_table(cells, picture)
    panels = [axes for axes in figures[0].axes if axes.get_visible()]
    assert [axes.get_xlabel() for axes in panels] == ["normalized score", "return"]


def test_every_value_of_the_paper_belongs_to_a_recipe():
    assert set(paper_results()) <= set(RECIPES)
    online = {name for name, result in paper_results().items() if name.startswith("ppo/")}
    assert len(online) == 30 + 29 + 12  # arrays, images, ablation
    assert len(paper_results()) - len(online) == 12 + 12  # CQL, Decision Transformer


def test_published_results_stand_beside_the_same_task_and_network(tmp_path):
    """CleanRL's and the RL Zoo's numbers for an MLP on Acrobot, and for nothing else."""
    assert set(published_results()) <= set(RECIPES)
    for of, fields in (
        ("ppo/acrobot/mlp", {}),
        ("ppo/acrobot/mlp", {"env": "CartPole-v1"}),
        ("ppo/acrobot/enhanced-tit", {}),
    ):
        name = f"{of}-{len(fields)}"
        write_run(tmp_path / name, of, 0, [-90.0, -80.0], **fields)
    cells, _ = make_table([tmp_path])
    sources = {cell.label: [result.source for result in cell.published] for cell in cells}
    assert sources == {
        "ppo/acrobot/mlp": ["CleanRL", "RL Zoo"],
        "ppo/acrobot/mlp (env CartPole-v1)": [],
        "ppo/acrobot/enhanced-tit": [],
    }
    cleanrl = published_results()["ppo/acrobot/mlp"][0]
    assert (cleanrl.mean, cleanrl.std) == (-86.36, 1.32)
    text = to_markdown(cells)
    assert f"[CleanRL]({cleanrl.url}) -86.4 ± 1.3 (training return after 500k steps" in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert "| published |" in lines[0], "the paper's table has the column"
    assert "CleanRL -86.36 ± 1.32" in to_csv(cells)
    alone, _ = make_table([tmp_path / "ppo/acrobot/enhanced-tit-0"])
    assert "published" not in to_markdown(alone)


def test_command(runs, tmp_path, capsys):
    out = tmp_path / "tables"
    main(["table", str(runs / "ppo"), "--out", str(out)])
    printed = capsys.readouterr()
    assert "| ppo/acrobot/enhanced-tit | 5 | -167 ± 166 | 10.0 |" in printed.out
    assert "note: " in printed.err
    assert (out / "table.md").read_text() in printed.out
    rows = list(csv.DictReader(io.StringIO((out / "table.csv").read_text())))
    assert rows[1]["low"] == ""
    assert float(rows[0]["paper_mean"]) == -81
    assert (out / "table.png").read_bytes().startswith(b"\x89PNG")
    main(["table", str(runs / "ppo"), "--format", "csv"])
    assert capsys.readouterr().out == (out / "table.csv").read_text()


def test_markdown_and_csv_hold_the_same_recipes(runs):
    cells, _ = make_table([runs])
    for cell in cells:
        assert cell.recipe in to_markdown(cells)
        assert cell.recipe in to_csv(cells)


def test_fewer_episodes_are_named(tmp_path):
    folder = write_run(tmp_path / "run", "ppo/cartpole/mlp", 0, [20.0, 30.0])
    evaluation = json.loads((folder / "evaluation.json").read_text())
    assert make_table([tmp_path])[1] == []
    fewer = evaluation | {"episodes": 2, "returns": [20.0, 30.0]}
    (folder / "evaluation.json").write_text(json.dumps(fewer))
    assert make_table([tmp_path])[1] == [f"{folder} was evaluated over 2 episodes, not 100"]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"mean": float("nan")}, "at `$.mean`"),
        ({"mean": 26.0}, "the 'mean' 26.0, but that of its 'returns' is 25.0"),
        ({"std": -1.0}, "Expected `float` >= 0.0 - at `$.std`"),
        ({"std": 1.0}, "the 'std' 1.0, but that of its 'returns' is 5.0"),
        ({"returns": [1e300] * 100}, "at `$.returns[0]`"),
        ({"returns": [25.0]}, "not have a return for each of its 'episodes'"),
        ({"steps": -5}, "Expected `int` >= 0 - at `$.steps`"),
        ({"steps": 10**400}, "at `$.steps`"),
        ({"episodes": "100\x1b[2J"}, "Expected `int`, got `str` - at `$.episodes`"),
        ({"score": {"best": float("inf"), "last": 0.0}}, "at `$.score.best`"),
        ({"score_std": -1.0}, "Expected `float` >= 0.0 - at `$.score_std`"),
    ],
)
def test_wrong_evaluations_are_no_results(tmp_path, capsys, changes, reason):
    write_run(tmp_path / "good", "ppo/cartpole/d2rl", 0, [1.0])
    folder = write_run(tmp_path / "run", "ppo/cartpole/mlp", 0, [20.0, 30.0])
    evaluation = json.loads((folder / "evaluation.json").read_text()) | changes
    (folder / "evaluation.json").write_text(json.dumps(evaluation))
    main(["table", str(tmp_path)])
    printed = capsys.readouterr()
    assert f"run is left out: {folder / 'evaluation.json'} is damaged" in printed.err
    assert reason in printed.err
    assert "mlp" not in printed.out
    assert not Run.open(folder).is_complete()


def test_text_of_files_does_not_control_the_terminal(tmp_path, capsys):
    name = "cql/hopper-medium-replay-v0/mlp"
    write_run(tmp_path / "run", name, 0, [1.0], dataset="a\x1b[2J\n| fake | 1 |.hdf5")
    (tmp_path / "no\x1b[31m").mkdir()
    write_run(tmp_path / "no\x1b[31m" / "run", name, 1, None)
    main(["table", str(tmp_path)])
    printed = capsys.readouterr()
    assert "dataset a\\x1b[2J\\n| fake" in printed.out
    assert "no\\x1b[31m" in printed.err
    assert "\x1b" not in printed.out + printed.err


def test_runs_whose_schedules_followed_other_lengths_are_named(tmp_path):
    """A learning rate that fell to 0 once is not that of a run with the whole length."""
    folder = write_run(tmp_path / "run", "ppo/cartpole/mlp", 0, [20.0], total_steps=1024)
    run = Run.open(folder)
    run.lengthen(2048)  # nothing is trained yet
    for step, length in {1024: 3072, 2048: 3072, 3072: 4096}.items():
        run.save(step, {"networks": {}})
        run.lengthen(length)
    evaluation = json.loads((folder / "evaluation.json").read_text())
    (folder / "evaluation.json").write_text(json.dumps(evaluation | {"steps": 4096}))
    assert make_table([tmp_path])[1] == [
        f"{folder} changed its length: for decay_learning_rate, total_steps was "
        "2048 until step 1024, 3072 until step 3072"
    ]


def test_runs_without_schedules_may_have_any_length(tmp_path):
    name = "ppo/cartpole/vanilla-tit-protocol"
    folder = write_run(tmp_path / "run", name, 0, [20.0], total_steps=2048)
    run = Run.open(folder)
    run.save(2048, {"networks": {}})
    run.lengthen(4096)
    assert run.earlier_lengths() == []


@pytest.mark.parametrize("text", ["[[1024]]", "1024", '[["many", 1024]]', ""])
def test_damaged_lengths_are_named(tmp_path, text):
    folder = write_run(tmp_path / "run", "ppo/cartpole/mlp", 0, [20.0])
    (folder / "earlier_lengths.json").write_text(text)
    with pytest.raises(ValueError, match=r"earlier_lengths\.json is damaged: expected pairs of"):
        make_table([tmp_path])


def test_what_was_changed_is_named(tmp_path):
    wide = mlp(hidden_dim=256)
    write_run(tmp_path / "0", "ppo/cartpole/mlp", 3, [20.0], total_steps=1000, backbone=wide)
    write_run(tmp_path / "1", "ppo/cartpole/d2rl", 0, [500.0])
    cells, _ = make_table([tmp_path])
    assert [cell.changes for cell in cells] == [
        "",
        "backbone.history.hidden_dim 256, total_steps 1000",
    ]
    text = to_markdown(cells)
    assert (
        "| ppo/cartpole/mlp (backbone.history.hidden_dim 256, total_steps 1000) | 1 | 20.0" in text
    )
    assert "| ppo/cartpole/d2rl | 1 | 500" in text


def test_another_encoder_is_named_with_its_fields(tmp_path):
    network = enhanced_tit(dense=False)
    write_run(tmp_path / "0", "ppo/cartpole/enhanced-tit-protocol", 0, [20.0], backbone=network)
    ((cell,), _) = make_table([tmp_path])
    assert cell.changes == "backbone.frame.every_block False"
    linear = replace(network, frame=Linear(embed_dim=8))
    write_run(tmp_path / "1", "ppo/cartpole/enhanced-tit", 0, [20.0], backbone=linear)
    ((cell,), _) = make_table([tmp_path / "1"])
    assert "backbone.frame.encoder linear, backbone.frame.embed_dim 8" in cell.changes


def test_other_settings_under_one_name_are_another_cell(tmp_path):
    for seed in (0, 1):
        for rate in (3e-4, 1e-3):
            folder = tmp_path / f"{seed}-{rate}"
            write_run(folder, "ppo/acrobot/mlp", seed, [rate * 1e4], learning_rate=rate)
    cells, _ = make_table([tmp_path])
    found = [(cell.recipe, cell.changes, cell.runs, round(cell.mean, 9)) for cell in cells]
    assert found == [
        ("ppo/acrobot/mlp", "", 2, 3),
        ("ppo/acrobot/mlp", "learning_rate 0.001", 2, 10),
    ]


def test_other_settings_under_a_name_of_ones_own(tmp_path):
    for number, epochs in enumerate([4, 5]):
        folder = tmp_path / str(number)
        write_run(folder, "ppo/acrobot/mlp", 0, [1.0], name="mine", epochs=epochs)
    cells, _ = make_table([tmp_path])
    assert [(cell.label, cell.runs) for cell in cells] == [("mine", 1), ("mine (epochs 5)", 1)]


def test_runs_without_a_name_are_called_as_their_folder(tmp_path):
    for number, epochs in enumerate([4, 4, 5]):
        folder = tmp_path / str(number)
        write_run(folder, "ppo/acrobot/mlp", number, [1.0], name="", epochs=epochs)
    cells, _ = make_table([tmp_path])
    assert [(cell.label, cell.runs) for cell in cells] == [
        (str(tmp_path / "0"), 2),
        (str(tmp_path / "2"), 1),
    ]


def test_the_same_seed_twice(runs):
    write_run(runs / "more", "ppo/acrobot/enhanced-tit", 4, [1.0])
    with pytest.raises(ValueError, match="with seed 4; name one of them only"):
        make_table([runs])


def test_folders_without_runs(tmp_path, runs):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty holds no run folder"):
        make_table([tmp_path / "empty"])
    with pytest.raises(ValueError, match=r"no evaluated run in .*has no evaluation yet"):
        make_table([runs / "ppo/cartpole/vanilla-tit-protocol/1"])


def test_runs_of_other_machines_are_of_one_experiment(tmp_path):
    name = "ppo/cartpole/mlp"
    write_run(tmp_path / "0", name, 0, [20.0], threads=2, compile="on")
    write_run(tmp_path / "1", name, 1, [30.0], compile="off", checkpoint_interval=2048)
    ((cell,), _) = make_table([tmp_path])
    assert (cell.runs, cell.mean, cell.changes) == (2, 25.0, "")

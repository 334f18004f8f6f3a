"""From run folders to the paper's tables."""

import csv
import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recipes.cli import main
from recipes.core.registry import RECIPES
from recipes.core.run import Run
from recipes.tools.results import table
from recipes.tools.results.paper import paper_cells
from recipes.tools.results.table import make_table, published_results, to_csv, to_markdown
from tests.recipes.results.report_runs import write_run
from torchrl_tit.settings import Linear
from torchrl_tit.settings.networks import enhanced_tit, mlp

MLP = "ppo/cartpole/mlp"


@pytest.fixture
def runs(tmp_path):
    name = "ppo/acrobot/enhanced-tit"
    for seed, mean in enumerate([-80, -90, -500, -85, -81]):
        write_run(tmp_path / name / str(seed), name, seed, [mean - 10.0, mean + 10.0])
    protocol = "ppo/cartpole/vanilla-tit-protocol"
    write_run(tmp_path / protocol / "0", protocol, 0, [500.0, 400.0])
    write_run(tmp_path / protocol / "1", protocol, 1)
    hidden = "ppo/cartpole-no-velocity/mlp"
    write_run(tmp_path / hidden / "0", hidden, 0, [40.0])
    return tmp_path


def scored(last, std=4.0):
    return {"score": {"best": last + 5, "last": last}, "score_std": std}


def test_numbers(runs):
    (acrobot, cartpole, hidden), notes = make_table([runs])
    assert (acrobot.recipe, acrobot.runs) == ("ppo/acrobot/enhanced-tit", 5)
    assert acrobot.mean == pytest.approx(-836 / 5)
    assert acrobot.std == pytest.approx(np.std([-80, -90, -500, -85, -81], ddof=1))
    assert acrobot.std_episodes == pytest.approx(10)
    assert acrobot.iqm == pytest.approx((-81 - 85 - 90) / 3)  # a quarter is cut at both ends
    assert acrobot.low < acrobot.iqm < acrobot.high
    assert (acrobot.paper_mean, acrobot.paper_std) == (-81, 17)
    # One with other settings stands near the paper's value.
    assert acrobot.paper.startswith("near -81 ± 17: backbone.frame.patch_size auto, ")
    assert (cartpole.paper, cartpole.table) == ("500 ± 0", "table 2: online, arrays")
    # Two runs have no interquartile mean, and one has no deviation.
    assert np.isnan([cartpole.iqm, cartpole.low, cartpole.high, hidden.paper_mean]).all()
    assert np.isnan([hidden.std])
    assert "Fewer than 5 runs" not in to_markdown([acrobot])
    assert "Fewer than 5 runs" in to_markdown([acrobot, cartpole])
    assert hidden.table == "not in the paper"
    (note,) = notes
    assert "vanilla-tit-protocol/1 is left out: it has no evaluation yet" in note


def test_last_scores_stand_beside_the_papers_in_its_order(tmp_path):
    numbers = {"mlp": (58.8, 12.7), "enhanced-tit": (99.2, 1.7)}
    for network in reversed(numbers):
        for seed, last in enumerate([70.0, 80.0, 90.0]):
            name = f"cql/hopper-medium-replay-v0/{network}"
            folder = tmp_path / network / str(seed)
            write_run(folder, name, seed, [1000.0, 1200.0], evaluation=scored(last, 3.0))
    cells, notes = make_table([tmp_path])
    assert not notes
    for cell, (network, paper) in zip(cells, numbers.items(), strict=True):
        assert (cell.recipe.rsplit("/")[-1], cell.runs) == (network, 3)
        assert (cell.mean, cell.std) == pytest.approx((80, np.std([70, 80, 90], ddof=1)))
        assert (cell.steps, cell.std_episodes) == (500_000, 3)
        assert (cell.paper_mean, cell.paper_std) == paper
        assert cell.best == 85
    text = to_markdown(cells)
    assert "### Table 3: offline" in text
    assert "| cql/hopper-medium-replay-v0/enhanced-tit | 3 | 80 ± 10 | 3 | - |" in text
    assert text.count("| near 99.2 ± 1.7: evaluated on MuJoCo's v2, here v4 | 85 |") == 1
    assert "| highest evaluation | published |" in text
    assert "[d3rlpy](https://github.com/takuseno/d3rlpy-benchmarks) 85.1 ± 16.2" in text
    assert "[CQL's authors](https://arxiv.org/abs/2006.04779) 48.6 (no spread given)" in text


def test_scores_and_returns_are_not_of_one_measure(tmp_path, monkeypatch):
    for number, env in enumerate(["Hopper-v4", "Reacher-v5"]):
        name, folder = "cql/hopper-medium-v0/mlp", tmp_path / str(number)
        write_run(folder, name, 0, [10.0], evaluation=scored(10.0, 0.0), env=env)
    cells, _ = make_table([tmp_path])
    assert [cell.measure for cell in cells] == ["normalized score", "return"]
    figures = []
    monkeypatch.setattr(table, "save_figure", lambda figure, _: figures.append(figure))
    table.plot_table(cells, tmp_path / "table.png")
    panels = [axes for axes in figures[0].axes if axes.get_visible()]
    assert [axes.get_xlabel() for axes in panels] == ["normalized score", "return"]


WIDE: dict[str, Any] = {"embed_dim": 64, "features_dim": 128, "activation_head": "relu"}
IMAGES: dict[str, Any] = {
    **{"attention_dropout_inner": 0.1, "attention_dropout_outer": 0.1},
    **{"ffn_dropout_inner": 0.1, "ffn_dropout_outer": 0.1},
    **{"embed_dim": 128, "num_heads_inner": 2, "num_heads_outer": 4, "num_blocks": 4},
}
OF_CQL: dict[str, Any] = {
    **{"patch_size": 11, "embed_dim": 256, "num_heads_outer": 4, "ffn_dropout_outer": 0.1},
    **{"ffn_expansion_inner": 1, "ffn_expansion_outer": 1},
}


@pytest.mark.parametrize(
    ("of", "changes", "expected"),
    [
        ("ppo/acrobot/mlp-protocol", {}, "-81 ± 11"),
        ("ppo/acrobot/mlp-protocol", {"total_steps": 1000}, "near -81 ± 11: total_steps 1000"),
        ("ppo/acrobot/mlp", {}, "near -81 ± 11: num_envs 8, ..."),
        ("ppo/acrobot/mlp-protocol", {"env": "CartPole-v1"}, ""),
        (
            "ppo/acrobot/mlp-protocol",
            {"wrappers": ("gymnasium.wrappers:TimeLimit(max_episode_steps=9)",)},
            "",
        ),
        ("ppo/acrobot/mlp-protocol", {"name": "ppo/acrobot/mine"}, ""),
        # The paper lists widths 32 and 64, and leaves the features and the head's activation open.
        ("ppo/acrobot/enhanced-tit-protocol", {"backbone": enhanced_tit(**WIDE)}, "-81 ± 17"),
        (
            "ppo/breakout/enhanced-tit-protocol",
            {"backbone": enhanced_tit(4, patch_size=6, **IMAGES)},
            "321 ± 68",
        ),
        (
            "ppo/breakout/enhanced-tit-protocol",
            {"backbone": enhanced_tit(4, patch_size=7, **IMAGES)},
            "near 321 ± 68: backbone.frame.patch_size 7",
        ),
        ("ppo/breakout/nature-cnn-protocol", {"sequence_length": 1}, "391 ± 26"),
        ("ppo/breakout/coberl-tuned", {}, "near 358 ± 34: the paper does not say..."),
        # The authors' code and the paper name two networks. What neither has is only near.
        ("ppo/mountaincar/enhanced-tit-protocol", {}, "-97 ± 7"),
        ("ppo/mountaincar/enhanced-tit-paper", {}, "-97 ± 7"),
        (
            "cql/hopper-medium-v0/enhanced-tit",
            {"backbone": enhanced_tit(**OF_CQL, features_dim=512, activation_head="gelu")},
            "near 100.8 ± 0.2: evaluated on MuJoCo's v2, here v4",
        ),
        (
            "cql/hopper-medium-v0/enhanced-tit",
            {"backbone": enhanced_tit(**{**OF_CQL, "embed_dim": 32})},
            "near 100.8 ± 0.2: backbone.frame.embed_dim 32, evaluated...",
        ),
        ("ppo/ant/mlp-protocol", {}, "near 2284 ± 584: Ant-v3, which Gymnasium no longer has"),
        (
            "dt/hopper-medium-replay-v2/dt",
            {"dataset": "a/hopper_medium_replay-v2.hdf5"},
            "near 71.0 ± 4.7 (from its curves ± 4.1): evaluated on MuJoCo's v3, here v4",
        ),
        ("dt/hopper-medium-replay-v2/dt", {"dataset": "mine.hdf5"}, ""),
    ],
)
def test_a_number_of_the_paper_stands_beside_what_it_was_measured_with(
    of, changes, expected, tmp_path
):
    write_run(tmp_path / "run", of, 0, [-80.0], **changes)
    ((cell,), _) = make_table([tmp_path])
    assert cell.paper.startswith(expected.removesuffix("..."))
    assert cell.paper == expected or expected.endswith("...")
    assert bool(cell.paper) == bool(expected) == (cell.table != "not in the paper")


def test_every_value_of_the_paper_belongs_to_a_recipe():
    recipes = [name for cell in paper_cells() for name in cell.recipes]
    assert len(recipes) == len({*recipes})
    assert {*recipes, *published_results()} <= set(RECIPES)
    ours = [cell for cell in paper_cells() if cell.recipes]
    assert len([cell for cell in ours if cell.recipes[0].startswith("ppo/")]) == 30 + 32 + 12
    assert len(ours) == 30 + 32 + 12 + 12 + 12  # arrays, images, ablation; CQL, DT
    quoted = [cell for cell in paper_cells() if not cell.recipes]
    assert len(quoted) == 4 + 6 + 12 + 6
    assert all(cell.note.startswith("quoted from ") for cell in quoted)


def test_published_results_stand_beside_the_same_task_and_network(tmp_path):
    for number, (of, fields) in enumerate(
        [
            ("ppo/acrobot/mlp", {}),
            ("ppo/acrobot/mlp", {"env": "CartPole-v1"}),
            ("ppo/acrobot/enhanced-tit", {}),
        ]
    ):
        write_run(tmp_path / str(number), of, 0, [-90.0, -80.0], **fields)
    cells, _ = make_table([tmp_path])
    assert {cell.label: [result.source for result in cell.published] for cell in cells} == {
        "ppo/acrobot/mlp": ["CleanRL", "RL Zoo"],
        "ppo/acrobot/mlp (env CartPole-v1)": [],
        "ppo/acrobot/enhanced-tit": [],
    }
    cleanrl = published_results()["ppo/acrobot/mlp"][0]
    assert (cleanrl.mean, cleanrl.std) == (-86.36, 1.32)
    text = to_markdown(cells)
    assert f"[CleanRL]({cleanrl.url}) -86.4 ± 1.3 (training return after 500k steps" in text
    assert "| published |" in text
    assert "CleanRL -86.36 ± 1.32" in to_csv(cells)
    assert "published" not in to_markdown(make_table([tmp_path / "2"])[0])


def test_of_a_folder_that_is_a_file(runs, tmp_path, capsys):
    (tmp_path / "table.md").touch()
    with pytest.raises(SystemExit):
        main(["table", str(runs / "ppo"), "--out", str(tmp_path / "table.md")])
    assert "table.md is a file, but must be a folder" in capsys.readouterr().err


def test_command(runs, tmp_path, capsys):
    out = tmp_path / "tables"
    main(["table", str(runs / "ppo"), "--out", str(out)])
    printed = capsys.readouterr()
    assert "| ppo/acrobot/enhanced-tit | 5 | -167 ± 186 | 10 |" in printed.out
    assert "note: " in printed.err
    assert (out / "table.md").read_text() in printed.out
    rows = list(csv.DictReader(io.StringIO((out / "table.csv").read_text())))
    assert rows[1]["low"] == ""
    assert float(rows[0]["paper_mean"]) == -81
    assert (out / "table.png").read_bytes().startswith(b"\x89PNG")
    main(["table", str(runs / "ppo"), "--format", "csv"])
    assert capsys.readouterr().out == (out / "table.csv").read_text()


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
        ({"seed": -1}, "Expected `int` >= 0 - at `$.seed`"),
        ({"episodes": "100\x1b[2J"}, "Expected `int`, got `str` - at `$.episodes`"),
        ({"score": {"best": float("inf"), "last": 0.0}}, "at `$.score.best`"),
        ({"score_std": -1.0}, "Expected `float` >= 0.0 - at `$.score_std`"),
    ],
)
def test_wrong_evaluations_are_no_results(tmp_path, capsys, changes, reason):
    write_run(tmp_path / "good", "ppo/cartpole/d2rl", 0, [1.0])
    folder = write_run(tmp_path / "run", MLP, 0, [20.0, 30.0], evaluation=changes)
    main(["table", str(tmp_path)])
    printed = capsys.readouterr()
    assert f"run is left out: {folder / 'evaluation.json'} is damaged" in printed.err
    assert reason in printed.err
    assert "mlp" not in printed.out
    assert not Run.open(folder).is_complete()


def test_text_of_files_does_not_control_the_terminal(tmp_path, capsys):
    name = "cql/hopper-medium-replay-v0/mlp"
    write_run(tmp_path / "run", name, 0, [1.0], dataset="a\x1b[2J\n| fake | 1 |.hdf5")
    write_run(tmp_path / "no\x1b[31m" / "run", name, 1)
    main(["table", str(tmp_path)])
    printed = capsys.readouterr()
    assert "dataset a\\x1b[2J\\n| fake" in printed.out
    assert "no\\x1b[31m" in printed.err
    assert "\x1b" not in printed.out + printed.err


def test_what_differs_from_the_recipe_is_noted(tmp_path):
    """A learning rate that fell to 0 once is not that of a run with the whole length."""
    fewer = {"episodes": 2, "returns": [20.0, 30.0]}
    few = write_run(tmp_path / "few", MLP, 0, [20.0, 30.0], evaluation=fewer)
    folder = write_run(
        tmp_path / "long", MLP, 1, [20.0], evaluation={"steps": 4096}, total_steps=1024
    )
    run = Run.open(folder)
    run.lengthen(2048)  # nothing is trained yet
    for step, lengths in {1024: [9000, 3072], 2048: [8192, 3072], 3072: [8192, 4096]}.items():
        run.save(step, {"networks": {}})
        for length in lengths:  # nothing is trained with the first
            run.lengthen(length)
    assert make_table([tmp_path])[1] == [
        f"{few} was evaluated over 2 episodes, not 100",
        f"{folder} changed its length: for decay_learning_rate, total_steps was "
        "2048 until step 1024, 3072 until step 3072",
    ]


@pytest.mark.parametrize("text", ["[[1024]]", "1024", '[["many", 1024]]', ""])
def test_damaged_lengths_are_named(tmp_path, text):
    folder = write_run(tmp_path / "run", MLP, 0, [20.0])
    (folder / "earlier_lengths.json").write_text(text)
    with pytest.raises(ValueError, match=r"earlier_lengths\.json is damaged: expected pairs of"):
        make_table([tmp_path])


def test_changed_fields_are_named_and_make_another_cell(tmp_path):
    network = enhanced_tit(dense=False)
    changes: dict[str, dict[str, Any]] = {
        "ppo/cartpole/mlp": {"total_steps": 1000, "backbone": mlp(hidden_dim=256)},
        "ppo/cartpole/enhanced-tit-protocol": {"backbone": network},
        "ppo/cartpole/enhanced-tit": {"backbone": replace(network, frame=Linear(embed_dim=8))},
        "ppo/cartpole/d2rl": {"learning_rate": 1e-3},
    }
    for seed, (name, fields) in enumerate(changes.items()):
        write_run(tmp_path / str(seed), name, seed, [20.0], **fields)
    write_run(tmp_path / "plain", "ppo/cartpole/d2rl", 3, [20.0])
    cells, _ = make_table([tmp_path])
    found = {cell.recipe: cell.changes for cell in cells if cell.changes}
    assert found["ppo/cartpole/mlp"] == "backbone.history.hidden_dim 256, total_steps 1000"
    assert found["ppo/cartpole/enhanced-tit-protocol"] == "backbone.frame.every_block False"
    linear = "backbone.frame.encoder linear, backbone.frame.embed_dim 8"
    assert linear in found["ppo/cartpole/enhanced-tit"]
    d2rl = [(cell.label, cell.runs) for cell in cells if "d2rl" in cell.recipe]
    assert d2rl == [("ppo/cartpole/d2rl", 1), ("ppo/cartpole/d2rl (learning_rate 0.001)", 1)]
    assert "| ppo/cartpole/d2rl (learning_rate 0.001) | 1 | 20 | 0 | - |" in to_markdown(cells)


@pytest.mark.parametrize(
    ("name", "labels"), [("mine", ["mine", "mine (epochs 5)"]), ("", ["{0}/0", "{0}/2"])]
)
def test_names_of_ones_own_or_of_folders(name, labels, tmp_path):
    for seed, epochs in enumerate([4, 4, 5]):
        write_run(tmp_path / str(seed), "ppo/acrobot/mlp", seed, [1.0], name=name, epochs=epochs)
    cells, _ = make_table([tmp_path])
    assert [cell.label for cell in cells] == [label.format(tmp_path) for label in labels]
    assert [cell.runs for cell in cells] == [2, 1]


def test_folders_without_results(tmp_path, runs):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty holds no run folder"):
        make_table([tmp_path / "empty"])
    with pytest.raises(ValueError, match=r"no evaluated run in .*has no evaluation yet"):
        make_table([runs / "ppo/cartpole/vanilla-tit-protocol/1"])


def test_a_run_evaluated_before_its_end_is_left_out(tmp_path):
    write_run(tmp_path / "whole", MLP, 0, [400.0])
    early = write_run(tmp_path / "early", MLP, 1, [100.0], evaluation={"steps": 10})
    (cell,), notes = make_table([tmp_path])
    assert (cell.runs, cell.mean) == (1, 400)
    assert notes == [f"{early} is left out: evaluated after 10 of {cell.steps} steps"]

"""Reports: one HTML file of runs, which holds all that it shows."""

import base64
import json
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from recipes.cli import main
from recipes.core.numbers import number
from recipes.core.recipe_json import recipe_from_json
from recipes.tools.results import report as reports
from tests.recipes.commands import fails
from tests.recipes.results.report_runs import metrics_of, write_run
from tests.recipes.untrained import untrained
from torchrl_tit.settings.networks import enhanced_tit, mlp

TIT, MLP = "ppo/cartpole/enhanced-tit", "ppo/cartpole/mlp"
# For pages whose charts do not matter.
FEW = {name: column for name, column in metrics_of(0).items() if name in ("step", "return_mean")}


class Page(HTMLParser):
    """What a test looks for in a page."""

    def __init__(self, file):
        super().__init__()
        self.source = file.read_text(encoding="utf-8")
        self.words: list[str] = []
        self.tags: list[tuple[str, dict[str, Any]]] = []
        self.feed(self.source)
        self.text = " ".join(" ".join(self.words).split())
        self.links = [a[k] for _, a in self.tags for k in ("src", "href") if k in a]
        self.alts = [a["alt"] for tag, a in self.tags if tag == "img"]

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data)

    def data(self, kind):
        """The contents of the data addresses of a kind."""
        start = f"data:{kind};base64,"
        return [base64.b64decode(x[len(start) :]) for x in self.links if x.startswith(start)]


def report(*words):
    main(["report", *map(str, words)])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two experiments of three and two seeds."""
    folder = tmp_path_factory.mktemp("runs")
    for seed in range(3):
        write_run(folder / "tit" / f"seed-{seed}", TIT, seed, [470 - 3 * seed, 500 - 3 * seed])
    for seed in range(2):
        write_run(folder / "mlp" / f"seed-{seed}", MLP, seed, [300.0, 310.0], epochs=5)
    return folder


@pytest.fixture(scope="module")
def alone(runs, tmp_path_factory):
    """The page of one run."""
    out = tmp_path_factory.mktemp("report") / "report.html"
    report(runs / "tit" / "seed-0", "--out", out)
    return Page(out)


@pytest.fixture(scope="module")
def comparison(runs, tmp_path_factory):
    """The page of all runs."""
    out = tmp_path_factory.mktemp("report") / "report.html"
    report(runs, "--out", out, "--title", "Which one?", "--no-pictures")
    return Page(out)


def test_nothing_is_loaded_from_elsewhere_and_nothing_runs(alone):
    assert all(re.match(r"data:|#|https://arxiv\.org/", link) for link in alone.links)
    (policy,) = [a["content"] for _, a in alone.tags if "http-equiv" in a]
    assert policy.startswith("default-src 'none';")
    assert "script" not in policy + " ".join(tag for tag, _ in alone.tags)


def test_what_a_page_says_of_one_run(alone):
    assert f"<title>{TIT}</title>" in alone.source
    for text in (
        "CartPole-v1, PPO: 1 run of 61,440 environment steps",
        f"{TIT} 1 485 15 - near 500 ± 0: backbone.frame.patch_size auto",
        f"All settings are those of the recipe {TIT}.",
        f"torchrl-tit train {TIT} --seed 0",
        "torch 2.13.0",
        "No film of enhanced-tit: there is no checkpoint.",
        "How far the policy moved from the one that collected the batch",
        "Healthy: It is between 0.001 and 0.03.",
        "If it is larger, choose a lower learning_rate",
        "These are the same in all rows: epochs 10.",
        "No metric was outside its healthy range",
    ):
        assert text in alone.text, text
    (content,) = alone.data("application/json")
    assert recipe_from_json(content, "the page").name == TIT


def test_every_metric_is_drawn_and_described(alone):
    charts = alone.data("image/svg+xml")
    assert len(charts) == len(alone.alts) == 7  # all but a constant one
    assert all(b"<svg" in chart for chart in charts)
    values = metrics_of(0)["kl_approx"]
    (kl,) = [alt for alt in alone.alts if alt.startswith("Line chart of kl_approx")]
    assert f"highest {number(values.max())}, {number(values[-1])} at step 61,440" in kl


def test_what_a_comparison_says(comparison):
    assert "<title>Which one?</title>" in comparison.source
    for text in (
        "2 experiments, 5 runs of 61,440 environment steps each",
        f"{TIT} 3 482 ± 3 15 - near 500 ± 0: backbone.frame",
        "mlp (epochs 5) 2 305 ± 0 5 - near 500 ± 0: num_envs 8",
        "Is it better?",
        "482 ± 3 177 1 0.2 4",  # of ten ways to choose two of five, the extreme one, twice
        f"What differs from the recipe {MLP}:",
        "epochs 10 5",
        "What differs between the experiments",
        "epochs 5 10",
        f"torchrl-tit sweep {TIT} --seeds 0 1 2",
        "torchrl-tit sweep recipe-1.json --seeds 0 1",
    ):
        assert text in comparison.text, text
    last = np.mean([metrics_of(seed)["kl_approx"][-1] for seed in range(3)])
    (kl,) = [alt for alt in comparison.alts if alt.startswith("Line chart of kl_approx")]
    assert f"{number(last)} at step 61,440" in kl.partition("enhanced-tit:")[2]


def test_metrics_that_are_not_healthy_are_pointed_out(tmp_path):
    metrics = metrics_of(0)
    metrics["kl_approx"][:12] = 0.05
    metrics["kl_approx"][36:] = np.nan  # rows of an evaluation alone
    metrics["explained_variance"][:] = -1
    metrics["return_mean"][5:] = 500  # so it means nothing
    metrics["return_mean"][6::2] = np.nan  # batches in which no episode ended
    metrics["gradient_norm"][:14] = 6  # less than a quarter of 60
    write_run(tmp_path / "run", TIT, metrics=metrics)
    report(tmp_path / "run", "--out", tmp_path / "a.html", "--no-pictures")
    page = Page(tmp_path / "a.html")
    found = page.source.partition("outside their healthy range")[2].partition("</ul>")[0]
    assert "kl_approx</code> was above 0.03 in 33% of the batches" in found
    assert "explained_variance" not in found
    assert "gradient_norm" not in found
    assert "has no results: no evaluated run in" in page.text


def test_a_run_that_is_not_as_far_is_named(tmp_path):
    for seed, rows in enumerate([60, 60, 20]):
        write_run(tmp_path / f"seed-{seed}", TIT, seed, metrics=metrics_of(seed, rows))
    report(tmp_path, "--out", tmp_path / "a.html", "--no-pictures")
    text = Page(tmp_path / "a.html").text
    assert "seed 2 is at 20,480 of 61,440 steps: bold lines leave it out" in text
    assert "3 runs of 20,480 to 61,440 environment steps each" in text


def test_runs_without_an_environment_show_what_was_held_out(tmp_path):
    columns = {"step": [100, 200], "return_mean": [np.nan] * 2, "loss": [2.0, 1.0]}
    columns["held_out_action_error"] = [0.5, 0.25]
    for seed in range(2):
        run = tmp_path / f"seed-{seed}"
        write_run(run, "bc/mlp", seed, metrics=columns, total_updates=200)
        measured = {"held_out": {"action_error": 0.25 + seed}, "held_out_episodes": 7}
        evaluation = {"steps": 200, "env": "", "dataset": "a.hdf5", **measured}
        (run / "evaluation.json").write_text(json.dumps(evaluation))
    report(tmp_path, "--out", tmp_path / "a.html", "--no-pictures")
    page = Page(tmp_path / "a.html")
    assert "seed 0, on 7 held-out episodes: action_error 0.25" in page.text
    assert "seed 1, on 7 held-out episodes: action_error 1.25" in page.text
    assert "has no results" not in page.text
    curves = page.source[page.source.index('id="learning-curves"') :]
    assert curves.index("held_out_action_error") < curves.index('id="health-of-training"')


def test_what_was_measured_once_is_not_called_constant(tmp_path):
    once = {"held_out_action_error": [np.nan, 0.25], "held_out_nll": [np.nan, 0.5]}
    columns = {"step": [100, 200], "return_mean": [np.nan] * 2, "epochs": [10, 10], **once}
    run = write_run(tmp_path / "run", "bc/mlp", metrics=columns, total_updates=200)
    report(run, "--out", tmp_path / "a.html", "--no-pictures")
    page = Page(tmp_path / "a.html")
    assert "These are the same in all rows: epochs 10." in page.text
    assert [alt for alt in page.alts if "held_out_nll" in alt]


def test_settings_under_one_name_that_is_not_registered(tmp_path):
    for width in (4, 8):
        path = tmp_path / str(width)
        settings = {"backbone": mlp(hidden_dim=width), "name": "mine/a"}
        write_run(path, MLP, returns=[float(width)], metrics=FEW, **settings)
    report(tmp_path, "--out", tmp_path / "a.html", "--no-pictures")
    text = Page(tmp_path / "a.html").text
    assert text.count("mine/a (backbone.history.hidden_dim 8)") >= 2


def test_names_cannot_be_markup_or_formulas(tmp_path):
    evil = "</script><img src=x onerror=alert(1)> $\\frac$"
    run = write_run(tmp_path / "a&b <i>", TIT, env_settings=(f"render={evil!r}",), metrics=FEW)
    write_run(tmp_path / "other", TIT, returns=[1.0], metrics=FEW)
    (run / "versions.json").write_text(json.dumps({evil: evil}))
    words = ["--title", evil, "--import", "gymnasium.envs.classic_control", "--no-pictures"]
    report(run, tmp_path / "other", "--out", tmp_path / "a.html", *words)
    page = Page(tmp_path / "a.html")
    assert evil[:20] not in page.source
    assert page.text.count(evil) >= 3  # as text
    assert not [a for _, a in page.tags if "onerror" in a]


@pytest.fixture
def acting(tmp_path):
    """A run of a small network that can act."""
    network = enhanced_tit(2, patch_size="auto", embed_dim=8, num_blocks=1, features_dim=8)
    folder = write_run(tmp_path / "run", MLP, metrics=FEW, backbone=network)
    recipe = recipe_from_json((folder / "recipe.json").read_bytes(), "")
    untrained(tmp_path / "weights", recipe).checkpoints.rename(folder / "checkpoints")
    return folder


def test_a_film_and_what_the_agent_looks_at(acting, tmp_path, capsys):
    for package in ("pygame", "captum", "imageio_ffmpeg"):
        pytest.importorskip(package)
    report(acting, "--out", tmp_path / "a.html")
    assert f"filming and explaining {acting}" in capsys.readouterr().out
    page = Page(tmp_path / "a.html")
    (video,) = page.data("video/mp4")
    assert video[4:8] == b"ftyp"
    assert re.search(r"episode of seed 1000000: return \d+\.", page.text)
    assert "weights in the policy" in page.text
    pictures = page.data("image/png")
    assert 1 <= len(pictures) <= 3
    assert all(picture.startswith(b"\x89PNG") for picture in pictures)
    first = next(alt for alt in page.alts if alt.startswith("Step 0."))
    for text in ("Action probabilities: 0 0.", "Of observation, entry", "Attention over time"):
        assert text in first
    assert all(page.alts)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("metrics.csv", "step,return_mean\n", "has no metrics yet: train it first"),
        ("metrics.csv", "step,return_mean\n1,2\nx,3\n", "damaged row after step 1"),
        ("metrics.csv", "step,entropy\n1,2\n", "metrics.csv is damaged: it has no column"),
        ("evaluation.json", "{", "evaluation.json is damaged"),
        ("versions.json", "[1]", None),
    ],
)
def test_damaged_files_are_named(tmp_path, capsys, name, content, message):
    folder = write_run(tmp_path / "run", TIT, returns=[1.0], metrics=FEW)
    (folder / name).write_text(content)
    words = [folder, "--out", tmp_path / "a.html", "--no-pictures"]
    if message is None:
        report(*words)
        assert "all runs not known" in Page(tmp_path / "a.html").text
    else:
        assert message in fails(capsys, "report", *words)


def test_agents_in_the_middle_are_shown(tmp_path, monkeypatch):
    for seed, value in enumerate([10.0, 500.0, 300.0]):
        folder = write_run(tmp_path / f"seed-{seed}", MLP, seed, [value], FEW, backbone=mlp())
        (folder / "checkpoints").mkdir()
    monkeypatch.setattr(reports, "checkpoint_steps", lambda folder: [1])
    shown = []

    def refuse(folder):
        shown.append(folder.name)
        raise ValueError("enough")

    monkeypatch.setattr(reports, "load_agent", refuse)
    report(tmp_path, "--out", tmp_path / "a.html")
    assert shown == ["seed-2"]
    assert np.median([10, 500, 300]) == 300

"""Reports: one HTML file of runs, which holds all that it shows."""

import base64
import json
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from recipes.cli import main
from recipes.recipe_json import recipe_from_json
from recipes.results.interval import interval_of
from tests.recipes.results.report_runs import metrics_of, write_run
from tests.recipes.untrained import untrained
from torchrl_tit.settings.networks import enhanced_tit, mlp

pytest.importorskip("plotly")


class Page(HTMLParser):
    """What a test looks for in a page."""

    def __init__(self, file):
        super().__init__()
        self.source = file.read_text(encoding="utf-8")
        self.words: list[str] = []
        self.links: list[str] = []
        self.tags: list[tuple[str, dict[str, Any]]] = []
        self._inside: list[str] = []
        self.feed(self.source)
        self.text = " ".join(" ".join(self.words).split())
        (data,) = re.findall(r'id="charts">(.*?)</script>', self.source, re.DOTALL)
        self.charts = {chart["column"]: chart["figure"] for chart in json.loads(data)}

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.append((tag, attributes))
        self.links += [attributes[name] for name in ("src", "href", "poster") if name in attributes]
        if tag in ("script", "style"):
            self._inside.append(tag)

    def handle_endtag(self, tag):
        if self._inside and self._inside[-1] == tag:
            self._inside.pop()

    def handle_data(self, data):
        if not self._inside:
            self.words.append(data)

    def data(self, kind):
        """The contents of the data addresses of a kind, each once."""
        start = f"data:{kind};base64,"
        return [base64.b64decode(x[len(start) :]) for x in dict.fromkeys(self.links) if start in x]


def values(array):
    """What Plotly's JSON holds: a list, or bytes."""
    if isinstance(array, dict):
        return np.frombuffer(base64.b64decode(array["bdata"]), dtype=array["dtype"])
    return np.array(array, dtype=float)


def report(*words):
    main(["report", *map(str, words)])


def error(capsys, *words):
    with pytest.raises(SystemExit):
        report(*words)
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("error: ")]
    return line


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two experiments of three and two seeds."""
    folder = tmp_path_factory.mktemp("runs")
    for seed in range(3):
        returns = 470 + 10 * np.arange(4) - 3 * seed
        write_run(folder / "tit" / f"seed-{seed}", seed=seed, returns=returns)
    for seed in range(2):
        name = "ppo/cartpole/mlp"
        write_run(folder / "mlp" / f"seed-{seed}", name, seed, returns=[300.0, 310.0], epochs=5)
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


def test_nothing_is_loaded_from_elsewhere(alone):
    outside = [link for link in alone.links if not re.match(r"data:|#|https://arxiv\.org/", link)]
    assert outside == []
    assert not [a for tag, a in alone.tags if tag in ("img", "script", "link") and "http" in str(a)]
    (policy,) = [a["content"] for tag, a in alone.tags if "http-equiv" in a]
    assert policy.startswith("default-src 'none';")
    assert "http" not in policy


def test_what_a_page_says_of_one_run(alone):
    assert "<title>ppo/cartpole/enhanced-tit</title>" in alone.source
    assert "CartPole-v1, PPO: 1 run of 61,440 environment steps" in alone.text
    assert "Mean and standard deviation over 4 episodes" in alone.text
    assert "The paper reports 500 ± 0." in alone.text
    assert "All settings are those of the recipe ppo/cartpole/enhanced-tit." in alone.text
    assert "torchrl-tit train ppo/cartpole/enhanced-tit --seed 0" in alone.text
    assert "torch 2.13.0" in alone.text
    assert "No film of enhanced-tit: there is no checkpoint." in alone.text
    assert "epochs 10" in alone.text, "a constant metric is said, not drawn"
    assert "epochs" not in alone.charts


def test_charts_hold_the_metrics_and_say_what_they_mean(alone):
    metrics = metrics_of(0)
    known = np.isfinite(metrics["return_mean"])
    thin, bold = alone.charts["return_mean"]["data"]
    assert (values(thin["x"]) == metrics["step"][known]).all()
    assert np.allclose(values(thin["y"]), metrics["return_mean"][known])
    assert values(bold["y"])[9] == pytest.approx(metrics["return_mean"][known][5:10].mean())
    (line,) = alone.charts["kl_approx"]["data"]
    assert np.allclose(values(line["y"]), metrics["kl_approx"])
    assert "How far the policy moved from the one that collected the batch" in alone.text
    assert "Healthy: 0.003 to 0.02." in alone.text
    (shape,) = alone.charts["kl_approx"]["layout"]["shapes"]
    assert shape["y0"] == shape["y1"] == 0.02
    described = [a["aria-label"] for tag, a in alone.tags if a.get("role") == "img"]
    assert len(described) == len(alone.charts)
    last = f"{metrics['kl_approx'][-1]:.4g} at step 61,440"
    assert any(text.startswith("Line chart of kl_approx") and last in text for text in described)


def test_settings_are_a_file_to_train_with(alone):
    (content,) = alone.data("application/json")
    recipe = recipe_from_json(content, "the page")
    assert recipe.name == "ppo/cartpole/enhanced-tit"


def test_bold_lines_and_bands_are_those_of_the_tables(comparison):
    data = comparison.charts["kl_approx"]["data"]
    kinds = [(trace["meta"]["group"], trace["meta"]["kind"]) for trace in data]
    assert kinds == [
        *[(0, kind) for kind in ("run", "run", "band", "band", "middle")],
        *[(1, kind) for kind in ("run", "run", "run", "band", "band", "middle")],
    ]
    place = 17
    at = interval_of([metrics_of(seed)["kl_approx"][place] for seed in range(3)])
    low, high, middle = (values(data[index]["y"])[place] for index in (8, 9, 10))
    assert middle == pytest.approx(at.iqm)
    assert (low, high) == pytest.approx((at.low, at.high), rel=0.1)  # of fewer samples


def test_what_a_comparison_says(comparison):
    text = comparison.text
    assert "<title>Which one?</title>" in comparison.source
    assert "2 experiments, 5 runs of 61,440 environment steps each" in text
    assert "Interquartile mean and its 95% interval over 3 runs" in text
    at = interval_of([485.0, 482.0, 479.0])
    assert f"3 {at.iqm:.0f} [{at.low:.0f}, {at.high:.0f}] 482 ± 2.4 11.18 500 ± 0" in text
    published = "CleanRL 490 ± 6.1 (training return after 500k steps, 3 seeds) ; RL Zoo 500 ± 0"
    assert f"mlp (epochs 5) 2 305 [305, 305] 305 ± 0 5 500 ± 0 {published}" in text
    assert "What differs from the recipe ppo/cartpole/mlp:" in text
    assert "epochs 10 5" in text
    assert "What differs between the experiments" in text
    assert "epochs 5 10" in text
    boxes = comparison.charts["evaluation-episodes"]["data"]
    assert [len(values(box["y"])) for box in boxes] == [2, 2, 4, 4, 4]
    ids = {a["id"] for tag, a in comparison.tags if tag == "input"}
    assert ids == {
        *("group-0", "group-1", "singles", "bands", "log-steps"),
        *("run-0-0", "run-0-1", "run-1-0", "run-1-1", "run-1-2"),
    }
    assert "torchrl-tit sweep ppo/cartpole/enhanced-tit --seeds 0 1 2" in text
    assert "torchrl-tit sweep recipe-1.json --seeds 0 1" in text


def test_metrics_that_are_not_healthy_are_pointed_out(tmp_path):
    metrics = metrics_of(0)
    metrics["kl_approx"][:20] = 0.05
    metrics["explained_variance"][:] = -1
    metrics["return_mean"][5:] = 500  # so it means nothing
    metrics["gradient_norm"][:14] = 6  # less than a quarter of 60
    write_run(tmp_path / "run", metrics=metrics)
    report(tmp_path / "run", "--out", tmp_path / "a.html", "--no-pictures")
    page = Page(tmp_path / "a.html")
    found = page.text.partition("Outside their healthy range")[2].partition("log axis")[0]
    assert "kl_approx above 0.02: in 33% of the batches" in found
    assert "explained_variance" not in found
    assert "gradient_norm" not in found
    assert "not evaluated" in page.text


def test_a_run_that_is_not_as_far_is_left_out_of_the_bold_line(tmp_path):
    for seed, rows in enumerate([60, 60, 20]):
        write_run(tmp_path / f"seed-{seed}", seed=seed, metrics=metrics_of(seed, rows))
    report(tmp_path, "--out", tmp_path / "a.html", "--no-pictures")
    page = Page(tmp_path / "a.html")
    assert "seed 2 is at 20,480 of 61,440 environment steps: bold lines leave it out" in page.text
    *_, middle = page.charts["kl_approx"]["data"]
    both = [metrics_of(seed)["kl_approx"] for seed in range(2)]
    assert np.allclose(values(middle["y"]), np.mean(both, 0))


def test_names_cannot_be_markup(tmp_path):
    evil = "</script><img src=x onerror=alert(1)>"
    write_run(tmp_path / "a&b <i>", returns=[1.0, 2.0], env_settings=(f"render={evil!r}",))
    versions = tmp_path / "a&b <i>" / "versions.json"
    versions.write_text(json.dumps({evil: evil}))
    words = ["--title", evil, "--import", "gymnasium.envs.classic_control"]
    report(tmp_path / "a&b <i>", "--out", tmp_path / "a.html", *words)
    page = Page(tmp_path / "a.html")
    assert evil not in page.source
    assert page.text.count(evil) >= 4  # as text
    assert not [a for tag, a in page.tags if "onerror" in a]


def test_a_film_and_what_the_agent_looks_at(tmp_path, capsys):
    pytest.importorskip("pygame")
    pytest.importorskip("captum")
    pytest.importorskip("imageio_ffmpeg")
    network = enhanced_tit(2, patch_size="auto", embed_dim=8, num_blocks=1, features_dim=8)
    folder = write_run(tmp_path / "run", name="ppo/cartpole/mlp", backbone=network)
    recipe = recipe_from_json((folder / "recipe.json").read_bytes(), "")
    run = untrained(tmp_path / "weights", recipe)
    run.checkpoints.rename(folder / "checkpoints")
    report(folder, "--out", tmp_path / "a.html")
    assert f"filming and explaining {folder}" in capsys.readouterr().out
    page = Page(tmp_path / "a.html")
    (video,) = page.data("video/mp4")
    assert video[4:8] == b"ftyp"
    poster, *steps = page.data("image/png")
    assert all(picture.startswith(b"\x89PNG") for picture in (poster, *steps))
    assert 1 <= len(steps) <= 3
    (caption,) = [x for x in page.words if "of its evaluation (episode seed 1000000" in x]
    ((returns, steps_of_all),) = re.findall(r"Return ([\d, ]+) in (\d+) steps", caption)
    rewards = sum(int(value) for value in returns.split(", "))
    assert rewards == int(steps_of_all), "1 for each step of CartPole"
    alts = [a["alt"] for tag, a in page.tags if tag == "img" and a["alt"].startswith("Step")]
    assert "Action probabilities: 0 0." in alts[0]
    assert "Of observation, entry" in alts[0]
    assert "Attention over time reads" in alts[0]
    assert not [a for tag, a in page.tags if tag == "img" and not a.get("alt")]


def test_a_task_that_cannot_be_rendered(tmp_path, monkeypatch):
    pytest.importorskip("pygame")
    folder = write_run(tmp_path / "run", name="ppo/cartpole/mlp", backbone=mlp(hidden_dim=8))
    run = untrained(
        tmp_path / "weights", recipe_from_json((folder / "recipe.json").read_bytes(), "")
    )
    run.checkpoints.rename(folder / "checkpoints")

    def make_rendered(make_env, name):
        raise ValueError("it has no pictures")

    monkeypatch.setattr("recipes.results.film.make_rendered", make_rendered)
    report(folder, "--out", tmp_path / "a.html")
    text = Page(tmp_path / "a.html").text
    assert "Not everything of mlp is shown: it has no pictures" in text
    assert "weights in the policy" in text


def test_runs_that_do_not_go_together(runs, tmp_path, capsys):
    out = tmp_path / "a.html"
    write_run(tmp_path / "acrobot", "ppo/acrobot/mlp")
    line = error(capsys, runs / "mlp", tmp_path / "acrobot", "--out", out)
    assert "do not go together: their tasks are CartPole-v1 and Acrobot-v1" in line
    write_run(tmp_path / "again")
    line = error(capsys, runs / "tit", tmp_path / "again", "--out", out)
    assert "are the same run" in line
    assert "no holds no run" in error(capsys, tmp_path / "no", "--out", out)
    (tmp_path / "empty").mkdir()
    assert "empty holds no run" in error(capsys, tmp_path / "empty", "--out", out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("metrics.csv", "step,time,return_mean\n1,2\n", "damaged row"),
        ("metrics.csv", "step,time\n1,2\n", "metrics.csv is damaged: it has no column return_mean"),
        ("metrics.csv", "", "has no metrics yet: train it first"),
        ("recipe.json", "{", "cannot be read as a recipe"),
        ("evaluation.json", "[]", "evaluation.json is damaged"),
        ("evaluation.json", '{"returns": [NaN]}', "evaluation.json is damaged"),
        ("metrics.csv", "step,time,return_mean\n-5,1,2\n", "damaged row after its beginning"),
        ("metrics.csv", "step,time,return_mean\n5,1,2\n5,2,2\n", "damaged row after step 5"),
        ("metrics.csv", "step,time,return_mean\n1e300,1,2\n", "damaged row after its beginning"),
        ("metrics.csv", "step,time,return_mean\n1,1,1e300\n", "its return_mean is 1e+300"),
    ],
)
def test_a_damaged_run(name, content, message, tmp_path, capsys):
    folder = write_run(tmp_path / "run", returns=[1.0, 2.0])
    (folder / name).write_text(content)
    assert message in error(capsys, folder, "--out", tmp_path / "a.html")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_damaged_checkpoint(tmp_path, capsys):
    folder = write_run(tmp_path / "run", name="ppo/cartpole/mlp")
    recipe = recipe_from_json((folder / "recipe.json").read_bytes(), "")
    untrained(tmp_path / "weights", replace(recipe)).checkpoints.rename(folder / "checkpoints")
    (tensors,) = folder.glob("checkpoints/*/tensors.safetensors")
    tensors.write_bytes(tensors.read_bytes()[:-100])
    assert "checkpoint" in error(capsys, folder, "--out", tmp_path / "a.html")
    assert not (tmp_path / "a.html").exists()


def test_files_that_cannot_be_written(runs, tmp_path, capsys, monkeypatch):
    run = runs / "mlp"
    assert "a report is an .html file" in error(capsys, run, "--out", tmp_path / "a.pdf")
    assert "there is no folder" in error(capsys, run, "--out", tmp_path / "no" / "a.html")
    (tmp_path / "b.html").mkdir()
    assert "it is a folder" in error(capsys, run, "--out", tmp_path / "b.html")
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert "may not be written to" in error(capsys, run, "--out", tmp_path / "a.html")
    assert [path.name for path in tmp_path.iterdir()] == ["b.html"]


def test_a_full_disk_leaves_the_earlier_report(runs, tmp_path, capsys, monkeypatch):
    out = tmp_path / "a.html"
    out.write_text("before")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    assert "No space left" in error(capsys, runs / "mlp", "--out", out, "--no-pictures")
    assert out.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["a.html"]


def test_plotly_is_an_extra(runs, tmp_path, capsys, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("recipes.results.report")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "plotly.graph_objects", None)
    line = error(capsys, runs / "mlp", "--out", tmp_path / "a.html")
    assert line == "error: plotly is not installed: pip install 'torchrl-tit[report]'"

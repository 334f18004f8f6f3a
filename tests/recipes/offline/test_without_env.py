"""Learning from logged data alone: spaces, held-out episodes, and the best weights by them."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from recipes import offline
from recipes.cli import main
from recipes.core import runner
from recipes.core.evaluation import score_of
from recipes.core.metrics import read_metrics
from recipes.core.records import Records
from recipes.core.registry import get_recipe
from recipes.core.run import RecordedRun, Run
from recipes.decision_transformer import warn_of_targets
from recipes.offline import read_data, with_spaces
from recipes.presets import any_data
from tests.datasets.rollouts import write
from tests.recipes.commands import fails
from tests.recipes.small import (
    BC,
    CQL,
    IQL,
    SMALL,
    TD3BC,
    assert_resumes_bit_for_bit,
    make,
    make_algorithm,
    make_cartpole_dt,
    make_discrete_cql,
    make_dt,
    make_odt,
    tit,
    train,
)
from torchrl_tit import load_agent
from torchrl_tit.datasets import DatasetError, TaskSpaces, checks, load_episodes
from torchrl_tit.envs.spaces import ObservationReader
from torchrl_tit.evaluation_file import check_evaluation
from torchrl_tit.settings.networks import gru

RECIPES = {
    "bc": partial(make, BC, env="", normalize_observations=True),
    "bc, memory": partial(make, BC, env="", backbone=gru(hidden_dim=8), slice_length=4, burn_in=2),
    "iql": partial(make, IQL, env=""),
    "td3bc": partial(make, TD3BC, env=""),
    "cql": partial(make, CQL, env=""),
    "cql, slices": partial(make, CQL, env="", backbone=tit(3), slice_length=2),
    "discrete-cql": partial(make_discrete_cql, env=""),
    "dt": partial(make_dt, env="", target_returns=()),
    "dt, discrete": partial(make_cartpole_dt, env="", target_returns=()),
}


def log_machine(path: Path, steps: int = 200, length: int = 20, **arrays: Any) -> Path:
    """Logs of a machine with 5 sensors, whose 2 actions follow from the newest reading."""
    draw = np.random.default_rng(0)
    observations = draw.normal(size=(steps, 5))
    fields = {
        "observations": observations,
        "actions": np.tanh(observations[:, :2]),
        "rewards": draw.normal(size=steps),
        "terminals": np.zeros(steps, bool),
        "timeouts": np.arange(steps) % length == length - 1,
        **arrays,
    }
    return write(path, fields)


@pytest.mark.parametrize(
    "name", ["bc", "bc, memory", "cql, slices", "discrete-cql", "dt", "dt, discrete"]
)
def test_trains_and_resumes_bit_for_bit(tmp_path, name):
    algorithm = make_algorithm(RECIPES[name](tmp_path))
    algorithm.check()
    run = train(algorithm.recipe, tmp_path / "whole")
    assert_resumes_bit_for_bit(run, tmp_path / "resumed")
    rows = read_metrics(run.folder / "metrics.csv")
    measured = {row["step"]: row for row in rows if row["step"] in (9, 18)}
    for column in algorithm.held_out_columns:
        assert np.isfinite([row[column] for row in measured.values()]).all()
    assert np.isnan([row["return_mean"] for row in rows]).all()
    errors = {step: row["held_out_action_error"] for step, row in measured.items()}
    last, best = runner.evaluate(run), runner.evaluate(run, best=True)
    for evaluation in (last, best):
        check_evaluation(evaluation)
        assert "mean" not in evaluation
        assert list(evaluation["held_out"]) == list(algorithm.measures)
        assert evaluation["held_out"]["action_error"] == errors[evaluation["steps"]]
    assert last["steps"] == 18
    assert errors[best["steps"]] == min(errors.values())


@pytest.mark.parametrize("name", ["bc", "dt"])
def test_a_run_of_python_records_what_its_data_said(tmp_path, name):
    """As one of the command line does."""
    data = log_machine(tmp_path / "log.hdf5")
    run = train(RECIPES[name](tmp_path, dataset=str(data)), tmp_path / "run")
    recipe: Any = run.recipe
    assert Run.open(run.folder).recipe == recipe == make_algorithm(recipe).recipe
    assert "observation_shape" in recipe.task_settings
    if name == "dt":
        assert len(recipe.target_returns) == 1
    data.unlink()
    assert load_agent(run.folder).act(np.zeros(5)).shape == (2,)


def test_the_measures_of_held_out_episodes(tmp_path):
    data = log_machine(tmp_path / "log.hdf5")
    recipe = BC(dataset=str(data), backbone=SMALL, seed=1, compile="off")
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, tmp_path)
    assert algorithm.buffer.storage.shape[0] == 9 * 19  # the final observations are unknown
    found = algorithm.measure(0)
    items = algorithm.measured_items(algorithm._held_out).get(slice(None))
    assert (found.episodes, len(items)) == (1, 19)
    rest = algorithm.buffer.storage.get(slice(None))["observation"]
    assert not (items["observation"].unsqueeze(1) == rest).all(-1).any()
    with torch.no_grad():
        dist = algorithm.policy.get_dist(items.clone())
    expected = {
        "action_error": (dist.mode - items["action"]).square().mean(),
        "log_likelihood": dist.log_prob(items["action"]).mean(),
    }
    assert found.values == pytest.approx({k: v.item() for k, v in expected.items()}, rel=1e-5)
    state = torch.get_rng_state()
    assert algorithm.measure(0) == found
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize(("unfinished", "count"), [("drop", 10), ("keep", 11)])
def test_episodes_that_are_not_measured_are_not_counted(unfinished, count, tmp_path):
    data = str(log_machine(tmp_path / "log.hdf5", 205))
    recipe = BC(dataset=data, backbone=SMALL, unfinished=unfinished)
    assert make_algorithm(recipe).measure(0, read_data(recipe)).episodes == count


def test_no_more_items_are_measured_than_the_limit(tmp_path, monkeypatch):
    data = str(log_machine(tmp_path / "log.hdf5"))
    recipe = BC(dataset=data, backbone=SMALL, validation_fraction=0.9, compile="off")
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, tmp_path)
    monkeypatch.setattr("recipes.offline._MOST_MEASURED", 100)
    counts, measure_batch = [], algorithm.measure_batch

    def counted(samples):
        counts.append(len(samples))
        return measure_batch(samples)

    monkeypatch.setattr(algorithm, "measure_batch", counted)
    algorithm.measure(0)
    assert sum(counts) == 86  # every second of 9 * 19


def test_each_step_of_held_out_slices_counts_once(tmp_path, monkeypatch):
    data = str(log_machine(tmp_path / "log.hdf5"))
    recipe = BC(dataset=data, backbone=gru(hidden_dim=8), slice_length=8)
    algorithm = make_algorithm(recipe)
    items = algorithm.measured_items(read_data(algorithm.recipe))
    rows, measure_batch = [], algorithm.measure_batch

    def seen(samples):
        rows.append(samples["action"].flatten(0, 1))
        return measure_batch(samples)

    monkeypatch.setattr(algorithm, "measure_batch", seen)
    algorithm.measure(0, read_data(algorithm.recipe))
    assert len(items) % 8
    assert torch.equal(torch.cat(rows), items[:]["action"])


@pytest.mark.parametrize(("kind", "slice_length"), [(TD3BC, 8), (IQL, 7)])
def test_slices_are_measured_as_single_steps_are(tmp_path, kind, slice_length):
    data = str(log_machine(tmp_path / "log.hdf5"))
    found = []
    for length in (1, slice_length):
        settings = {"slice_length": length, "batch_size": 2 * slice_length, "seed": 3}
        recipe = kind(dataset=data, backbone=tit(3), critic_hidden=(8,), **settings)
        torch.manual_seed(0)
        algorithm = make_algorithm(recipe)
        episodes = read_data(algorithm.recipe)
        assert len(algorithm.measured_items(episodes)) % slice_length
        found.append(algorithm.measure(0, episodes).values)
    assert found[0] == pytest.approx(found[1], rel=1e-4)


def test_every_step_of_windows_counts_the_same(tmp_path, monkeypatch):
    """However many are measured at a time: windows of the first 20 episodes are mostly padding."""
    ends = (np.arange(200) < 20) | (np.arange(200) % 60 == 59)
    data = log_machine(tmp_path / "log.hdf5", timeouts=ends)
    algorithm = make_algorithm(make_dt(tmp_path, env="", target_returns=(), dataset=str(data)))
    episodes = read_data(algorithm.recipe)
    together = algorithm.measure(0, episodes)
    monkeypatch.setattr("recipes.offline._MEASURED_AT_ONCE", 10)
    assert algorithm.measure(0, episodes).error == pytest.approx(together.error, rel=1e-5)


def test_data_shorter_than_a_slice_are_not_measured(tmp_path):
    data = str(log_machine(tmp_path / "log.hdf5"))
    recipe = BC(dataset=data, backbone=gru(hidden_dim=8), slice_length=8)
    algorithm = make_algorithm(recipe)
    short = load_episodes(str(log_machine(tmp_path / "short.hdf5", steps=6, length=6)))
    with pytest.raises(ValueError, match=r"has 5 transitions, but the recipe measures slices of 8"):
        algorithm.measure(0, short)


def test_the_best_weights_are_those_before_the_data_are_learned_by_heart(tmp_path):
    noise = np.random.default_rng(1).uniform(-1, 1, (60, 2))
    data = log_machine(tmp_path / "log.hdf5", steps=60, actions=noise)
    recipe = BC(
        dataset=str(data),
        backbone=SMALL,
        learning_rate=0.03,
        total_updates=200,
        evaluation_interval=10,
        batch_size=32,
        name="bc/mine",
    )
    run = train(recipe, tmp_path / "run")
    last, best = runner.evaluate(run), runner.evaluate(run, best=True)
    assert best["steps"] < last["steps"]
    assert best["held_out"]["action_error"] < 0.9 * last["held_out"]["action_error"]


def test_an_environment_and_held_out_episodes(tmp_path):
    run = train(make(BC, tmp_path, validation_fraction=0.2), tmp_path / "run")
    evaluation = runner.evaluate(run)
    check_evaluation(evaluation)
    assert evaluation["held_out"]["action_error"] > 0
    assert len(evaluation["returns"]) == 3
    returns = {row["step"]: row["return_mean"] for row in read_metrics(run.folder / "metrics.csv")}
    best = runner.evaluate(run, best=True)["steps"]
    assert returns[best] == max(returns[9], returns[18])  # not by the error


def test_data_are_read_once_and_again_if_they_change(tmp_path, monkeypatch):
    recipe, read = RECIPES["dt"](tmp_path), []

    def load(source, **settings):
        read.append(source)
        return load_episodes(source, **settings)

    monkeypatch.setattr(offline, "load_episodes", load)
    algorithm = make_algorithm(recipe)
    algorithm.check()
    runner.evaluate(train(algorithm.recipe, tmp_path / "run"))
    assert len(read) == 1
    log_machine(Path(recipe.dataset))
    with pytest.raises(DatasetError, match="but in the recipe it is"):
        read_data(algorithm.recipe)
    assert len(read) == 2


@pytest.mark.parametrize(
    ("actions", "low", "high", "warned"),
    [
        (np.linspace(-0.5, 0.9, 400).reshape(200, 2), [-1, -1], [1, 1], []),
        (
            np.stack([np.linspace(0, 90, 200), np.full(200, 40)], 1),
            [0, 39],
            [90, 41],
            ["entry 1 of all actions is 40, so its bounds are 39 and 41"],
        ),
    ],
    ids=["within -1 to 1", "others, one of them constant"],
)
def test_spaces_of_the_data(tmp_path, actions, low, high, warned, recwarn):
    data = log_machine(tmp_path / "log.hdf5", actions=actions)
    recipe = with_spaces(BC(dataset=str(data), backbone=SMALL))
    ours = [str(x.message) for x in recwarn if str(data) in str(x.message)]
    assert ours == [f"{data}: {text}" for text in warned]
    assert recipe.task_settings == {
        "observation_shape": [5],
        "observation_dtype": "float32",
        "low": low,
        "high": high,
    }
    assert with_spaces(recipe) is recipe
    read_data(recipe)
    log_machine(data.with_name("other.hdf5"), observations=np.zeros((200, 4)))
    with pytest.raises(DatasetError, match=r"'observations': one row has the shape \[4\]"):
        read_data(BC(**{**vars(recipe), "dataset": str(data.with_name("other.hdf5"))}))


def test_spaces_of_images_and_discrete_actions(tmp_path):
    images = np.zeros((200, 20, 20), np.uint8)
    data = log_machine(tmp_path / "log.hdf5", observations=images, actions=np.arange(200) % 3)
    recipe = with_spaces(BC(dataset=str(data), backbone=SMALL))
    shape, dtype, count = recipe.task_settings.values()
    assert (shape, dtype, count) == ([20, 20], "uint8", 3)
    layouts: dict[Any, list[int]] = {"auto": [3, 20, 20], "CHW": [20, 20, 3]}
    for layout, expected in layouts.items():
        stored = np.stack([images] * 3, -1)
        rgb = log_machine(tmp_path / f"{layout}.hdf5", observations=stored)
        found = with_spaces(BC(dataset=str(rgb), backbone=SMALL, image_layout=layout))
        assert found.task_settings["observation_shape"] == expected
    other = log_machine(tmp_path / "f.hdf5", observations=images / 1.0, actions=np.arange(200) % 3)
    with pytest.raises(DatasetError, match="is float32, but in the recipe it is uint8"):
        read_data(replace(recipe, dataset=str(other)))


def test_discrete_actions_count_from_0(tmp_path, monkeypatch):
    """Policies do, and the task gets them shifted: data of the task are shifted back."""
    actions = 2 + np.arange(200) % 2
    data = log_machine(tmp_path / "log.hdf5", actions=actions)
    spaces = TaskSpaces(Box(-9, 9, (5,)), Discrete(3, start=1))
    monkeypatch.setattr(offline, "task_spaces", lambda env, **settings: spaces)
    episodes = read_data(BC(env="CartPole-v1", dataset=str(data), backbone=SMALL))
    found = episodes.rows["action"][episodes.step_rows].numpy()
    np.testing.assert_array_equal(found, actions - 1)


def test_data_are_those_of_the_task_as_it_is_built(tmp_path):
    """The policy acts in the wrapped task, in -1..1, where Pendulum itself takes -2..2."""
    data = log_machine(
        tmp_path / "a.hdf5", observations=np.zeros((200, 3)), actions=np.ones((200, 1))
    )
    raw = log_machine(
        tmp_path / "b.hdf5", observations=np.zeros((200, 3)), actions=np.full((200, 1), 2.0)
    )
    rescale = "gymnasium.wrappers:RescaleAction(min_action=-1.0, max_action=1.0)"
    recipe = BC(env="Pendulum-v1", dataset=str(raw), backbone=SMALL)
    assert read_data(recipe).rows["action"].max() == 2
    wrapped = replace(recipe, wrappers=(rescale,))
    with pytest.raises(DatasetError, match=r"row 0: is 2.0, but .* from -1.0 to 1.0"):
        read_data(wrapped)
    assert read_data(replace(wrapped, dataset=str(data))).rows["action"].max() == 1


def test_data_are_those_of_the_transformed_task(tmp_path):
    """TorchRL transforms change what a task writes, as Gymnasium wrappers do."""
    actions = np.zeros((200, 1))
    data = log_machine(tmp_path / "a.hdf5", observations=np.zeros((200, 3)), actions=actions)
    hide = "torchrl_tit.transforms:HideEntries(hidden=[2])"
    recipe = BC(env="Pendulum-v1", wrappers=(hide,), dataset=str(data), backbone=SMALL)
    with pytest.raises(DatasetError, match=r"shape \[3\], but in Pendulum-v1 it is \[2\]"):
        read_data(recipe)
    seen = log_machine(tmp_path / "b.hdf5", observations=np.zeros((200, 2)), actions=actions)
    assert read_data(replace(recipe, dataset=str(seen))).rows["observation"].shape[1:] == (2,)


@pytest.mark.parametrize(("layout", "shape"), [("HWC", (3, 3, 8)), ("CHW", (3, 8, 3))])
def test_transforms_read_images_in_their_layout(monkeypatch, layout, shape):
    """Where the shape does not say it, ``image_layout`` does."""
    images = SimpleNamespace(
        observation_space=Box(0, 255, (3, 8, 3), np.uint8),
        action_space=Discrete(2),
        close=lambda: None,
    )
    monkeypatch.setattr(checks, "make_unchecked", lambda name: images)
    stack = "torchrl.envs:UnsqueezeTransform(dim=-4,in_keys=['observation'])"
    task = checks.task_spaces("CartPole-v1", wrappers=(stack,), image_layout=layout)
    assert task.observation.shape == (1, *shape)


@pytest.mark.parametrize(
    "space",
    [Box(0, 255, (6, 8, 3), np.uint8), Box(-9, 9, (5,), np.int64), Discrete(4, start=1)],
    ids=["channels last", "integers", "categories"],
)
def test_observations_are_those_that_the_task_writes(tmp_path, monkeypatch, space):
    """Channels come first, integers are floats, and categories count from 0."""
    spaces = TaskSpaces(space, Discrete(2))
    monkeypatch.setattr(offline, "task_spaces", lambda env, **settings: spaces)
    space.seed(0)
    stored = np.stack([space.sample() for _ in range(200)]).reshape(200, *(space.shape or (1,)))

    def read(name, observations):
        data = log_machine(tmp_path / name, observations=observations, actions=np.arange(200) % 2)
        return read_data(BC(env="CartPole-v1", dataset=str(data), backbone=SMALL))

    episodes, written = read("log.hdf5", stored), ObservationReader(space)(stored)
    found = episodes.rows["observation"]
    np.testing.assert_array_equal(found[episodes.step_rows], written, strict=True)
    if isinstance(space, Discrete):
        assert found.min() >= 0
        with pytest.raises(DatasetError, match="which Discrete"):
            read("other.hdf5", stored + 4)
        with pytest.raises(DatasetError, match="store integers"):
            read("floats.hdf5", stored / 1.0)


def test_bad_settings_in_one_line(tmp_path, capsys):
    data = log_machine(tmp_path / "log.hdf5")
    words = ["train", "bc/mlp", "--dataset"]
    for further, message in {
        ("",): "is a recipe for any data: name them with --dataset FILE",
        (data, "--validation-fraction", 0): "hold at least one episode out",
        (data, "--env-settings", "low=[-1,-1]", "high=[1,0.5]"): "'actions', row ",
        (data, "--env-settings", "low=[-1]", "high=[1,2]"): "low below high for each entry",
        (data, "--env-settings", "low=[-1]", "high=[1]"): r"one row has the shape \[2\], but in",
        (data, "--env-settings", "observation_shape=5", "low=1", "high=2"): "its spaces: .*'int'",
        (data, "--env-settings", "speed=3"): "consists of its spaces: .*'speed'",
        (data, "--wrappers", "gymnasium.wrappers:ClipAction"): "read in one way",
    }.items():
        assert re.search(message, fails(capsys, *words, *further))
    with pytest.raises(ValueError, match="needs an environment"):
        make_odt(tmp_path, env="")
    integers = np.arange(200) % 3
    bad: dict[str, Any] = {
        "store arrays as floats": {"observations": np.zeros((200, 5), int)},
        "and one choice as integers": {"actions": np.eye(3, dtype=int)[integers]},
        "floats [N, A]": {"actions": 0.5 * integers},
        "row 0: is -1": {"actions": integers - 1},
        "row 0: is -2": {"actions": -2 + 0 * integers},
        "mark the last row of each in 'timeouts'.": {"timeouts": np.zeros(200, bool)},
    }
    for message, arrays in bad.items():
        assert message in fails(capsys, *words, log_machine(tmp_path / "bad.hdf5", **arrays))


def test_one_episode_is_cut_in_two(tmp_path):
    data = log_machine(tmp_path / "log.hdf5", length=200)
    algorithm = make_algorithm(BC(dataset=str(data), backbone=SMALL))
    with pytest.warns(UserWarning, match="its last 20 of 200 steps are held out"):
        episodes = algorithm.load_data()
    whole, held_out = read_data(algorithm.recipe), algorithm._held_out
    assert (episodes.lengths.tolist(), held_out.lengths.tolist()) == ([180], [20])
    observations = whole.rows["observation"]
    assert torch.equal(episodes.rows["observation"], observations[:181])
    assert torch.equal(held_out.rows["observation"], observations[180:])
    assert episodes.rows["truncated"].nonzero()[:, 0].tolist() == [179]
    assert episodes.rows["action"][-1].tolist() == [0, 0]
    assert torch.equal(whole.rows["action"][180], held_out.rows["action"][0])


def test_every_recipe_for_any_data_builds_what_it_needs(tmp_path):
    data = {
        True: log_machine(tmp_path / "log.hdf5"),
        False: log_machine(tmp_path / "discrete.hdf5", actions=np.arange(200) % 3),
    }
    for name in (recipe.name for recipe in any_data.RECIPES):
        data_of_kind = str(data["discrete" not in name])
        recipe: Any = get_recipe(name)
        algorithm = make_algorithm(replace(recipe, dataset=data_of_kind))
        algorithm.check()


def test_cloning_of_the_best_episodes(tmp_path):
    data = log_machine(tmp_path / "log.hdf5")
    recipe = BC(
        dataset=str(data), backbone=SMALL, best_fraction=0.25, validation_fraction=0.5,
        unfinished="keep", time_limits="keep",
    )  # fmt: skip
    algorithm = make_algorithm(recipe)
    learned = algorithm.load_data().returns.tolist()
    held_out = algorithm.measure(0)
    assert len(learned) == held_out.episodes == 1
    found = sorted([*learned, *algorithm._held_out.returns.tolist()], reverse=True)
    assert found == load_episodes(data).returns.sort(descending=True).values[:2].tolist()


def test_the_returns_of_parts_that_a_gap_cut_do_not_count(tmp_path):
    """Where each step costs, a part of an episode returns the most."""
    draw = np.random.default_rng(1)
    costs, following = -draw.uniform(1, 2, 200), draw.normal(size=(201, 5))[1:]
    file = log_machine(tmp_path / "log.hdf5", rewards=costs)
    following[:-1] = load_episodes(file).rows["observation"][load_episodes(file).step_rows][1:]
    following[17] += 1  # after which the first of ten episodes lost a step
    data = tmp_path / "lost.hdf5"
    log_machine(data, rewards=costs, next_observations=following.astype(np.float32))
    whole = costs.reshape(10, 20).sum(1)[1:]

    shared: dict[str, Any] = {"dataset": str(data), "gaps": "cut", "validation_fraction": 0.5}
    best = make_algorithm(BC(**shared, backbone=SMALL, best_fraction=0.5)).load_data()
    assert not best.cut.any()
    dt = make_dt(tmp_path, env="", target_returns=(), dataset=str(data), gaps="cut")
    assert make_algorithm(dt).recipe.target_returns == pytest.approx((whole.max(),))
    with pytest.warns(UserWarning, match="target_returns -3: no episode"):
        warn_of_targets((-3.0,), load_episodes(data, gaps="cut"))
    iql = make_algorithm(IQL(**shared, backbone=SMALL)).load_data()
    assert np.ptp(iql.returns[iql.whole].numpy()) == pytest.approx(20)


def test_the_command_line(tmp_path, capsys):
    data, out = log_machine(tmp_path / "log.hdf5"), tmp_path / "run"
    words = ["train", "bc/enhanced-tit", "--dataset", data, "--out", out]
    main([str(x) for x in [*words, "--total-updates", 4, "--evaluation-interval", 2]])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("taken from the data: observation_shape=[5], ")
    assert lines[-3].startswith("bc/enhanced-tit: after 4 updates (last weights), on 1 ep")
    assert "return" not in lines[-3]
    assert Run.open(out).is_complete()
    main(["evaluate", str(out), "--best"])
    assert "(best weights, chosen on held-out episodes)" in capsys.readouterr().out
    assert "is left out: it has no environment" in fails(capsys, "table", out)


def test_a_run_does_not_go_on_with_other_data_of_the_same_size(tmp_path, capsys):
    data = log_machine(tmp_path / "log.hdf5")
    recipe = replace(BC(dataset=str(data), backbone=SMALL), total_updates=2)
    run = train(with_spaces(recipe), tmp_path / "run")
    data.unlink()
    log_machine(data, actions=np.zeros((200, 2)))
    words = ["train", "--resume", run.folder, "--total-updates", 4]
    assert "saved with other data, of which there were as many" in fails(capsys, *words)


def test_what_reads_evaluations_knows_those_without_returns(tmp_path, capsys):
    recipe = with_spaces(BC(dataset=str(log_machine(tmp_path / "log.hdf5")), backbone=SMALL))
    run = train(replace(recipe, total_updates=2, name="bc/mine"), tmp_path / "run")
    with run:
        run.save_evaluation(runner.evaluate(run))
    evaluation = run.read_evaluation()
    assert evaluation is not None
    assert score_of(evaluation) == -evaluation["held_out"]["action_error"]
    main(["report", str(run.folder), "--out", str(tmp_path / "report.html")])
    assert "no environment that could be rendered" in (tmp_path / "report.html").read_text()
    main(["record", str(run.folder), "--out", str(tmp_path / "table")])
    table = Records(tmp_path / "table")
    assert RecordedRun(table, table.below(".")[0]).read_evaluation() == evaluation
    pytest.importorskip("huggingface_hub")
    main(["share", str(run.folder), "--out", str(tmp_path / "agent")])
    card = (tmp_path / "agent" / "README.md").read_text()
    assert f"action_error {evaluation['held_out']['action_error']:.4g}" in card
    assert "agent.act(observation)" in card
    assert "mean_reward" not in card
    agent = load_agent(tmp_path / "agent")
    assert agent.act(np.zeros(5)).shape == (2,)
    assert "there is no environment" in fails(capsys, "play", tmp_path / "agent")


@pytest.mark.parametrize("name", ["iql", "td3bc", "cql"])
def test_values_are_the_lower_ones_of_two_critics(name, tmp_path):
    algorithm = make_algorithm(RECIPES[name](tmp_path))
    network, (one, two) = (
        algorithm.model.qvalue_network,
        algorithm.model.qvalue_network_params.unbind(0),
    )
    samples = algorithm.make_buffer().sample()
    others = samples["action"].flip(0)
    with torch.no_grad():
        for action in (samples["action"], others):
            states = samples.copy().set("action", action)
            both = []
            for weights in (one, two):
                with weights.to_module(network):
                    both.append(network(states.copy())["state_action_value"].squeeze(-1))
            assert (both[0] != both[1]).any(), "critics that differ"
            assert torch.equal(algorithm.q_values(samples, action), torch.minimum(*both))
        found = algorithm.measure_batch(samples)
        assert torch.equal(found["q"], algorithm.q_values(samples).mean())

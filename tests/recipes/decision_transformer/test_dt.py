"""Recipes of Decision Transformer: steps, evaluation, tasks and data."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from recipes.core import runner
from recipes.core.metrics import read_metrics
from recipes.core.run import Run
from recipes.decision_transformer import check_data
from tests.datasets.rollouts import roll, write
from tests.recipes.small import SMALL_DT, make_algorithm, make_dt, make_odt, train
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.datasets import (
    SequenceStorage,
    load_episodes,
    normalized_score,
    normalized_spread,
    select_episodes,
    write_minari,
)
from torchrl_tit.settings.networks import decision_transformer, dt_tit

pytestmark = pytest.mark.filterwarnings("ignore:target_returns")


@pytest.mark.numerics
def test_a_step_is_the_protocols(tmp_path):
    """Weights after two steps are those of AdamW on the masked error, with clipped gradients."""
    backbone = dt_tit(**SMALL_DT, dropout=0.0)
    settings: dict[str, Any] = {"iterations": 1, "updates_per_iteration": 2}
    recipe = make_dt(tmp_path, backbone=backbone, return_scale=50.0, weight_decay=10.0, **settings)
    _, state = load_checkpoint(train(recipe, tmp_path / "run").checkpoints)

    episodes = load_episodes(recipe.dataset)
    mean, std, _ = episodes.observation_statistics()
    storage = SequenceStorage(episodes, 6, return_scale=50.0)
    generator = torch.Generator().manual_seed(recipe.seed)
    torch.manual_seed(recipe.seed)
    agent = make_algorithm(recipe).model
    agent.network.history_encoder.return_scale.fill_(1.0)
    optimizer = torch.optim.AdamW(agent.parameters(), lr=1.0, weight_decay=10.0)
    for step in range(2):
        batch = storage[torch.randint(len(storage), (8,), generator=generator)]
        batch["observation"] = (batch["observation"] - mean) / (std + 1e-6)
        names = ("observation", "action", "return_to_go", "timestep", "mask")
        features = agent.network.every_frame(*(batch[name] for name in names))
        error = (agent.head(features) - batch["action"])[batch["mask"]]
        optimizer.zero_grad()
        error.square().mean().backward()
        torch.nn.utils.clip_grad_norm_(agent.parameters(), 0.25)
        optimizer.param_groups[0]["lr"] = 1e-3 * (step + 1) / 4
        optimizer.step()
    for name, weight in agent.named_parameters():
        trained = state["networks"][name]
        torch.testing.assert_close(trained, weight.detach(), rtol=1e-4, atol=1e-6, msg=name)
    frames = "network.frame_encoders.observation"
    torch.testing.assert_close(state["networks"][f"{frames}.mean"], mean)
    torch.testing.assert_close(state["networks"][f"{frames}.variance"], std**2)


@pytest.mark.parametrize("full", [False, True])
def test_windows_are_trained_and_measured_as_the_recipe_says(full, tmp_path):
    """Windows longer than any episode all begin with its first step, if they are full."""
    backbone = replace(dt_tit(**SMALL_DT), num_frames=100)
    recipe = make_dt(tmp_path, backbone=backbone, full_windows=full)
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, tmp_path)
    measured = algorithm.measured_items(load_episodes(recipe.dataset))
    for windows in (algorithm.buffer.sample(64), measured.get(range(len(measured)))):
        first = windows["timestep"].masked_fill(~windows["mask"], 1_000).amin(1)
        assert (first > 0).any() == (not full)


def test_an_episode_of_the_evaluation_is_the_protocols(tmp_path):
    """Step by step in Gymnasium: normalized states, return to go and actions of the last steps."""
    settings: dict[str, Any] = {"target_returns": (60.0,), "evaluation_episodes": 1}
    recipe = make_dt(
        tmp_path, acting_num_frames=4, return_scale=50.0, evaluation_seed=3, **settings
    )
    algorithm = make_algorithm(recipe)
    agent = deepcopy(algorithm.model)
    agent.network.history_encoder.return_scale.fill_(1.0)
    mean, std, _ = algorithm.load_data().observation_statistics()
    env = gymnasium.make("Hopper-v5")
    observation, _ = env.reset(seed=3)
    states, actions, to_go, ended = [], [torch.zeros(3)], [60.0], False
    while not ended:
        state = torch.as_tensor(observation, dtype=torch.float32)
        states.append((state - mean) / (std + 1e-6))
        steps = torch.arange(len(states))[-4:]
        window = [torch.stack(x)[steps] for x in (states, actions)]
        returns_to_go = torch.tensor(to_go)[steps].unsqueeze(-1) / 50
        with torch.no_grad():
            actions[-1] = agent.head(agent.network(*window, returns_to_go, steps))
        observation, reward, terminated, truncated, _ = env.step(actions[-1].numpy())
        actions.append(torch.zeros(3))
        to_go.append(to_go[-1] - float(reward))
        ended = terminated or truncated
    assert len(states) > 6
    (outcome,) = algorithm.play(step=0)
    assert outcome.mean == pytest.approx(60 - to_go[-1], rel=1e-4)


def test_evaluation_is_of_both_targets_and_the_best_of_all(tmp_path):
    recipe = make_dt(tmp_path)
    with train(recipe, tmp_path / "run") as run:
        evaluation = runner.evaluate(run)
        rows = read_metrics(run.folder / "metrics.csv")
        last = rows[-1]
        played = [row for row in rows if not np.isnan(row["return_mean"])]
    assert [row["step"] for row in played] == [9, 18]
    assert [row["step"] for row in rows] == [5, 9, 10, 15, 18]
    targets = evaluation["targets"]
    assert {name: target["mean"] for name, target in targets.items()} == pytest.approx(
        {"40": last["return_40"], "10": last["return_10"]}
    )
    better = max(targets.values(), key=lambda target: target["mean"])
    assert evaluation["mean"] == better["mean"] == last["return_mean"]
    assert evaluation["returns"] == better["returns"]
    assert evaluation["std"] == pytest.approx(np.std(better["returns"]))
    assert evaluation["score_std"] == pytest.approx(normalized_spread(evaluation["std"], "hopper"))
    highest = max(row["return_mean"] for row in played)
    assert evaluation["score"] == pytest.approx(
        {
            "best": normalized_score(highest, "hopper"),
            "last": normalized_score(last["return_mean"], "hopper"),
        }
    )
    assert evaluation["episodes"] == 3
    assert (evaluation["steps"], evaluation["seed"]) == (18, recipe.evaluation_seed)

    with Run.open(run.folder) as again:  # other seeds are played, the same ones are not
        other = runner.evaluate(again, replace(recipe, evaluation_seed=5))
        assert other["returns"] != evaluation["returns"]
        more = runner.evaluate(again, replace(recipe, evaluation_episodes=4))
        assert len(more["returns"]) == 4
        assert more["targets"]["40"]["returns"][:3] == pytest.approx(
            targets["40"]["returns"], rel=1e-4
        )


def test_a_target_that_the_data_never_reach_is_warned_of(tmp_path):
    recipe = make_dt(tmp_path, target_returns=(5000.0, 10.0), updates_per_iteration=1)
    with pytest.warns(UserWarning, match=r"target_returns 5000: no episode in .*hopper\.hdf5.*ran"):
        train(recipe, tmp_path / "run")


def test_data_that_do_not_fit_the_network(tmp_path):
    arrays = roll()
    arrays["timeouts"][:] = arrays["terminals"][:] = False
    arrays["timeouts"][-1] = True
    arrays["next_observations"][:-1] = arrays["observations"][1:]
    path = write(tmp_path / "long.hdf5", arrays)
    long = len(arrays["rewards"])
    episodes = load_episodes(str(path), task="Hopper-v5")
    recipe = make_dt(tmp_path, backbone=decision_transformer(5, max_ep_len=long - 1))
    with pytest.raises(ValueError, match=f"have up to {long} steps, but max_ep_len is {long - 1}"):
        check_data(recipe, episodes)
    check_data(make_dt(tmp_path, backbone=decision_transformer(5, max_ep_len=long)), episodes)
    message = r"actions in .* are continuous \(torch.float32\), but .* \(discrete actions are int"
    with pytest.raises(ValueError, match=message):
        check_data(make_dt(tmp_path, action_space="discrete"), episodes)


class Endless(gymnasium.Env[Any, Any]):
    """Never ends by itself."""

    observation_space = Box(-1.0, 1.0, (3,), np.float32)

    def __init__(self, lowest: float = -1.0) -> None:
        self.action_space = Box(np.array([-1.0, lowest], np.float32), np.ones(2, np.float32))

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(3, np.float32), 1.0, False, False, {}


gymnasium.register("tests/Endless-v0", lambda **_: Endless())
gymnasium.register("tests/Lopsided-v0", lambda **_: Endless(lowest=0.0), max_episode_steps=10)
gymnasium.register("tests/Long-v0", lambda **_: Endless(), max_episode_steps=30)


def test_a_task_without_a_time_limit_is_cut_off_where_time_steps_end(tmp_path):
    recipe = make_dt(
        tmp_path,
        env="tests/Endless-v0",
        backbone=dt_tit(**SMALL_DT, max_ep_len=12),
        evaluation_episodes=2,
    )
    assert [outcome.returns for outcome in make_algorithm(recipe).play(0)] == [[12, 12]] * 2


def test_episodes_that_are_explored_are_as_long_as_those_of_the_evaluation(tmp_path):
    """Without an embedding of time steps nothing ends at max_ep_len but endless tasks."""
    backbone = dt_tit(**SMALL_DT, max_ep_len=12, timestep_embedding=False)
    for env, length in {"tests/Endless-v0": 12, "tests/Long-v0": 30}.items():
        recipe = make_odt(tmp_path, env=env, backbone=backbone, evaluation_episodes=1)
        algorithm = make_algorithm(recipe)
        episodes = algorithm.explore(0)
        assert episodes.lengths.tolist() == algorithm.play(0)[0].returns == [length]
        assert episodes.truncated.all()


def test_every_entry_of_an_action_must_reach_as_far_as_the_heads(tmp_path):
    with pytest.raises(ValueError, match="actions of tests/Lopsided-v0 range from 0 to 1, but"):
        make_algorithm(make_dt(tmp_path, env="tests/Lopsided-v0"))


def test_nothing_is_learned_from_parts_of_episodes(tmp_path):
    """The rest of their returns, and the steps before them, are not known."""
    arrays = roll(max_episode_steps=15)
    ends = np.flatnonzero(arrays["terminals"] | arrays["timeouts"])
    arrays["next_observations"][ends[3] - 4] += 1.0
    recipe = make_dt(tmp_path, dataset=str(write(tmp_path / "a.hdf5", arrays)), gaps="cut")
    data = load_episodes(recipe.dataset, gaps="cut")
    assert int(data.cut.sum()) == 2
    rest = make_algorithm(recipe).load_data()
    assert rest.lengths.tolist() == data.lengths[data.whole].tolist()

    single = select_episodes(data, data.whole[:1])
    write_minari(single, folder := tmp_path / "hopper-v0")
    recipe = make_dt(tmp_path, dataset=str(folder), validation_fraction=0.5)
    with pytest.raises(ValueError, match="has a single whole episode, of which no part can be"):
        make_algorithm(recipe).load_data()


def test_only_episodes_that_are_trained_on_must_be_short(tmp_path):
    """The last one, which the data break off in, is left out."""
    arrays = roll(max_episode_steps=15)
    arrays["terminals"][-40:] = arrays["timeouts"][-40:] = False
    arrays["next_observations"][-41:-1] = arrays["observations"][-40:]
    path = str(write(tmp_path / "broken_off.hdf5", arrays))
    recipe = make_dt(tmp_path, backbone=decision_transformer(5, max_ep_len=15))
    episodes = load_episodes(path, task="Hopper-v5")
    check_data(recipe, episodes)
    assert episodes.lengths.max() > 15

    last = torch.tensor([len(episodes.lengths) - 1])
    write_minari(select_episodes(episodes, last), folder := tmp_path / "hopper-v0")
    with pytest.raises(ValueError, match=r"no episode in .*hopper-v0 is finished"):
        check_data(
            replace(recipe, dataset=str(folder)), load_episodes(str(folder), task="Hopper-v5")
        )

"""DQN: its gradient steps, its exploration, what it reads, and runs that are resumed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from recipes.core.metrics import read_metrics
from recipes.dqn import DQN, DQNAlgorithm
from tests.recipes.small import Batches, train
from tests.recipes.small import make_algorithm as make
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.settings.networks import mlp

SMALL = DQN(
    name="dqn/cartpole/small",
    env="CartPole-v1",
    backbone=mlp(hidden_dim=8, activation="relu"),
    batch_size=8,
    random_steps=20,
    steps_per_batch=10,
    total_steps=60,
    updates_per_step=0.5,
    target_interval=3,
    log_interval=10,
    checkpoint_interval=30,
    evaluation_episodes=1,
)


def double(recipe: DQN, folder: Path) -> tuple[DQNAlgorithm, TensorDict]:
    """An algorithm in float64, whose target network says the opposite, and transitions."""
    torch.manual_seed(0)
    algorithm = make(recipe)
    algorithm.prepare(0, folder)
    algorithm.close()
    algorithm.model.double()
    with torch.no_grad():
        for name, weight in algorithm.model.state_dict().items():
            if name.startswith("target_value_network_params.module.1."):  # the values' layer
                weight.neg_()
    size, frames = 16, recipe.backbone.num_frames
    seen = torch.randn(size, frames + 1, 4, dtype=torch.float64)
    terminated = (torch.arange(size) % 4 == 0).unsqueeze(-1)
    here, there = (
        {"history": history, "observation": history[:, -1]}
        for history in (seen[:, :-1], seen[:, 1:])
    )
    reward = torch.randn(size, 1, dtype=torch.float64)
    after = {**there, "reward": reward, "terminated": terminated, "done": terminated}
    batch = {**here, "action": torch.randint(2, (size,)), "next": after}
    return algorithm, TensorDict(batch, [size])


def values(algorithm: DQNAlgorithm, states: TensorDictBase, params: str) -> torch.Tensor:
    """The values of all actions with the weights of a network, [B, actions]."""
    with getattr(algorithm.model, params).data.to_module(algorithm.policy):
        return algorithm.policy(states.select("history"))["action_value"].detach()


def test_the_statistics_are_those_of_the_random_steps(tmp_path: Path) -> None:
    algorithm = make(replace(SMALL, normalize_observations=True))
    algorithm.prepare(0, tmp_path)
    seen, step = [], 0
    for batch in algorithm.batches():
        if step < 20:
            batch["observation"][..., -1] = 0.7  # which has rounding errors
        seen.append(batch["observation"].flatten(0, 1).clone())
        algorithm.update(batch, step)
        step += batch.numel()
    algorithm.close()
    random = torch.cat(seen)[:20]
    variance = random.var(0, False)
    variance[-1] = 1  # of a constant
    buffers = dict(algorithm.model.named_buffers())
    for ending, expected in (("mean", random.mean(0)), ("variance", variance)):
        found = [buffer for name, buffer in buffers.items() if name.endswith(f".{ending}")]
        assert len(found) == 2  # of the network and of its target
        for buffer in found:
            torch.testing.assert_close(buffer, expected, rtol=1e-5, atol=1e-6)
    (frames,) = (m for m in algorithm.policy.modules() if isinstance(m, NormalizedFrames))
    assert frames.count == 20


def test_categories_are_not_normalized() -> None:
    with pytest.raises(ValueError, match=r"FrozenLake-v1 are torch\.int64, not"):
        make(replace(SMALL, env="FrozenLake-v1", normalize_observations=True))


@pytest.mark.parametrize("doubled", [True, False])
def test_the_target_of_a_gradient_step(doubled: bool, tmp_path: Path) -> None:
    algorithm, batch = double(replace(SMALL, double=doubled, gamma=0.9), tmp_path)
    trained, target = "value_network_params", "target_value_network_params"
    q = values(algorithm, batch, trained).gather(1, batch["action"].unsqueeze(1))
    following = values(algorithm, batch["next"], target)
    best = values(algorithm, batch["next"], trained if doubled else target).argmax(1, keepdim=True)
    other = values(algorithm, batch["next"], target if doubled else trained).argmax(1, keepdim=True)
    assert (best != other).all()
    alive = 1 - batch["next", "terminated"].double()
    expected = (q - batch["next", "reward"] - 0.9 * alive * following.gather(1, best)).square()
    terms = algorithm.learn(batch, 0)
    torch.testing.assert_close(terms["loss"], expected.mean())
    assert terms["epsilon"] == 1


def test_all_actions_count_where_a_truncated_state_allows_none(tmp_path: Path) -> None:
    recipe = replace(SMALL, env="Taxi-v4", mask_actions=True)
    algorithm = make(recipe)
    algorithm.prepare(0, tmp_path)
    batch = next(iter(algorithm.batches())).flatten()
    algorithm.close()
    allowed = batch.clone()
    allowed["next", "action_mask"][:] = True
    batch["next", "action_mask"][::2] = False
    allowed["next", "action_mask"][1::2] = batch["next", "action_mask"][1::2]
    found, expected = (algorithm.loss(one)["loss_value"] for one in (batch, allowed))
    torch.testing.assert_close(found, expected)


def test_target_updates_and_learning(tmp_path: Path) -> None:
    recipe = replace(SMALL, learning_rate=0.05, target_interval=30)
    algorithm, batch = double(recipe, tmp_path)
    before = {n: w.clone() for n, w in algorithm.model.state_dict().items()}
    losses = [algorithm.learn(batch.clone(), number)["loss"] for number in range(29)]
    state = algorithm.model.state_dict()
    targets = [n for n in state if n.startswith("target_")]
    assert all(torch.equal(state[n], before[n]) for n in targets)
    assert losses[-1] < 0.7 * losses[0]
    algorithm.learn(batch, 29)
    state = algorithm.model.state_dict()
    assert all(torch.equal(state[n], state[n.removeprefix("target_")]) for n in targets)


def test_gradient_steps_are_counted_from_the_first_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm, counted = make(SMALL), list[int]()
    algorithm.prepare(0, tmp_path)
    learn = algorithm.learn

    def count(samples: TensorDictBase, number: int) -> Any:
        counted.append(number)
        return learn(samples, number)

    monkeypatch.setattr(algorithm, "learn", count)
    for step, batch in zip(range(0, 50, 10), algorithm.batches(), strict=False):
        algorithm.update(batch, step)
    algorithm.close()
    assert counted == [*range(3 * 5)]  # of the batches after the random steps


def test_exploration(tmp_path: Path) -> None:
    """Random actions first, then less and less, and none in evaluations."""
    recipe = replace(SMALL, exploration_fraction=0.5, final_epsilon=0.1, random_steps=30)
    run = train(recipe, tmp_path / "run", batches := Batches())
    actions = torch.cat([batch["action"].flatten() for batch in batches.batches[:3]])
    assert 0.2 < actions.double().mean() < 0.8
    rows = read_metrics(run.folder / "metrics.csv")
    epsilons = [row["epsilon"] for row in rows]
    assert epsilons[:3] == pytest.approx([float("nan")] * 3, nan_ok=True)
    assert epsilons[3:] == pytest.approx([1.0, 0.7, 0.4], abs=1e-5)
    algorithm = make(recipe)
    assert algorithm.play(60)[0].returns == algorithm.play(60)[0].returns


def test_exploration_follows_the_length_of_the_run(tmp_path: Path) -> None:
    run = train(SMALL, tmp_path / "run")
    run.lengthen(120)
    train(run.recipe, run.folder)
    rows = read_metrics(run.folder / "metrics.csv")
    epsilons = [row["epsilon"] for row in rows[6:]]  # 60 steps were done, 40 of them not random
    expected = [1 - 0.95 * min(1, done / 60) for done in range(40, 100, 10)]
    assert epsilons == pytest.approx(expected, abs=1e-6)
    algorithm = make(replace(SMALL, total_steps=100_000_020))
    algorithm.prepare(25_000_020, tmp_path)
    algorithm.close()
    assert algorithm.exploration.eps == pytest.approx(1 - 0.95 / 2)


def test_forbidden_actions_are_neither_taken_nor_valued(tmp_path: Path) -> None:
    recipe = replace(SMALL, env="Taxi-v4", mask_actions=True, num_envs=2, total_steps=40)
    train(recipe, tmp_path / "run", batches := Batches())
    masks, actions = (
        torch.cat([batch[name].flatten(0, 1) for batch in batches.batches])
        for name in ("action_mask", "action")
    )
    assert masks.gather(1, actions.unsqueeze(1)).all()
    assert not masks.all()
    algorithm = make(replace(recipe, gamma=1.0))
    algorithm.prepare(0, tmp_path / "other")
    algorithm.close()
    stored = ["observation", "action", "action_mask", "next"]
    algorithm.buffer.extend(batches.batches[0].select(*stored))
    batch = algorithm.buffer.sample()
    # A target of the best allowed action, which is not always the best of all.
    following = values_of_taxi(algorithm, batch["next"])
    allowed = following.masked_fill(~batch["next", "action_mask"], -torch.inf)
    assert (allowed.argmax(1) != following.argmax(1)).any()
    q = values_of_taxi(algorithm, batch).gather(1, batch["action"].unsqueeze(1)).squeeze(1)
    target = batch["next", "reward"].squeeze(1) + allowed.max(1).values
    loss = algorithm.learn(batch, 0)["loss"]
    torch.testing.assert_close(loss, (q - target).square().mean())


def values_of_taxi(algorithm: DQNAlgorithm, states: TensorDictBase) -> torch.Tensor:
    """The values of all actions, masked or not."""
    everything = states.select("history", "observation").set(
        "action_mask", torch.ones_like(states["action_mask"])
    )
    return algorithm.policy(everything)["action_value"].detach()


def test_clipped_rewards(tmp_path: Path) -> None:
    algorithm = make(replace(SMALL, clip_rewards=True))
    reward = torch.tensor([[[-3.0], [0.0], [0.2]]])
    batch = TensorDict({"next": {"reward": reward, "observation": torch.zeros(1, 3, 4)}}, [1, 3])
    assert algorithm.collected(batch)["next", "reward"].flatten().tolist() == [-1, 0, 1]
    assert batch["next", "reward"] is reward  # what callbacks see

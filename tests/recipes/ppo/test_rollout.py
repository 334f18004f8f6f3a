"""Batches that keep each frame once: their windows, values, minibatches, size and checkpoints."""

import shutil
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch._dynamo.utils import counters
from torchrl.modules import RandomPolicy
from torchrl.objectives.value import GAE

from recipes.core.compilation import ONLY_TENSORS, compile_and_time
from recipes.core.runner import evaluate
from recipes.ppo import PPO, ActorCritic, PPOAlgorithm
from tests.modules.frames import CountedFrames
from tests.numerics import assert_near
from tests.recipes.ppo.algorithms import perturb
from tests.recipes.small import train
from torchrl_tit.envs import make_env
from torchrl_tit.rollout import FrameCollector, Rollout
from torchrl_tit.settings import CoBERL, Inner, Network
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp, vanilla_tit

SMALL: dict[str, Any] = {"embed_dim": 8, "features_dim": 8}
RECIPE = PPO(
    env="CartPole-v1",
    backbone=enhanced_tit(4, **SMALL),
    num_envs=3,
    total_steps=192,
    steps_per_batch=96,
    minibatch_size=32,
    sequence_length=16,
    epochs=1,
    compile="off",
)
SHORT_EPISODES = replace(RECIPE, env_settings=("max_episode_steps=11",))
NETWORKS = {
    "tit": enhanced_tit(4, **SMALL),
    "vanilla": vanilla_tit(4, temporal_positions="learned", **SMALL),
    "separate trunks": mlp(4, hidden_dim=8),
    "lstm": lstm(hidden_dim=8, **SMALL),
    "lstm on windows": replace(lstm(hidden_dim=8, **SMALL), num_frames=4),
    "coberl": Network(
        frame=Inner(embed_dim=8),
        history=CoBERL(num_blocks=1, num_heads=2, hidden_dim=8),
        num_frames=4,
    ),
}


class Seen:
    """Remembers the histories that a policy reads, which the batches lack."""

    def __init__(self):
        self.histories = []

    def __call__(self, history):
        self.histories.append(history.clone())
        return history.new_zeros(len(history), 1)

    def take(self):
        """[envs, time, K, *obs]"""
        histories, self.histories = torch.stack(self.histories, 1), []
        return histories


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize(("envs", "frames"), [(1, 1), (3, 2), (2, 4), (2, 40)])
def test_windows_are_those_that_the_policy_read(envs, frames, padding):
    """Across resets and batches, of which several fit into a window of 40."""
    env = make_env(
        "CartPole-v1", envs, seed=0, num_frames=frames, padding=padding, keep_histories=False
    )
    seen = Seen()
    policy = TensorDictSequential(
        TensorDictModule(seen, ["history"], ["seen"]), RandomPolicy(env.action_spec)
    )
    collector = FrameCollector(
        env,
        policy,
        frames_per_batch=13 * envs,
        total_frames=78 * envs,
        auto_register_policy_transforms=False,
    )
    ended = 0
    for batch in collector:
        whole = batch.clone()
        assert not any("history" in str(key) for key in batch.keys(True))
        rollout = Rollout(batch, frames, padding)
        read = seen.take()
        number = torch.arange(13 * envs).view(envs, 13)
        assert torch.equal(rollout.histories(number)[0], read)
        assert torch.equal(read[:, :, -1], whole["observation"])
        done = whole["next", "done"].squeeze(-1)
        is_init = rollout.is_init.view(envs, 13)
        assert torch.equal(is_init[:, 1:], done[:, :-1])

        ends = done.clone()
        ends[:, -1] = True
        assert torch.equal(rollout.ends, ends)
        newest = whole["next", "observation"].unsqueeze(2)
        following = torch.cat([read[:, :, 1:], newest], 2)
        last = torch.zeros_like(ends)
        last[:, -1] = True
        for steps in (ends, last):
            pairs = rollout.next_windows(steps, max_frames=frames * 3)
            parts = [windows.gather(table) for [table], windows in pairs]
            assert torch.equal(torch.cat(parts), following[steps])
            assert all(len(part) <= 3 for part in parts)
        assert len(rollout.frames[0]) == envs * (frames - 1 + 13) + ends.sum()
        assert "observation" not in batch
        assert "observation" not in batch["next"]
        ended += int(done.sum())
    assert ended >= 3
    collector.shutdown()


def collected(recipe, folder):
    """An algorithm in float64, its second batch, and the rollout of that."""
    algorithm = PPOAlgorithm(recipe)
    perturb(algorithm.model)
    algorithm.prepare(0, folder)
    batches = iter(algorithm.batches())
    with torch.no_grad():
        next(batches)
        batch = next(batches)
    algorithm.close()
    algorithm.model.double()
    algorithm.ppo_loss.double()
    batch = batch.apply(lambda x: x.double() if x.is_floating_point() else x)
    outcome = batch["next", "observation"].clone()
    rollout = algorithm.rollout(batch)
    assert rollout.is_init.any()
    return algorithm, batch, rollout, outcome


@pytest.mark.numerics
@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("name", ["tit", "separate trunks", "lstm on windows"])
def test_values_and_advantages_are_those_of_whole_windows(name, padding, tmp_path):
    recipe = replace(SHORT_EPISODES, backbone=NETWORKS[name], padding=padding)
    algorithm, batch, rollout, outcome = collected(recipe, tmp_path)
    model, algorithm.gae = algorithm.model, GAE(gamma=0.875, lmbda=0.75, value_network=None)
    done = batch["next", "done"]
    truncated = done & (done.cumsum(1) % 2 == 0)  # every other episode, whatever ended it
    assert truncated.any()
    batch["next"].update({"truncated": truncated, "terminated": done & ~truncated})
    windows = rollout.histories(torch.arange(96))[0].view(3, 32, 4, 4)
    following = torch.cat([windows[:, :, 1:], outcome.unsqueeze(2)], 2)
    with torch.no_grad():
        states = TensorDict({"history": torch.stack([windows, following])}, [2, 3, 32])
        value, next_value = model.critic(model.backbone(states))["state_value"]
        batch["state_value"] = value
        algorithm.advantages(batch, rollout)
    stops = done & ~truncated
    assert_near(batch["next", "state_value"], next_value.masked_fill(stops, 0))
    reward = batch["next", "reward"]
    expected = advantages_by_hand(reward, value, next_value, done, stops, 0.875, 0.75)
    assert_near(batch["advantage"], expected)
    assert_near(batch["value_target"], expected + value)


def numbers_of(minibatch, rollout):
    """The numbers of a minibatch's steps in the batch, [N, T], found by their newest frame."""
    newest = minibatch.windows.gather(minibatch.frames[0])[..., -1, :].unsqueeze(-2)
    same = (newest == rollout.frames[0][rollout.newest]).all(-1)  # [N, T, steps]
    assert (same.sum(-1) == 1).all()
    return same.int().argmax(-1)


def advantages_by_hand(reward, value, next_value, done, stops, gamma, lmbda):
    """Generalized advantage estimation (arXiv 1506.02438), [envs, time, 1].

    Args:
        stops: where no value follows: at terminations, and at time limits if they count as such.
    """
    expected = torch.zeros_like(value)
    for i in range(value.shape[0]):
        running = 0.0
        for t in reversed(range(value.shape[1])):
            # A termination has no value after it, a time limit has that of the true next state.
            bootstrapped = 0.0 if stops[i, t, 0] else next_value[i, t, 0]
            delta = reward[i, t, 0] + gamma * bootstrapped - value[i, t, 0]
            running = delta + gamma * lmbda * (0.0 if done[i, t, 0] else running)
            expected[i, t, 0] = running
    return expected


def features_by_hand(model, minibatch, histories):
    """Step by step: of whole windows, or with the state that the network carries."""
    if not model.backbone.is_recurrent:
        histories = histories.flatten(0, 1)
        return model.backbone(TensorDict({"history": histories}, [len(histories)]))
    minibatch = minibatch.steps.copy().update({"history": histories})
    steps, state = [], minibatch[:, 0].select(*model.backbone.state_shapes)
    for time in range(minibatch.shape[1]):
        step = model.backbone(state.update(minibatch[:, time].select("history", "is_init")))
        steps.append(step.select("features"))
        state = step["next"].copy()
    return torch.stack(steps, 1).flatten(0, 1)


@pytest.mark.numerics
@pytest.mark.parametrize(("envs", "padding"), [(1, "constant"), (3, "same")])
@pytest.mark.parametrize("name", NETWORKS)
def test_loss_and_gradient_are_those_of_whole_windows(name, envs, padding, tmp_path):
    recipe = replace(
        SHORT_EPISODES, backbone=NETWORKS[name], num_envs=envs, padding=padding, entropy_coeff=0.1
    )
    algorithm, batch, rollout, _ = collected(recipe, tmp_path)
    model, weights = algorithm.model, list(algorithm.model.parameters())
    with torch.no_grad():
        algorithm.advantages(batch, rollout)
        batch["action_log_prob"] += 0.3 * torch.randn_like(batch["action_log_prob"])  # clips some
    resets = 0
    for minibatch in algorithm.minibatches(batch, rollout):
        steps, frames, windows = minibatch
        assert steps.shape == (2, 16)
        resets += int(steps["is_init"][:, 1:].sum())
        [histories] = rollout.histories(numbers_of(minibatch, rollout))
        assert torch.equal(windows.gather(frames[0]), histories)
        total, terms = algorithm._objective(minibatch._replace(steps=steps.copy()))
        gradients = torch.autograd.grad(total, weights, allow_unused=True)

        whole = steps.flatten(0, 1).update(features_by_hand(model, minibatch, histories))
        losses = algorithm.ppo_loss(whole)
        expected = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        expected_gradients = torch.autograd.grad(expected, weights, allow_unused=True)
        assert 0 < terms[5] < 1  # of the ratios some are clipped, others are not
        assert_near(total, expected)
        for gradient, other in zip(gradients, expected_gradients, strict=True):
            assert (gradient is None) == (other is None)
            if gradient is not None:
                assert_near(gradient, other)
    assert resets > 2


def test_each_frame_of_a_sequence_is_encoded_once(tmp_path):
    algorithm, batch, rollout, _ = collected(RECIPE, tmp_path)
    with torch.no_grad():
        counted = CountedFrames(algorithm.model.backbone.module)
        algorithm.advantages(batch, rollout)
        assert counted.take() <= len(rollout.frames[0])
        for minibatch in algorithm.minibatches(batch, rollout):
            algorithm.loss(minibatch)
            assert counted.take() == 2 * (16 + 3)


def test_collection_and_evaluation_encode_each_frame_once(tmp_path, monkeypatch):
    counted, init = [], ActorCritic.__init__

    def counting(model, *args):
        init(model, *args)
        counted.append(CountedFrames(model.backbone.module))
        counted[-1].only_without_gradients = True

    monkeypatch.setattr(ActorCritic, "__init__", counting)
    recipe = replace(RECIPE, env="Pendulum-v1", evaluation_episodes=2)
    evaluate(train(recipe, tmp_path / "run"))
    # A batch has 96 steps, the 3 older frames of each environment at its start, the 4 of each next
    # history at its end, and two sequences of 16 that are checked to be finite.
    assert counted[0].take() <= 2 * (96 + 3 * 3 + 3 * 4 + 2 * (16 + 3))
    assert counted[1].take() <= 2 * (200 + 3)  # two episodes


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("c++"), reason="torch.compile needs a C++ compiler")
def test_the_compiled_objective_is_one_graph_and_the_eager_one(tmp_path):
    recipe = replace(RECIPE, backbone=enhanced_tit(4, num_blocks=1, **SMALL), padding="constant")
    algorithm, batch, rollout, _ = collected(recipe, tmp_path)
    weights = list(algorithm.model.parameters())
    with torch.no_grad():
        algorithm.advantages(batch, rollout)
    counters.clear()
    fast = compile_and_time(algorithm._objective, "the loss", algorithm)
    for minibatch in algorithm.minibatches(batch, rollout):
        results = []
        for objective in (algorithm._objective, fast):
            total, terms = objective(minibatch._replace(steps=minibatch.steps.copy()))
            results.append([total, terms, *torch.autograd.grad(total, weights)])
        assert_near(*results)
    assert counters["stats"]["unique_graphs"]
    assert not counters["graph_break"]


class Weighed:
    """An algorithm whose loss has a number of its own."""

    __module__ = "recipes.ppo"
    model = policy = nn.Module()

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def loss(self, x: torch.Tensor) -> torch.Tensor:
        return self.weight * x.sum()


def test_two_runs_of_one_process_share_no_compiled_loss(monkeypatch):
    monkeypatch.setitem(ONLY_TENSORS, "backend", "eager")
    for weight in range(12):  # more than the entries that torch.compile keeps of a function
        owner: Any = Weighed(weight)
        loss = compile_and_time(owner.loss, "the loss", owner)
        assert loss(torch.ones(3)) == loss(torch.ones(3)) == 3 * weight


@pytest.mark.parametrize(
    ("fields", "length"),
    [
        ({"minibatch_size": 512}, 16),
        ({"minibatch_size": 64}, 4),
        ({"minibatch_size": 48}, 1),
        ({"steps_per_batch": 81}, 1),
        ({"sequence_length": 32}, 32),
        ({"backbone": enhanced_tit(1, **SMALL), "sequence_length": 32}, 1),
        ({"backbone": lstm(**SMALL), "minibatch_size": 40}, 8),
    ],
)
def test_the_length_of_sequences(fields, length):
    recipe = replace(RECIPE, **{"sequence_length": None, **fields})
    assert recipe.steps_per_sequence == length

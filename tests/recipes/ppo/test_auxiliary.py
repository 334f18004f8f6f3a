"""The self-supervised losses beside PPO's own."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.nn import functional as F
from torchrl.data import Binary, Categorical, MultiCategorical, Unbounded

from recipes.algorithm import make_algorithm
from recipes.metrics import read_metrics
from recipes.ppo import PPO
from recipes.ppo.algorithm import PPOAlgorithm, add_advantages, minibatches
from recipes.ppo.auxiliary import ActionEntries
from recipes.run import Run
from recipes.runner import train
from tests.numerics import assert_near
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

TIT = enhanced_tit(4, patch_size=2, embed_dim=8, num_blocks=1, features_dim=8)
NETWORKS = {"tit": TIT, "lstm": lstm(hidden_dim=8)}
SMALL = PPO(
    env="CartPole-v1",
    backbone=TIT,
    num_envs=2,
    steps_per_batch=64,
    minibatch_size=32,
    total_steps=128,
    epochs=2,
    normalize_observations=True,
    evaluation_episodes=1,
    compile="off",
)
WEIGHTS: dict[str, Any] = {"next_frame_coeff": 0.5, "reconstruction_coeff": 0.25}


def first_minibatch(recipe, folder):
    torch.manual_seed(0)
    algorithm = PPOAlgorithm(recipe)
    algorithm.prepare(0, folder)
    batch = next(algorithm.batches())
    rollout = algorithm.agent.rollout(batch)
    with torch.no_grad():
        algorithm.agent.update_statistics(rollout)
        add_advantages(batch, rollout, algorithm.agent, algorithm.gae, True)
    torch.manual_seed(0)
    minibatch = next(minibatches(batch, rollout, algorithm.agent, recipe))
    algorithm.close()
    return algorithm, minibatch


@pytest.mark.numerics
@pytest.mark.parametrize("name", NETWORKS)
def test_they_are_added_with_their_weights(name, tmp_path):
    recipe = replace(SMALL, backbone=NETWORKS[name], **WEIGHTS)
    algorithm, minibatch = first_minibatch(recipe, tmp_path)
    agent = algorithm.agent
    total, terms = algorithm.objective(minibatch.copy())
    own = terms[algorithm.terms.index("loss_next_frame") :].tolist()

    seen = agent.encode(minibatch.copy())
    (frames,) = agent.backbone.module.frames
    key = "observation" if name == "tit" else "history"
    observations = minibatch[key] if name == "tit" else minibatch[key].squeeze(2)  # [N, T, 4]
    actions = F.one_hot(minibatch["action"], 2).float()
    losses = agent.auxiliary.next_frame, agent.auxiliary.reconstruction
    following = losses[0](seen["features"], actions, [observations], seen["is_init"].squeeze(-1))
    same = losses[1](seen["features"], [frames.normalize(observations)])
    plain = algorithm.loss(seen)
    expected = plain["loss_objective"] + plain["loss_critic"] + plain["loss_entropy"]
    assert_near(total, expected + 0.5 * following + 0.25 * same)
    assert own == pytest.approx([following.item(), same.item()], rel=1e-4)


def test_gradients_reach_the_frame_encoder_and_not_its_copy(tmp_path):
    algorithm, minibatch = first_minibatch(replace(SMALL, **WEIGHTS), tmp_path)
    agent = algorithm.agent
    loss, _ = agent.auxiliary(agent.encode(minibatch), agent.backbone)
    loss.backward()
    (frames,) = agent.backbone.module.frames
    assert all(parameter.grad.any() for parameter in frames.parameters())
    copy = agent.auxiliary.next_frame.target
    assert all(parameter.grad is None for parameter in copy.parameters())


def test_a_run_logs_them(tmp_path):
    recipe = replace(SMALL, **WEIGHTS)
    with Run.create(tmp_path / "run", recipe) as run:
        train(recipe, run)
    trained = load_checkpoint(run.checkpoints)[1]["networks"]
    rows = read_metrics(run.folder / "metrics.csv")
    assert all(0 < row["loss_next_frame"] < 2 and row["loss_reconstruction"] > 0 for row in rows)
    torch.manual_seed(recipe.seed)
    before = make_algorithm(recipe).networks().state_dict()
    name = next(name for name in before if name.startswith("auxiliary.next_frame.target"))
    assert not trained[name].equal(before[name])  # it followed


def test_without_them_there_is_nothing(tmp_path):
    algorithm = make_algorithm(SMALL)
    assert not [name for name in algorithm.networks().state_dict() if "auxiliary" in name]


@pytest.mark.parametrize("name", WEIGHTS)
def test_networks_that_read_single_steps_have_none(name):
    weight: dict[str, Any] = {name: 1.0}
    with pytest.raises(ValueError, match=f"{name} is the weight of a loss on sequences"):
        replace(SMALL, backbone=mlp(), **weight)


def test_categories_are_not_reconstructed():
    recipe = replace(
        SMALL, env="FrozenLake-v1", backbone=enhanced_tit(4, patch_size="auto"), **WEIGHTS
    )
    with pytest.raises(ValueError, match=r"is 0.25, but 'observation' is a row of categories"):
        make_algorithm(recipe)
    algorithm = PPOAlgorithm(replace(recipe, reconstruction_coeff=0.0))
    assert list(algorithm.agent.auxiliary.weights) == ["loss_next_frame"]


@pytest.mark.parametrize(
    ("spec", "action", "expected"),
    [
        (Categorical(3), [2, 0], [[0, 0, 1], [1, 0, 0]]),
        (MultiCategorical([2, 3]), [[1, 2]], [[0, 1, 0, 0, 1]]),
        (Binary(3, dtype=torch.int8), [[1, 0, 1]], [[1, 0, 1]]),
        (Unbounded((2, 2)), [[[0.5, 1.0], [2.0, -1.0]]], [[0.5, 1.0, 2.0, -1.0]]),
    ],
)
def test_entries_of_actions(spec, action, expected):
    entries = ActionEntries(spec)
    found = entries(torch.tensor(action, dtype=spec.dtype))
    assert found.dtype == torch.float32
    assert found.tolist() == expected
    assert entries.size == found.shape[-1]

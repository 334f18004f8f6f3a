"""PPO with a recurrent network: sequences, values across their ends, and resuming."""

from dataclasses import replace

import pytest
import torch
from torchrl.objectives.value import GAE

from recipes.cli import main
from recipes.core.numbers import plus_minus
from recipes.core.runner import evaluate
from recipes.ppo import PPO, PPOAlgorithm
from tests.numerics import assert_near
from tests.recipes.small import train
from torchrl_tit.rollout import FrameCollector, Rollout
from torchrl_tit.settings import HistorySettings
from torchrl_tit.settings.networks import lstm

RECIPE = PPO(
    env="CartPole-v1",
    hide_velocities=True,
    backbone=lstm(embed_dim=8, hidden_dim=8, features_dim=8),
    num_envs=2,
    total_steps=256,
    steps_per_batch=64,
    minibatch_size=32,
    sequence_length=8,
    epochs=2,
    learning_rate=1e-2,
    checkpoint_interval=64,
    evaluation_episodes=3,
)


@pytest.fixture(scope="module", params=["lstm", "mingru", "gated-deltanet", "mamba2"])
def collected(request):
    """A batch of 200 steps of 2 environments, and the algorithm whose policy took them."""
    torch.manual_seed(0)
    backbone = RECIPE.backbone
    if request.param != "lstm":
        backbone = replace(backbone, history=HistorySettings.get(request.param)())
    algorithm = PPOAlgorithm(replace(RECIPE, backbone=backbone, steps_per_batch=400))
    algorithm.gae = GAE(gamma=0.99, lmbda=0.95, value_network=None)
    algorithm.model.eval()
    env = algorithm.make_env(2, seed=0, keep_histories=False)
    torch.nn.init.normal_(algorithm.model.critic.module.weight)
    collector = FrameCollector(
        env,
        algorithm.policy,
        frames_per_batch=400,
        total_frames=400,
        auto_register_policy_transforms=False,
    )
    with torch.no_grad():
        batch = next(iter(collector))
    collector.shutdown()
    return batch, algorithm


@pytest.fixture
def batch(collected):
    batch, algorithm = collected
    with torch.no_grad():
        yield batch.clone(), algorithm


def test_the_next_values_know_the_state_before_them(batch):
    """At ends of episodes and of the batch too, where the collector computed none."""
    batch, algorithm = batch
    model = algorithm.model
    states = batch["next"].select(*model.backbone.state_shapes, "is_init")
    states["history"] = batch["next", "observation"].unsqueeze(2)
    following = model.critic(model.backbone(states.clone()))
    algorithm.advantages(batch, Rollout(batch, 1, "same"))
    terminated, next_value = batch["next", "terminated"], batch["next", "state_value"]
    assert_near(next_value, following["state_value"].masked_fill(terminated, 0))
    forgetful = states
    for key in model.backbone.state_shapes:
        forgetful[key] = torch.zeros_like(forgetful[key])
    forgetful = model.critic(model.backbone(forgetful))["state_value"]
    assert (next_value - forgetful)[~terminated].abs().max() > 1e-3


@pytest.mark.parametrize("history", ["lstm", "gru"])
def test_nothing_follows_where_all_copies_terminate(history):
    """As in tasks whose episodes are equally long: no state is left to evaluate."""
    recipe = replace(
        RECIPE, backbone=replace(RECIPE.backbone, history=HistorySettings.get(history)())
    )
    algorithm = PPOAlgorithm(recipe)
    env = algorithm.make_env(2, seed=0, keep_histories=False)
    batch = env.rollout(8, algorithm.policy)
    ends = torch.zeros_like(batch["next", "done"])
    ends[:, -1] = True
    batch["next"].update({"terminated": ends, "done": ends})
    batch["state_value"] = torch.ones(2, 8, 1)
    values = algorithm.next_values(batch, Rollout(batch, 1, "same"))
    assert_near(values, (~ends).float())


def test_minibatches_are_sequences_and_show_every_step_once_an_epoch(batch):
    batch, algorithm = batch
    number = torch.arange(400).view(2, 200, 1)
    batch["advantage"] = batch["value_target"] = number
    minibatches = list(algorithm.minibatches(batch, Rollout(batch, 1, "same")))
    parts = [minibatch.steps for minibatch in minibatches]
    assert [part.shape for part in parts] == [(4, 8)] * 12 + [(2, 8)] + [(4, 8)] * 12 + [(2, 8)]
    for epoch in (parts[:13], parts[13:]):
        steps = torch.cat([part["advantage"] for part in epoch]).squeeze(-1)  # [sequences, 8]
        assert (steps.diff(dim=1) == 1).all()
        assert steps.flatten().sort().values.tolist() == list(range(400))
    assert not torch.equal(parts[0]["advantage"], parts[13]["advantage"])
    # Before the first gradient step the features are those that acted.
    for minibatch in minibatches:
        rows = minibatch.steps["advantage"].flatten()
        algorithm._encode(*minibatch)
        features = minibatch.steps["features"].flatten(0, 1)
        assert_near(features, batch["features"].flatten(0, 1)[rows])


def test_a_film_is_evaluated_alike(tmp_path, capsys):
    run = train(replace(RECIPE, total_steps=64), tmp_path / "run")
    evaluation = evaluate(run)
    # One episode after the other remembers no more of them than all side by side.
    main(["play", str(run.folder), "--out", str(tmp_path / "film.gif"), "--episodes", "3"])
    returned = plus_minus(evaluation["mean"], evaluation["std"])
    assert f"return {returned} over" in capsys.readouterr().out

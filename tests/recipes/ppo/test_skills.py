"""The skills of the tuned baselines: warm-up, and CoBERL's contrastive loss."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import ClipPPOLoss

from recipes.metrics import read_metrics
from recipes.networks import NetworkConfig
from recipes.ppo import PPO
from recipes.ppo.agent import Agent
from recipes.ppo.atari import ATARI_RECIPES
from recipes.ppo.update import make_objective
from recipes.run import Run
from torchrl_tit.modules import LSTMConfig
from torchrl_tit.networks import (
    CatformerConfig,
    CoBERLConfig,
    EnhancedTITConfig,
    MLPConfig,
    NatureCNNConfig,
    OFENetConfig,
)
from torchrl_tit.objectives import contrastive_prediction_loss

SMALL = PPO(env="CartPole-v1", backbone=MLPConfig(hidden_dim=8), num_envs=2, steps_per_batch=64)
COBERL = CoBERLConfig(embed_dim=16, num_heads=2, num_blocks=1, features_dim=8, gate_bias=2)


@pytest.mark.parametrize(
    ("decay", "expected"),
    [(False, [1 / 3, 2 / 3, 1, 1]), (True, [1 / 3, 2 / 3 * 3 / 4, 1 / 2, 1 / 4])],
)
def test_warm_up_rises_linearly_and_decay_follows(decay, expected, tmp_path):
    recipe = replace(SMALL, total_steps=256, warmup_steps=192, decay_learning_rate=decay, epochs=1)
    with Run.create(tmp_path / "run", recipe) as run:
        recipe.train(run)
    rates = [row["learning_rate"] for row in read_metrics(run.folder / "metrics.csv")]
    assert rates == pytest.approx([3e-4 * fraction for fraction in expected])


def test_settings_of_the_tuned_baselines():
    catformer = ATARI_RECIPES["ppo/pong/catformer-tuned"]
    assert catformer.backbone == CatformerConfig(attention_expansion=2, ffn_expansion=4)
    coberl = ATARI_RECIPES["ppo/pong/coberl-tuned"]
    assert coberl.backbone == CoBERLConfig(gate_bias=2)
    assert (coberl.contrastive_coeff, coberl.masked_fraction) == (1, 0.15)
    for recipe in (catformer, coberl):
        plain = ATARI_RECIPES[recipe.name.removesuffix("-tuned")]
        assert plain.contrastive_coeff == plain.warmup_steps == 0
        assert (recipe.initialization, plain.initialization) == ("own", "orthogonal")
        assert recipe.warmup_steps > 0
        recipe.check()


@pytest.fixture
def agent_and_minibatch():
    torch.manual_seed(0)
    recipe = replace(ATARI_RECIPES["ppo/pong/coberl"], backbone=COBERL)
    env = recipe.make_env(1, seed=0)
    agent = Agent(recipe, env)
    env.close()
    n = 8
    minibatch = TensorDict(
        {
            "history": torch.randint(0, 256, (n, 4, 84, 84), dtype=torch.uint8),
            "action": torch.randint(0, 6, (n,)),
            "action_log_prob": -torch.rand(n),
            "advantage": torch.randn(n, 1),
            "value_target": torch.randn(n, 1),
        },
        [n],
    )
    return agent, minibatch


def test_the_contrastive_loss_is_added_with_its_weight(agent_and_minibatch):
    agent, minibatch = agent_and_minibatch
    loss = ClipPPOLoss(agent.actor, agent.critic, functional=False)
    plain, plain_terms = make_objective(agent, loss, None)(minibatch.copy())
    torch.manual_seed(1)
    total, terms = make_objective(agent, loss, None, contrastive_coeff=0.3, masked_fraction=0.5)(
        minibatch.copy()
    )
    torch.manual_seed(1)
    mask = torch.rand(8, 4) < 0.5
    network = agent.backbone.module
    encodings, predictions = network.predict_masked(minibatch["history"], mask)
    expected = contrastive_prediction_loss(encodings, predictions, mask)
    assert 0.2 < mask.float().mean() < 0.8
    torch.testing.assert_close(total, plain + 0.3 * expected)
    torch.testing.assert_close(terms, torch.cat([plain_terms, expected.detach().unsqueeze(0)]))
    gradient = torch.autograd.grad(total, network.history_encoder.mask_token)
    assert gradient[0].any()


def test_a_run_with_the_contrastive_loss_logs_it(tmp_path):
    recipe = replace(
        ATARI_RECIPES["ppo/pong/coberl-tuned"],
        backbone=COBERL,
        num_envs=1,
        total_steps=16,
        steps_per_batch=16,
        minibatch_size=16,
        epochs=2,
    )
    with Run.create(tmp_path / "run", recipe) as run:
        recipe.train(run)
    (row,) = read_metrics(run.folder / "metrics.csv")
    assert row["loss_contrastive"] > 0


@pytest.mark.parametrize("network", [NatureCNNConfig(), EnhancedTITConfig(), MLPConfig()])
def test_other_networks_have_no_contrastive_loss(network):
    with pytest.raises(ValueError, match="a loss of coberl alone"):
        replace(SMALL, backbone=network, contrastive_coeff=1.0)


PONG = ATARI_RECIPES["ppo/pong/nature-cnn"]


@pytest.mark.parametrize(
    ("recipe", "network", "history", "message"),
    [
        (SMALL, NatureCNNConfig(), 1, "image"),
        (SMALL, CatformerConfig(), 4, "image"),
        (SMALL, CoBERLConfig(), 4, "image"),
        (SMALL, OFENetConfig(), 2, "one observation, not a history of 2: set history to 1"),
        (SMALL, LSTMConfig(), 2, "set history to 1"),
        (SMALL, EnhancedTITConfig(temporal_position_encoding=True), 1, "temporal positions"),
        (SMALL, EnhancedTITConfig(num_heads_outer=5), 1, "heads"),
        (PONG, MLPConfig(), 4, "arrays"),
        (PONG, LSTMConfig(), 1, "arrays"),
        (PONG, CatformerConfig(), 1, "catformer is a transformer over time: set history to 2"),
        (PONG, CoBERLConfig(), 1, "coberl is a transformer over time: set history to 2"),
    ],
)
def test_a_network_that_does_not_fit_is_refused_before_anything_runs(
    recipe: PPO, network: NetworkConfig, history: int, message: str
) -> None:
    changed = replace(recipe, backbone=network, history=history)
    with pytest.raises(ValueError, match=message):
        changed.check()

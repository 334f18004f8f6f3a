"""The skills of the tuned baselines: warm-up, and CoBERL's contrastive loss."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from recipes.core.metrics import read_metrics
from recipes.core.run import Run
from recipes.core.runner import train
from recipes.ppo import PPO, Minibatch
from tests.recipes.ppo.algorithms import named, prepared
from torchrl_tit.networks import masked_predictions
from torchrl_tit.objectives import contrastive_prediction_loss
from torchrl_tit.settings.networks import (
    coberl,
    mlp,
)
from torchrl_tit.windows import Windows

SMALL = PPO(env="CartPole-v1", backbone=mlp(hidden_dim=8), num_envs=2, steps_per_batch=64)
COBERL = coberl(4, embed_dim=16, num_heads=2, num_blocks=1, features_dim=8, gate_bias=2)


@pytest.mark.parametrize(
    ("decay", "expected"),
    [(False, [1 / 3, 2 / 3, 1, 1]), (True, [1 / 3, 2 / 3 * 3 / 4, 1 / 2, 1 / 4])],
)
def test_warm_up_rises_linearly_and_decay_follows(decay, expected, tmp_path):
    recipe = replace(SMALL, total_steps=256, warmup_steps=192, decay_learning_rate=decay, epochs=1)
    with Run.create(tmp_path / "run", recipe) as run:
        train(recipe, run)
    rates = [row["learning_rate"] for row in read_metrics(run.folder / "metrics.csv")]
    assert rates == pytest.approx([3e-4 * fraction for fraction in expected])


def test_the_contrastive_loss_is_added_with_its_weight(tmp_path):
    recipe = replace(named("ppo/pong/coberl"), backbone=COBERL, num_envs=1, compile="off")
    n = 8
    steps = TensorDict(
        {
            "action": torch.randint(0, 6, (n, 1)),
            "action_log_prob": -torch.rand(n, 1),
            "advantage": torch.randn(n, 1, 1),
            "value_target": torch.randn(n, 1, 1),
        },
        [n, 1],
    )
    frames = torch.randint(0, 256, (n + 3, 84, 84), dtype=torch.uint8)
    windows = Windows(torch.arange(n).view(n, 1, 1) + torch.arange(4), None)
    results = []
    for coeff in (0.0, 0.3):
        torch.manual_seed(0)
        algorithm = prepared(replace(recipe, contrastive_coeff=coeff), tmp_path)
        torch.manual_seed(1)
        results.append(algorithm.objective(Minibatch(steps.copy(), [frames], windows)))
    (plain, plain_terms), (total, terms) = results
    torch.manual_seed(1)
    mask = torch.rand(n, 4) < 0.15
    network = algorithm.model.backbone.module
    predictions = masked_predictions(network, [windows.gather(frames).squeeze(1)], mask)
    expected = 0.3 * contrastive_prediction_loss(*predictions, mask)
    assert 0 < mask.sum() < mask.numel()
    torch.testing.assert_close(total, plain + expected, rtol=1e-4, atol=1e-5)
    expected_terms = torch.cat([plain_terms, expected.detach().unsqueeze(0)])
    torch.testing.assert_close(terms, expected_terms, rtol=1e-4, atol=1e-5)
    gradient = torch.autograd.grad(total, network.history_encoder.mask_token)
    assert gradient[0].any()
    assert "loss_contrastive" in algorithm.columns

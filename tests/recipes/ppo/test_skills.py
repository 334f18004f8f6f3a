"""The skills of the tuned baselines: warm-up, and CoBERL's contrastive loss."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from recipes.core.algorithm import make_algorithm
from recipes.core.metrics import read_metrics
from recipes.core.run import Run
from recipes.core.runner import train
from recipes.ppo import PPO, Minibatch
from tests.recipes.ppo.algorithms import named, prepared
from torchrl_tit.networks import masked_predictions
from torchrl_tit.objectives import contrastive_prediction_loss
from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import (
    catformer,
    coberl,
    enhanced_tit,
    mlp,
    nature_cnn,
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


def test_settings_of_the_tuned_baselines():
    one = named("ppo/pong/catformer-tuned")
    assert one.backbone == catformer(4, attention_expansion=2, ffn_expansion=4)
    other = named("ppo/pong/coberl-tuned")
    assert other.backbone == coberl(4, gate_bias=2.0)
    assert other.contrastive_coeff == 1
    for recipe in (one, other):
        plain = named(recipe.name.removesuffix("-tuned"))
        assert plain.contrastive_coeff == plain.warmup_steps == 0
        assert (recipe.initialization, plain.initialization) == ("own", "orthogonal")
        assert recipe.warmup_steps > 0
        make_algorithm(recipe).check()


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


def test_a_run_with_the_contrastive_loss_logs_it(tmp_path):
    recipe = replace(
        named("ppo/pong/coberl-tuned"),
        backbone=COBERL,
        num_envs=1,
        total_steps=16,
        steps_per_batch=16,
        minibatch_size=16,
        epochs=2,
    )
    with Run.create(tmp_path / "run", recipe) as run:
        train(recipe, run)
    (row,) = read_metrics(run.folder / "metrics.csv")
    assert row["loss_contrastive"] > 0


@pytest.mark.parametrize("network", [nature_cnn(), enhanced_tit(), mlp()])
def test_other_networks_have_no_contrastive_loss(network):
    with pytest.raises(ValueError, match="only coberl has"):
        replace(SMALL, backbone=network, contrastive_coeff=1.0)


PONG = named("ppo/pong/nature-cnn")


@pytest.mark.parametrize(
    ("recipe", "network", "message"),
    [
        (SMALL, nature_cnn(), "image"),
        (SMALL, catformer(4), "do not read an array"),
        (SMALL, coberl(4), "do not read an array"),
        (SMALL, enhanced_tit(num_heads_outer=5), "heads"),
        (PONG, replace(nature_cnn(4), frame=enhanced_tit(patch_size=12).frame), "flat"),
    ],
)
def test_a_network_that_does_not_fit_is_refused_before_anything_runs(
    recipe: PPO, network: Network, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make_algorithm(replace(recipe, backbone=network)).check()


def test_settings_that_make_no_network_are_refused():
    with pytest.raises(ValueError, match="num_frames"):
        enhanced_tit(1, temporal_positions="learned")

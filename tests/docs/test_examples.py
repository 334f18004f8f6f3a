"""The worked examples: TorchRL's losses train the backbone that stands in them."""

import pytest
import torch

from docs.examples import dqn, iql, ppo, sac, several_agents


def parameters_of_backbones(loss):
    """Trained parameters that belong to a frame or history encoder, by name."""
    return {
        name: parameter
        for name, parameter in loss.named_parameters()
        if "frame_encoder" in name or "history_encoder" in name
    }


@pytest.mark.parametrize(
    ("example", "short"),
    [(dqn, {"steps": 100}), (sac, {"steps": 100}), (iql, {"updates": 3})],
    ids=["dqn", "sac", "iql"],
)
def test_gradients_reach_the_backbone_and_targets_follow(example, short):
    loss = example.main(**short, dropout=0.1)
    trained = parameters_of_backbones(loss)
    assert trained
    for name, parameter in trained.items():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any() or "in_proj" in name, name
    targets = {
        name: buffer
        for name, buffer in loss.named_buffers()
        if name.startswith("target_") and "frame_encoder" in name
    }
    assert targets
    assert not any(target.requires_grad for target in targets.values())
    assert any(
        not torch.equal(target, dict(loss.named_parameters())[name.removeprefix("target_")])
        for name, target in targets.items()
    )


def test_ppo_trains_the_backbone_before_its_heads():
    backbone, loss = ppo.main(steps=512, dropout=0.1)
    heads = dict(loss.named_parameters())
    assert not parameters_of_backbones(loss)
    assert parameters_of_backbones(backbone)
    for name, parameter in [*backbone.named_parameters(), *heads.items()]:
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any() or "in_proj" in name, name


def test_several_agents_share_a_backbone_that_learns():
    backbone, rewards = several_agents.main(steps=2560)
    assert rewards[-1] > rewards[0] + 0.1
    for name, parameter in backbone.named_parameters():
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any() or "in_proj" in name, name

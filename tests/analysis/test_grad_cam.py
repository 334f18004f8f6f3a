"""Grad-CAM, held against captum's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from tests.analysis.policies import (
    IMAGE,
    IMAGE_NETWORKS,
    make_deterministic_policy,
    make_images,
    make_policy,
)
from tests.numerics import assert_near
from torchrl_tit.analysis import grad_cam
from torchrl_tit.analysis.layers import image_layers
from torchrl_tit.analysis.targets import find_network, run_policy
from torchrl_tit.frames.inner import InnerTransformer
from torchrl_tit.settings.networks import enhanced_tit, mlp

pytestmark = pytest.mark.numerics

GRIDS = {"nature-cnn": (1, 2), "resnet": (8, 11), "catformer": (8, 11), "coberl": (8, 11)}
STACKED = ("without outer", "nature-cnn", "resnet")


class LaidOut(nn.Module):
    """A normalization that lays its tokens out as an image on the way, for captum."""

    def __init__(self, norm: nn.Module, patches: int) -> None:
        super().__init__()
        self.norm = norm
        self.patches = patches
        self.image = nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(x)
        if x.shape[1] < self.patches:  # the class token alone
            return x
        first = x.shape[1] - self.patches
        image = self.image(x[:, first:].transpose(1, 2).unflatten(2, (3, 4)))  # [N, D, H, W]
        return torch.cat([x[:, :first], image.flatten(2).transpose(1, 2)], 1)


def captum_layer(network: Any) -> nn.Module:
    """The layer for captum: a convolution, or the place where tokens are an image."""
    inner = next((m for m in network.modules() if isinstance(m, InnerTransformer)), None)
    if inner is None:
        return [m for m in network.modules() if isinstance(m, nn.Conv2d)][-1]
    laid_out = LaidOut(inner.blocks[-1].get_submodule("norm1"), inner.patch_embedding.num_patches)
    inner.blocks[-1].norm1 = laid_out
    return laid_out.image


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", IMAGE_NETWORKS)
def test_against_captum(name: str) -> None:
    captum = pytest.importorskip("captum.attr")
    policy, states = make_policy(IMAGE_NETWORKS[name], IMAGE), make_images(2)
    actions = grad_cam(policy, states, relu=False)["observation"]
    values = grad_cam(policy, states, target="value", relu=False)["observation"]
    assert_near(grad_cam(policy, states)["observation"], actions.relu())
    assert all(module.training for module in policy.modules()), "the policy's mode has changed"
    frames = 1 if name in STACKED else 3
    assert actions.shape == (2, frames, *GRIDS.get(name, (3, 4)))
    assert actions.any(), "nothing is mapped"
    assert not torch.allclose(actions, values)

    policy.eval()

    def log_prob(history: Tensor) -> Tensor:
        _, distribution = run_policy(policy, TensorDict({"history": history}, [2]))
        assert distribution is not None
        return distribution.log_prob(states["action"])

    def value(history: Tensor) -> Tensor:
        return policy(TensorDict({"history": history}, [2]))["state_value"].squeeze(-1)

    layer = captum_layer(find_network(policy))
    for function, maps in ((log_prob, actions), (value, values)):
        expected = captum.LayerGradCam(function, layer).attribute(states["history"])
        assert_near(maps.detach(), expected.detach().reshape(maps.shape))


def test_two_trunks_several_observations_and_frozen_weights() -> None:
    network = enhanced_tit(2, patch_size="auto", embed_dim=8, features_dim=8)
    observation = {"pixels": (3, 24, 24), "state": (4,)}
    policy = make_policy(replace(network, trunks="separate"), observation).requires_grad_(False)
    histories = {"pixels": torch.rand(2, 2, 3, 24, 24), "state": torch.randn(2, 2, 4)}
    states = TensorDict({"history": TensorDict(histories, [2])}, [2])
    for target in ("action", "value"):
        maps = grad_cam(policy, states, target=target)
        assert list(maps) == ["pixels"]
        assert maps["pixels"].shape == (2, 2, 6, 6)
        assert maps["pixels"].any()


def test_layers_by_name() -> None:
    policy, states = make_policy(IMAGE_NETWORKS["enhanced"], IMAGE), make_images(1)
    usual = image_layers(find_network(policy))["observation"].name
    assert usual == "frame_encoders.observation.blocks.1.norm1"
    named = grad_cam(policy, states, layer=usual)["observation"]
    assert_near(named, grad_cam(policy, states)["observation"])
    first = grad_cam(policy, states, layer=usual.replace("1.norm1", "0.norm1"))["observation"]
    assert first.shape == named.shape
    assert not torch.allclose(first, named)


@pytest.mark.parametrize(
    ("layer", "error"),
    [
        ("blocks.1.norm1", "no layer 'blocks.1.norm1'.*blocks.1.norm1 is the usual one"),
        ("frame_encoders.observation.blocks.1.norm2", r"shape \[3, 1, 8\], which is no image"),
        ("history_encoder.blocks.0.norm1", "no row of patches: choose a convolution"),
        ("head.0", "reads no image"),
        ("frame_encoders.observation.blocks.0.attention.out_proj", None),
        ("frame_encoders.observation.blocks.1.attention.out_proj", "no image"),
    ],
)
def test_unknown_and_useless_layers(layer: str, error: str | None) -> None:
    policy, states = make_policy(IMAGE_NETWORKS["enhanced"], IMAGE), make_images(1)
    if error is None:
        assert grad_cam(policy, states, layer=layer)["observation"].any()
        return
    with pytest.raises(ValueError, match=error):
        grad_cam(policy, states, layer=layer)


def test_bad_input() -> None:
    policy = make_policy(IMAGE_NETWORKS["enhanced"], IMAGE)
    states = make_images(2)
    with pytest.raises(ValueError, match="a target is 'action', 'value' or a function, not 'x'"):
        grad_cam(policy, states, target="x")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="does not depend on what the network reads"):
        grad_cam(policy, states, target=lambda outputs: torch.zeros(2))
    with pytest.raises(ValueError, match=r"one by one, \[N\], not \[2, 1\]"):
        grad_cam(policy, states.unsqueeze(1))
    with pytest.raises(ValueError, match=r"Linear has no torchrl_tit\.Backbone"):
        grad_cam(nn.Linear(2, 2), states)
    actor = make_deterministic_policy(IMAGE_NETWORKS["enhanced"], IMAGE)
    with pytest.raises(ValueError, match="computes actions only, no values"):
        grad_cam(actor, states, target="value")
    arrays = TensorDict({"history": torch.randn(2, 1, 4)}, [2])
    with pytest.raises(ValueError, match="nothing for Grad-CAM to map: use integrated gradients"):
        grad_cam(make_policy(mlp(), (4,)), arrays)

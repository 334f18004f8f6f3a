"""What the tests of acting mode share: networks, streams of histories, counted frames."""

from typing import Any

import torch
from tensordict import TensorDict

from tests.numerics import assert_near
from torchrl_tit import Backbone, EnhancedTIT, VanillaTIT
from torchrl_tit.networks import Catformer, CoBERL

SMALL: dict[str, Any] = {"embed_dim": 16, "num_blocks": 2, "features_dim": 8}
IMAGE = (8, 8)

NETWORKS = {
    "enhanced": lambda k: EnhancedTIT((3,), k, **SMALL),
    "vanilla": lambda k: VanillaTIT(
        (3,), k, temporal_positions="learned" if k > 1 else "none", **SMALL
    ),
    "without dense": lambda k: EnhancedTIT((3,), k, dense=False, **SMALL),
    "without inner": lambda k: EnhancedTIT((3,), k, inner=False, **SMALL),
    "images": lambda k: EnhancedTIT(IMAGE, k, patch_size=4, **SMALL),
    "Catformer": lambda k: Catformer(IMAGE, k, embed_dim=15, num_heads=5, features_dim=8),
    "CoBERL": lambda k: CoBERL(IMAGE, k, embed_dim=16, num_heads=2, features_dim=8),
}


class CountedFrames:
    """Counts the frames that a network's frame encoders encode."""

    def __init__(self, network):
        self.count = 0
        self.only_without_gradients = False
        for encoder in network.frames:
            encoder.register_forward_pre_hook(self)

    def __call__(self, encoder, inputs):
        (x,) = inputs
        if self.only_without_gradients and torch.is_grad_enabled():
            return
        self.count += x.shape[: x.ndim - len(encoder.observation_shape)].numel()

    def take(self):
        count, self.count = self.count, 0
        return count


class Streams:
    """Histories of N environments that continue or start an episode, as History writes them."""

    def __init__(self, n, steps, shape, padding="same", dtype=None):
        self.shape, self.padding = shape, padding
        self.dtype = dtype or torch.get_default_dtype()
        self.windows = torch.zeros(n, steps, *shape, dtype=self.dtype)
        self.step(torch.ones(n, dtype=torch.bool))

    def step(self, reset):
        newest = torch.randint(0, 256, (len(reset), 1, *self.shape)).to(self.dtype)
        if self.dtype != torch.uint8:
            newest = newest / 255
        windows = torch.cat([self.windows[:, 1:], newest], 1)
        first = newest if self.padding == "same" else torch.zeros_like(newest)
        windows[reset, :-1] = first.expand_as(windows[:, :-1])[reset]
        self.windows = windows
        return windows


def features(backbone, history):
    td = TensorDict({"history": history}, history.shape[: 1 if history.ndim > 2 else 0])
    return backbone(td)["features"]


def assert_exact(backbone, history):
    network = backbone.module
    assert_near(features(backbone, history), network(history), equal_nan=True)


@torch.no_grad()
def make(name="enhanced", steps=4):
    torch.manual_seed(0)
    network = NETWORKS[name](steps).eval()
    for parameter in network.parameters():  # far from 0, so that a wrong token shows
        parameter.add_(0.1 * torch.randn_like(parameter))
    return Backbone(network), network, encoder_of(network).observation_shape


def encoder_of(network):
    """The frame encoder of a network with a single observation."""
    (encoder,) = network.frames
    return encoder


def cache_of(backbone):
    """What a backbone in acting mode keeps of its single observation; None if nothing."""
    (network,) = backbone._acting
    (cache,) = network._caches
    return cache._kept

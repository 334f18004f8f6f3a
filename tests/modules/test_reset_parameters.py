"""TensorDict's ``reset_parameters_recursive`` repeats the initialization of the constructors."""

import math
from collections.abc import Callable
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, Unbounded

from tests.networks.test_pairs import HISTORIES
from torchrl_tit import Backbone, EnhancedTIT, VanillaTIT, settings
from torchrl_tit.modules import DTHead, make_actor, make_squashed_actor, make_value
from torchrl_tit.networks import OFENet, build_network

IMAGE = (36, 36)
CATEGORIES = MultiCategorical([4, 3, 2])


def build(history, frame=None, shape=(6,)):
    reads_frames = history.name in ("stacked-inner", "stacked-cnn")
    network = settings.Network(
        frame=settings.Flat() if reads_frames else frame or settings.Linear(embed_dim=64),
        history=history,
        num_frames=3,
    )
    return build_network(network, IMAGE if history.name == "stacked-cnn" else shape, action_dim=2)


MODULES: dict[str, Callable[[], nn.Module]] = {
    **{f"history {name}": partial(build, history) for name, history in HISTORIES.items()},
    "gates": lambda: build(settings.GTrXL(num_heads=2, gate_bias=2.0)),
    "own patches": lambda: build(settings.Outer(), settings.Inner(patch_weights="own")),
    "images": lambda: build(settings.Outer(), settings.NatureCNNFrames(), IMAGE),
    "categories": lambda: build(settings.Outer(), settings.Linear(embed_dim=1024), CATEGORIES),
    "patches of categories": lambda: build(settings.Outer(), settings.Inner(), CATEGORIES),
    "Vanilla_TIT": lambda: VanillaTIT((6,), 4, temporal_positions="learned"),
    "Enhanced_TIT": lambda: EnhancedTIT((12, 12), 4, patch_size=4),
    "OFENet": lambda: OFENet((6,)),
    "choice": lambda: make_actor(64, Categorical(3)),
    "masked choices": lambda: make_actor(64, MultiCategorical([3, 2]), mask_key="mask"),
    "switches": lambda: make_actor(64, Binary(3)),
    "Gaussian": lambda: make_actor(64, Unbounded((3,))),
    "squashed": lambda: make_squashed_actor(64, Bounded(-1, 1, (3,))),
    "value": lambda: make_value(64),
    "Online DT": lambda: DTHead(64, 3, "gaussian"),
}


@pytest.mark.parametrize("name", MODULES)
def test_resets_to_what_the_constructor_draws(name):
    fresh, module = MODULES[name](), MODULES[name]()
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.fill_(7.0)
    if not isinstance(module, TensorDictModule | TensorDictSequential):
        module = TensorDictModule(module, in_keys=["features"], out_keys=["out"])
    module.reset_parameters_recursive()
    weights = dict(zip(dict(fresh.named_parameters()), module.parameters(), strict=True))
    for key, drawn in fresh.named_parameters():
        spread = drawn.std(unbiased=False).item()
        tolerance = 5 * spread / math.sqrt(drawn.numel())  # 0 where a constant is set
        assert abs(weights[key].mean() - drawn.mean()) <= 2 * tolerance, key
        assert abs(weights[key].std(unbiased=False) - spread) <= 2 * tolerance, key


def test_resets_the_parameters_that_it_is_given():
    backbone = Backbone(nn.Sequential(EnhancedTIT((6,), 4)))
    before = {name: p.clone() for name, p in backbone.named_parameters()}
    parameters = TensorDict.from_module(backbone).apply(lambda p: torch.full_like(p, 7.0))
    reset = backbone.reset_parameters_recursive(parameters)
    layer = reset["module", "0", "head", "1", "weight"]
    assert layer.std() < 0.03
    for name, parameter in backbone.named_parameters():
        assert torch.equal(parameter, before[name])

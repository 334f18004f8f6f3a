"""Vanilla_TIT and Enhanced_TIT built from parameters under the authors' names."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.networks.reference import ReferenceTIT, randomize
from tests.numerics import assert_near
from torchrl_tit.interop import from_official

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

BASE: dict[str, Any] = {
    "patch_size": 1,
    "num_blocks": 2,
    "features_dim": 12,
    "embed_dim": 16,
    "num_heads_inner": 2,
    "num_heads_outer": 4,
    "activation_inner": "gelu",
    "activation_outer": "gelu",
    "activation_head": "tanh",
    "ffn_expansion_inner": 4,
    "ffn_expansion_outer": 4,
    "position_encoding": True,
    "share_blocks": False,
}
# Name: observation shape (images with their history in front), settings.
CASES: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {
    "array": ((5,), {}),
    "array, padded patches": ((11,), {"patch_size": 4, "activation_head": "relu"}),
    "array, one patch": ((3,), {"patch_size": 3}),
    "array, whole observation, no positions": (
        (17,),
        {
            "patch_size": 17,
            "position_encoding": False,
            "ffn_expansion_inner": 1,
            "ffn_expansion_outer": 2,
        },
    ),
    "array, three blocks": ((4,), {"num_blocks": 3, "activation_inner": "relu"}),
    "array, twelve blocks": ((2,), {"num_blocks": 12}),
    "image": ((4, 12, 12), {"patch_size": 4, "activation_head": "gelu"}),
    "image, one frame": ((1, 8, 8), {"patch_size": 4}),
    "wide image, no positions": ((2, 8, 12), {"patch_size": 4, "position_encoding": False}),
    "dropout": ((4,), {"attention_dropout_outer": 0.1, "ffn_dropout_inner": 0.1}),
}
every_case = pytest.mark.parametrize("case", CASES)
both_variants = pytest.mark.parametrize("variant", ["vanilla", "enhanced"])
PREFIX = "features_extractor.pure_transformer_backbone."


def make(variant: str, case: str, **changes: Any) -> tuple[dict[str, Any], ReferenceTIT]:
    shape, settings = CASES[case]
    settings = BASE | settings | changes
    array = len(shape) == 1
    config = {
        "kind": "tit",
        "variant": variant,
        "observation": "array" if array else "image",
        "observation_shape": list(shape),
        "history": 1 if array else shape[0],
        "num_patches": "derived from the others, and not read",
        **settings,
    }
    settings = {name: value for name, value in settings.items() if "dropout" not in name}
    if variant == "vanilla":
        settings["share_blocks"] = False  # the authors' Vanilla_TIT ignores the setting
    num_frames, observation_shape = (1, shape) if array else (shape[0], shape[1:])
    reference = ReferenceTIT(observation_shape, num_frames, variant=variant, **settings)
    randomize(reference)
    return config, reference.eval()


def parameters(reference: ReferenceTIT) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in reference.state_dict().items()}


def assert_same(network: torch.nn.Module, reference: ReferenceTIT, shape: Any) -> None:
    x = torch.randn(3, *shape, requires_grad=True)
    twin = x.detach().clone().requires_grad_()
    features, expected = network.eval()(x), reference(twin[:, None] if len(shape) == 1 else twin)
    assert_near(features, expected)
    probe = torch.randn_like(features)
    (features * probe).sum().backward()
    (expected * probe).sum().backward()
    assert_near(x.grad, twin.grad)


@both_variants
@every_case
@pytest.mark.parametrize("share", [False, True])
def test_same_outputs_and_gradients(variant: str, case: str, share: bool) -> None:
    config, reference = make(variant, case, share_blocks=share)
    params = parameters(reference)
    shared_names = any(name.startswith("block.inner_Transformer_block.") for name in params)
    assert shared_names == (share and variant == "enhanced")
    before = dict(config), parameters(reference)
    network = from_official(config, params)
    assert config == before[0]
    assert params.keys() == before[1].keys()
    for name, value in params.items():
        assert torch.equal(value, before[1][name])
        value.zero_()  # the network does not share its memory
    assert_same(network, reference, config["observation_shape"])


@both_variants
@pytest.mark.parametrize("prefix", ["", PREFIX, "actor._encoder."])
def test_prefix_masks_and_what_lies_outside(variant: str, prefix: str) -> None:
    config, reference = make(variant, "image")
    params = {prefix + name: value for name, value in parameters(reference).items()}
    mask = torch.ones(4, 4).tril()
    for index in range(2):
        block = {
            "enhanced": f"blocks.{index}.outer_Transformer_block",
            "vanilla": f"outer_blocks.{index}",
        }[variant]
        params[f"{prefix}{block}.attention_mask"] = mask
    params[f"{prefix}attention_mask"] = mask
    if prefix:
        params |= {"action_net.weight": torch.randn(2, 12), "action_net.bias": torch.zeros(2)}
        params["log_std"] = torch.zeros(2)
    assert_same(from_official(config, params), reference, config["observation_shape"])


@both_variants
def test_missing_left_over_and_misshaped_parameters(variant: str) -> None:
    config, reference = make(variant, "array")
    params = parameters(reference)

    def error(**changes: Any) -> str:
        changed = {n: v for n, v in (params | changes).items() if v is not None}
        with pytest.raises(ValueError) as error:  # noqa: PT011
            from_official(config, changed)
        return str(error.value)

    block = {"enhanced": "blocks.7.inner_Transformer_block", "vanilla": "inner_blocks.7"}[variant]
    assert "missing head.3.bias" in error(**{"ln2.bias": None})
    assert "no parameter 'class_token_encoding'" in error(class_token_encoding=None)
    message = error(**{f"{block}.ln1.bias": torch.zeros(16)})
    assert "left over frame_encoders.observation.blocks.7.norm1.bias" in message
    assert "unknown parameter 'log_std'" in error(log_std=torch.zeros(2))
    message = error(**{"head.0.weight": torch.zeros(12, 17)})
    assert "head.1.weight has shape (12, 17) instead of (12, " in message
    # All that is wrong is said at once.
    message = error(**{"ln1.bias": None, "ln2.bias": torch.zeros(3)})
    assert "missing head.0.bias; " in message or "; missing head.0.bias" in message
    assert "head.3.bias has shape (3,) instead of (12,)" in message


@pytest.mark.parametrize("config", [{}, {"kind": "TIT"}])
def test_unknown_kind(config: dict[str, Any]) -> None:
    kind = config.get("kind")
    with pytest.raises(ValueError, match=rf"unknown kind of network {kind!r}: choose one of .*tit"):
        from_official(config, {})


@pytest.mark.parametrize("entry", [*BASE, "variant", "observation", "observation_shape"])
def test_missing_entry(entry: str) -> None:
    config, reference = make("enhanced", "array")
    del config[entry]
    if entry == "share_blocks":  # the names of the parameters tell
        from_official(config, parameters(reference))
        return
    with pytest.raises(ValueError, match=f"config of kind 'tit' has no entry '{entry}'"):
        from_official(config, parameters(reference))


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("variant", "plain", "variant is 'plain': expected one of .*enhanced.*vanilla"),
        ("observation", "text", "observation is 'text': expected one of .*array.*image"),
        ("activation_head", "swish", "field 'activation' is 'swish', not one of"),
        ("num_heads_inner", 3, "width 16 cannot be split over 3 attention heads"),
    ],
)
def test_impossible_entry(entry: str, value: Any, message: str) -> None:
    config, reference = make("enhanced", "array")
    config[entry] = value
    with pytest.raises(ValueError, match=message):
        from_official(config, parameters(reference))

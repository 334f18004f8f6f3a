"""Vanilla_TIT and Enhanced_TIT of the authors' release."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from torchrl_tit.interop.weights import load_renamed, strip_prefix
from torchrl_tit.networks import EnhancedTIT, VanillaTIT

_REQUIRED = (
    "patch_size",
    "embed_dim",
    "num_blocks",
    "num_heads_inner",
    "num_heads_outer",
    "ffn_expansion_inner",
    "ffn_expansion_outer",
    "activation_inner",
    "activation_outer",
    "activation_head",
    "position_encoding",
    "features_dim",
)
_OPTIONAL = (
    "attention_dropout_inner",
    "attention_dropout_outer",
    "ffn_dropout_inner",
    "ffn_dropout_outer",
)

_RENAMING = [
    (r"obs_patch_embed\.weight", "frame_encoders.observation.patch_embedding.weight"),
    (r"class_token_encoding", "frame_encoders.observation.class_token"),
    (r"obs_patch_pos_encoding", "frame_encoders.observation.positions"),
    # Enhanced_TIT keeps pairs of blocks (one pair if they are shared), Vanilla_TIT two lists.
    (r"blocks\.(\d+)\.inner_Transformer_block\.(.*)", r"frame_encoders.observation.blocks.\1.\2"),
    (r"blocks\.(\d+)\.outer_Transformer_block\.(.*)", r"history_encoder.blocks.\1.\2"),
    (r"block\.inner_Transformer_block\.(.*)", r"frame_encoders.observation.blocks.0.\1"),
    (r"block\.outer_Transformer_block\.(.*)", r"history_encoder.blocks.0.\1"),
    (r"inner_blocks\.(\d+)\.(.*)", r"frame_encoders.observation.blocks.\1.\2"),
    (r"outer_blocks\.(\d+)\.(.*)", r"history_encoder.blocks.\1.\2"),
    (r"ln1\.(.*)", r"head.0.\1"),
    (r"head\.0\.(.*)", r"head.1.\1"),
    (r"ln2\.(.*)", r"head.3.\1"),
]


def tit_from_official(config: Mapping[str, Any], params: Mapping[str, Tensor]) -> nn.Module:
    """Builds Vanilla_TIT or Enhanced_TIT; see :func:`~torchrl_tit.interop.from_official`."""
    network_class = _choose(config, "variant", vanilla=VanillaTIT, enhanced=EnhancedTIT)
    hyperparameters = {name: config[name] for name in _REQUIRED}
    hyperparameters |= {name: config[name] for name in _OPTIONAL if name in config}
    params = strip_prefix(params, "class_token_encoding")
    # The authors share blocks in Enhanced_TIT only: their Vanilla_TIT ignores the setting.
    hyperparameters["share_blocks"] = any(name.startswith("block.") for name in params)
    # The authors' causal masks are parameters too; ours are not.
    params = {n.replace(".ln", ".norm"): p for n, p in params.items() if "attention_mask" not in n}

    array = _choose(config, "observation", array=True, image=False)
    shape = tuple(config["observation_shape"])
    num_frames, shape = (1, shape) if array else (shape[0], shape[1:])
    network = network_class(shape, num_frames, **hyperparameters)
    load_renamed(network, params, _RENAMING)
    # The authors' arrays have no history axis.
    return nn.Sequential(nn.Unflatten(-1, (1, *shape)), network) if array else network


def _choose(config: Mapping[str, Any], entry: str, **choices: Any) -> Any:
    if config[entry] not in choices:
        raise ValueError(f"{entry} is {config[entry]!r}: expected one of {sorted(choices)}")
    return choices[config[entry]]

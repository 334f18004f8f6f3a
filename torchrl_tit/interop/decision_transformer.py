"""Decision Transformer and DT_TIT of the authors' release."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tit.interop.weights import Renaming, count_layers, size_of
from torchrl_tit.modules import DTHead
from torchrl_tit.modules.decision_transformer import ActionPredictor
from torchrl_tit.networks import DTTIT, DecisionTransformer

_HISTORY = "network.history_encoder"
_FRAME = "network.frame_encoders.observation"
_RENAMING = [
    (r"embed_return\.(.*)", rf"{_HISTORY}.return_embedding.\1"),
    (r"embed_action\.(.*)", rf"{_HISTORY}.action_embedding.\1"),
    (r"embed_timestep\.(.*)", rf"{_HISTORY}.timestep_embedding.\1"),
    (r"embed_ln\.(.*)", rf"{_HISTORY}.embedding_norm.\1"),
    (r"transformer\.h\.(\d+)\.ln_(\d)\.(.*)", rf"{_HISTORY}.blocks.\1.norm\2.\3"),
    (r"transformer\.h\.(\d+)\.attn\.c_attn\.(.*)", rf"{_HISTORY}.blocks.\1.attention.in_proj_\2"),
    (r"transformer\.h\.(\d+)\.attn\.c_proj\.(.*)", rf"{_HISTORY}.blocks.\1.attention.out_proj.\2"),
    (r"transformer\.h\.(\d+)\.mlp\.c_fc\.(.*)", rf"{_HISTORY}.blocks.\1.ffn.0.\2"),
    (r"transformer\.h\.(\d+)\.mlp\.c_proj\.(.*)", rf"{_HISTORY}.blocks.\1.ffn.2.\2"),
    (r"transformer\.ln_f\.(.*)", rf"{_HISTORY}.norm.\1"),
    (r"predict_action\.0\.(.*)", r"head.layers.0.\1"),
]
_LINEAR = [(r"embed_state\.(.*)", rf"{_FRAME}.linear.\1")]
_INNER = [
    (r"obs_patch_embed\.weight", f"{_FRAME}.patch_embedding.weight"),
    (r"class_token_encoding", f"{_FRAME}.class_token"),
    (r"obs_patch_pos_encoding", f"{_FRAME}.positions"),
    (r"inner_blocks\.(\d+)\.ln(\d)\.(.*)", rf"{_FRAME}.blocks.\1.norm\2.\3"),
    (r"inner_blocks\.(\d+)\.(.*)", rf"{_FRAME}.blocks.\1.\2"),
]
# Weights that the authors' network does not use: untrained predictions of states and returns, token
# and position embeddings of GPT-2, and causal masks.
_UNUSED = re.compile(r"predict_(state|return)\..*|transformer\.w[tp]e\..*|.*\.attn\.bias")
_CONV1D = re.compile(r".*\.(c_attn|c_proj|c_fc)\.weight")
# Names of activations in GPT-2 configurations that differ from ours.
_ACTIVATIONS = {"gelu_new": "gelu_tanh", "gelu_pytorch_tanh": "gelu_tanh", "swish": "silu"}


def build_dt(
    config: Mapping[str, Any], params: Mapping[str, Tensor]
) -> tuple[nn.Module, Mapping[str, Tensor], Renaming]:
    """Builds Decision Transformer; returns it with its parameters and how they are called here."""
    params = _prepare(params)
    size = config.get("state_dim", size_of(params, "embed_state.weight", axis=1))
    return _build(DecisionTransformer, config, params, size), params, [*_RENAMING, *_LINEAR]


def build_dt_tit(
    config: Mapping[str, Any], params: Mapping[str, Tensor]
) -> tuple[nn.Module, Mapping[str, Tensor], Renaming]:
    """Builds DT_TIT; see :func:`build_dt`."""
    params = _prepare(params)
    width = size_of(params, "obs_patch_embed.weight")
    patch_size = size_of(params, "obs_patch_embed.weight", axis=-1)
    network = _build(
        DTTIT,
        config,
        params,
        config.get("state_dim", patch_size),
        patch_size=patch_size,
        num_blocks_inner=count_layers(params, r"inner_blocks\.(\d+)\..*"),
        num_heads_inner=config.get("num_heads_inner", 1),
        ffn_expansion_inner=size_of(params, "inner_blocks.0.ffn.0.weight") // width,
        activation_inner=_activation(config.get("activation_inner", "relu")),
        position_encoding="obs_patch_pos_encoding" in params,
    )
    return network, params, [*_RENAMING, *_INNER]


def _build(
    network_class: type[DecisionTransformer] | type[DTTIT],
    config: Mapping[str, Any],
    params: Mapping[str, Tensor],
    state_dim: int,
    **hyperparameters: Any,
) -> ActionPredictor:
    embed_dim = config.get("embed_dim", size_of(params, "embed_ln.weight"))
    max_ep_len = config.get("max_ep_len", size_of(params, "embed_timestep.weight"))
    action_dim = config.get("act_dim", size_of(params, "predict_action.0.weight"))
    network = network_class(
        (state_dim,),
        action_dim=action_dim,
        num_frames=config.get("context", min(20, max_ep_len)),
        embed_dim=embed_dim,
        num_blocks=config.get("n_layer", count_layers(params, r"transformer\.h\.(\d+)\..*")),
        num_heads=config.get("n_head", 1),
        ffn_dim=config.get("n_inner", size_of(params, "transformer.h.0.mlp.c_fc.bias")),
        activation=_activation(config.get("activation", "relu")),
        max_ep_len=max_ep_len,
        **hyperparameters,
    )
    return ActionPredictor(network, DTHead(embed_dim, action_dim))


def _prepare(params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Drops unused parameters, and transposes GPT-2's weights [in, out]."""
    used = {name: value for name, value in params.items() if not _UNUSED.fullmatch(name)}
    prepared = {n: value.T if _CONV1D.fullmatch(n) else value for n, value in used.items()}
    missing = [
        name
        for name in (n.replace(".weight", ".bias") for n in prepared if n.endswith("c_attn.weight"))
        if name not in prepared
    ]
    if missing:
        warnings.warn(
            f"the parameters have no {', '.join(missing)}: zeros are used instead, which is right "
            'only for untrained weights. A filter for causal masks ("attn.bias") may have removed '
            "them",
            stacklevel=4,
        )
    for name in missing:
        weight = prepared[name.replace(".bias", ".weight")]
        prepared[name] = torch.zeros(len(weight), dtype=weight.dtype)
    return prepared


def _activation(name: str) -> str:
    return _ACTIVATIONS.get(name, name)

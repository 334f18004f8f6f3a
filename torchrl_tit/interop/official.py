"""Builds our networks from the weights of the authors' release."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor, nn

from torchrl_tit.interop.arrays import d2rl_from_official, ofenet_from_official
from torchrl_tit.interop.decision_transformer import dt_from_official, dt_tit_from_official
from torchrl_tit.interop.images import catformer_from_official, resnet_from_official
from torchrl_tit.interop.tit import tit_from_official

_BUILDERS: dict[str, Callable[[Mapping[str, Any], Mapping[str, Tensor]], nn.Module]] = {
    "catformer": catformer_from_official,
    "d2rl": d2rl_from_official,
    "dt": dt_from_official,
    "dt_tit": dt_tit_from_official,
    "ofenet": ofenet_from_official,
    "resnet": resnet_from_official,
    "tit": tit_from_official,
}


def from_official(config: dict[str, Any], params: dict[str, Tensor]) -> nn.Module:
    """Builds a network of this library from one of the authors' release.

    For the same input, its output equals that of the authors' network, up to float precision.

    Args:
        config: describes the network. Its entry ``kind`` is one of

            - ``"tit"``, with ``variant`` ("vanilla" or "enhanced"), ``observation`` ("array" or
              "image"), ``observation_shape`` ((D,) or (K, H, W)), ``patch_size``, ``num_blocks``,
              ``features_dim``, ``embed_dim``, ``num_heads_inner``, ``num_heads_outer``,
              ``activation_inner``, ``activation_outer``, ``activation_head``,
              ``ffn_expansion_inner``, ``ffn_expansion_outer``, ``position_encoding``, and dropout
              probabilities if any (``attention_dropout_inner``, ...); the parameters show whether
              blocks are shared;
            - ``"resnet"`` and ``"catformer"``, with ``observation_shape`` (K, H, W), and for
              Catformer ``num_heads`` if not 5;
            - ``"ofenet"`` and ``"d2rl"``;
            - ``"dt"`` and ``"dt_tit"``, with ``n_head`` (and ``num_heads_inner``) if not 1,
              ``activation`` if not relu, and ``context``, the number K of steps.

            Sizes that follow from the parameters (``features_dim``, ``hidden_dim``, ``embed_dim``,
            ``n_layer``, ``n_inner``, ``max_ep_len``, ...) can be left out unless the kind is "tit";
            if given, they are checked.
        params: the parameters under the authors' names, those of ``state_dict()``; with or without
            a prefix such as ``features_extractor.pure_transformer_backbone.``.

    Returns:
        A module with the same inputs as the authors': arrays [B, D] without a history axis, images
        [B, K, H, W]; floats are used as they are (the authors divide images by 255 before the
        network), only uint8 is divided by 255. ``"ofenet"`` and ``"d2rl"`` return features for
        policy and value. The ``"dt"`` kinds are called with states, actions, returns_to_go,
        timesteps and attention_mask, and return the actions.

    Raises:
        ValueError: if the kind is unknown, an entry is missing, or parameters are missing,
            unexpected or of another shape.

    Example:
        >>> import torch
        >>> params = {}
        >>> for trunk in ("policy", "value"):
        ...     for layer, size in ((1, 11), (2, 11 + 64)):
        ...         params[f"linear{layer}_{trunk}.0.weight"] = torch.randn(64, size)
        ...         params[f"linear{layer}_{trunk}.0.bias"] = torch.randn(64)
        >>> network = from_official({"kind": "d2rl", "observation_shape": [11]}, params)
        >>> policy_features, value_features = network(torch.randn(3, 11))
        >>> policy_features.shape
        torch.Size([3, 75])
    """
    kind = config.get("kind")
    if kind not in _BUILDERS:
        raise ValueError(f"unknown kind of network {kind!r}: choose one of {sorted(_BUILDERS)}")
    try:
        return _BUILDERS[kind](config, params)
    except KeyError as error:
        raise ValueError(f"the config of kind {kind!r} has no entry {error}: {config}") from error

"""Builds our networks from the weights of the authors' release."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from functools import partial
from typing import Any, TypeAlias

from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.interop.decision_transformer import build_dt, build_dt_tit
from torchrl_tit.interop.weights import Renaming, count_layers, load_renamed, size_of, strip_prefix
from torchrl_tit.networks import D2RL, EnhancedTIT, HistoryNetwork, OFENet, ResNet, VanillaTIT

_Config: TypeAlias = Mapping[str, Any]
_Params: TypeAlias = Mapping[str, Tensor]
_Built: TypeAlias = tuple[nn.Module, _Params, Renaming]
"""A network, the parameters that it has, and how they are called here."""


def from_official(config: Mapping[str, Any], params: Mapping[str, Tensor]) -> nn.Module:
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
        ValueError: if the kind is unknown, an entry is missing or misspelled, or parameters are
            missing, unexpected or of another shape.

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
    if kind not in _KINDS:
        raise ValueError(f"unknown kind of network {kind!r}: choose one of {sorted(_KINDS)}")
    marker, build = _KINDS[kind]
    # The authors' causal masks are parameters too; ours are not.
    params = {n: x for n, x in strip_prefix(params, marker).items() if "mask" not in n}
    config = _Entries(config)
    try:
        network, params, renaming = build(config, params)
    except KeyError as error:
        raise ValueError(f"the config of kind {kind!r} has no entry {error}: {config}") from error
    for name in sorted(config.keys() - config.read - {"share_blocks"}):  # which the parameters tell
        if similar := get_close_matches(name, config.read - config.keys(), 1):
            raise ValueError(f"a config of kind {kind!r} has no {name!r}: write {similar[0]!r}")
    load_renamed(network, params, renaming)
    if kind in ("ofenet", "d2rl") or (kind, config.get("observation")) == ("tit", "array"):
        # The authors' arrays have no history axis.
        return nn.Sequential(nn.Unflatten(-1, (1, -1)), network)
    return network


class _Entries(dict[str, Any]):
    """A config that remembers which of its entries were read."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        super().__init__(config)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.read.add(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        self.read.add(name)
        return super().get(name, default)


_TIT_REQUIRED = (
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
_TIT_OPTIONAL = (
    "attention_dropout_inner",
    "attention_dropout_outer",
    "ffn_dropout_inner",
    "ffn_dropout_outer",
)

_TIT_RENAMING = [
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


def _build_tit(config: _Config, params: _Params) -> _Built:
    network_class = _choose(config, "variant", vanilla=VanillaTIT, enhanced=EnhancedTIT)
    hyperparameters = {name: config[name] for name in _TIT_REQUIRED}
    hyperparameters |= {name: config[name] for name in _TIT_OPTIONAL if name in config}
    # The authors share blocks in Enhanced_TIT only: their Vanilla_TIT ignores the setting.
    hyperparameters["share_blocks"] = any(name.startswith("block.") for name in params)
    shape = tuple(config["observation_shape"])
    array = _choose(config, "observation", array=True, image=False)
    num_frames, shape = (1, shape) if array else (shape[0], shape[1:])
    network = network_class(shape, num_frames, **hyperparameters)
    return network, {n.replace(".ln", ".norm"): x for n, x in params.items()}, _TIT_RENAMING


def _build_resnet(config: _Config, params: _Params) -> _Built:
    num_frames, *shape = config["observation_shape"]
    features_dim = config.get("features_dim", size_of(params, "linear.0.weight"))
    network = ResNet(shape, num_frames, features_dim=features_dim)
    renaming = [*_rename_torso("history_encoder.torso"), (r"linear\.0\.(.*)", r"head.0.\1")]
    return network, params, renaming


def _build_catformer(config: _Config, params: _Params) -> _Built:
    num_blocks = count_layers(params, r"catformer\.layer(\d+)_attention_layer\..*")
    embed_dim = config.get("embed_dim", size_of(params, "catformer.obs_embedding.weight"))
    hidden_dim = size_of(params, "catformer.layer1_ffn_layer.ffn.0.weight")
    attention_dim = size_of(params, "catformer.layer0_attention_layer.attention.out_proj.weight", 1)
    num_frames, *shape = config["observation_shape"]
    features_dim = config.get("features_dim", size_of(params, "head.0.weight"))
    network = HistoryNetwork(
        settings.ResNetFrames(embed_dim=embed_dim),
        settings.Catformer(
            num_blocks=num_blocks,
            num_heads=config.get("num_heads", 5),
            attention_expansion=attention_dim // embed_dim,
            ffn_expansion=hidden_dim // embed_dim,
        ),
        observation_shape=shape,
        num_frames=num_frames,  # the authors' may read one frame, which our recipes do not allow
        head=settings.Head(features_dim=features_dim, activation="relu"),
    )
    layers = []
    for index in range(num_blocks):
        # The authors count attention and FFN layers together.
        attention = rf"catformer\.layer{2 * index}_attention_layer"
        ffn = rf"catformer\.layer{2 * index + 1}_ffn_layer"
        ours = f"history_encoder.attentions.{index}"
        layers += [
            (rf"{attention}\.proj\.(.*)", rf"{ours}.projection.\1"),
            (rf"{attention}\.ln\.(.*)", rf"{ours}.norm.\1"),
            (rf"{attention}\.attention\.(.*)", rf"{ours}.attention.\1"),
            (rf"{ffn}\.ln\.(.*)", rf"history_encoder.ffns.{index}.0.\1"),
            (rf"{ffn}\.ffn\.0\.(.*)", rf"history_encoder.ffns.{index}.1.\1"),
            (rf"{ffn}\.ffn\.2\.(.*)", rf"history_encoder.ffns.{index}.3.\1"),
        ]
    renaming = [
        *_rename_torso("frame_encoders.observation.torso"),
        (r"catformer\.obs_embedding\.(.*)", r"frame_encoders.observation.linear.\1"),
        (r"catformer\.obs_pos_encoding", "history_encoder.positions"),
        *layers,
        (r"ln1\.(.*)", r"head.0.\1"),
        (r"head\.0\.(.*)", r"head.1.\1"),
        (r"ln2\.(.*)", r"head.3.\1"),
    ]
    return network, params, renaming


def _rename_torso(torso: str) -> Renaming:
    return [
        (r"resnet\.0\.(.*)", rf"{torso}.layers.0.\1"),
        (r"resnet\.(\d+)\.cnn\.0\.(.*)", rf"{torso}.layers.\1.conv.\2"),
    ]


def _build_trunks(
    network_class: type[OFENet] | type[D2RL], config: _Config, params: _Params
) -> _Built:
    num_layers = count_layers(params, r"linear(\d+)_policy\..*")
    (size,) = config.get("observation_shape", (size_of(params, _TRUNKS, axis=1),))
    network = network_class(
        (size,),
        hidden_dim=config.get("hidden_dim", size_of(params, _TRUNKS)),
        num_layers=num_layers,
    )
    renaming = [
        (rf"linear{index + 1}_{trunk}\.0\.(.*)", rf"{trunk}.history_encoder.layers.{index}.\1")
        for index in range(num_layers)
        for trunk in ("policy", "value")
    ]
    return network, params, renaming


def _choose(config: Mapping[str, Any], entry: str, **choices: Any) -> Any:
    if config[entry] not in choices:
        raise ValueError(f"{entry} is {config[entry]!r}: expected one of {sorted(choices)}")
    return choices[config[entry]]


_TRUNKS = "linear1_policy.0.weight"
_KINDS: dict[str, tuple[str, Callable[[_Config, _Params], _Built]]] = {
    "catformer": ("resnet.0.weight", _build_catformer),
    "d2rl": (_TRUNKS, partial(_build_trunks, D2RL)),
    "dt": ("embed_ln.weight", build_dt),
    "dt_tit": ("embed_ln.weight", build_dt_tit),
    "ofenet": (_TRUNKS, partial(_build_trunks, OFENet)),
    "resnet": ("resnet.0.weight", _build_resnet),
    "tit": ("class_token_encoding", _build_tit),
}
"""By kind: a parameter whose prefix all others share, and what builds the network."""

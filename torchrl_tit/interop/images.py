"""ResNet and Catformer of the authors' release."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.interop.weights import (
    Renaming,
    count_layers,
    load_renamed,
    size_of,
    strip_prefix,
)
from torchrl_tit.networks import HistoryNetwork, ResNet


def _rename_torso(torso: str) -> Renaming:
    return [
        (r"resnet\.0\.(.*)", rf"{torso}.layers.0.\1"),
        (r"resnet\.(\d+)\.cnn\.0\.(.*)", rf"{torso}.layers.\1.conv.\2"),
    ]


def resnet_from_official(config: Mapping[str, Any], params: Mapping[str, Tensor]) -> nn.Module:
    """Builds ResNet; see :func:`~torchrl_tit.interop.from_official`."""
    params = strip_prefix(params, "resnet.0.weight")
    num_frames, *shape = config["observation_shape"]
    features_dim = config.get("features_dim", size_of(params, "linear.0.weight"))
    network = ResNet(shape, num_frames, features_dim=features_dim)
    renaming = [*_rename_torso("history_encoder.torso"), (r"linear\.0\.(.*)", r"head.0.\1")]
    load_renamed(network, params, renaming)
    return network


def catformer_from_official(config: Mapping[str, Any], params: Mapping[str, Tensor]) -> nn.Module:
    """Builds Catformer; see :func:`~torchrl_tit.interop.from_official`."""
    params = strip_prefix(params, "resnet.0.weight")
    # The authors' causal masks may be parameters too; ours are not.
    params = {name: value for name, value in params.items() if "mask" not in name}
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
    load_renamed(network, params, renaming)
    return network

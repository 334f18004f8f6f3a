"""All attention weights of a network."""

from typing import NamedTuple

from torch import Tensor

from torchrl_tit.networks import HistoryNetwork


class Maps(NamedTuple):
    inner: list[Tensor]
    outer: list[Tensor]


def attention_maps(network: HistoryNetwork, *inputs: Tensor) -> Maps:
    """Those of the inner blocks, and of the outer ones."""
    count = len(network.frames)
    pairs = zip(network.frames, inputs, strict=False)
    inner = [maps for encoder, history in pairs for maps in encoder.attention_maps(history)]
    tokens = network.as_floats(network.encode_frames(*inputs[:count]))
    outer = network.history_encoder.attention_maps(tokens, *inputs[count:])
    if network.history_encoder.reads_frames:  # its blocks are inner ones
        return Maps([*inner, *outer], [])
    return Maps(inner, outer)

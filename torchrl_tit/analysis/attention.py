"""Attention weights of a network: per observation, rolled out, and mapped onto observations."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_tit.analysis.layers import patch_grid
from torchrl_tit.networks import HistoryNetwork


def inner_attention(network: HistoryNetwork, *histories: Tensor) -> dict[str, list[Tensor]]:
    """Returns the attention weights of the inner blocks, which read the patches of observations.

    Args:
        network: the network.
        *histories: as in its ``forward``.

    Returns:
        By the name of the observation, the weights of each block, float [..., K, heads, S, S], rows
        (queries) summing to 1: the class token is at position 0, patches follow. For networks that
        stack the frames as channels, [..., 1, heads, S, S].

    Raises:
        ValueError: if the network has no inner blocks.

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> tit = EnhancedTIT((84, 84), num_frames=4, patch_size=12, num_heads_inner=2)
        >>> [block.shape for block in inner_attention(tit, torch.rand(4, 84, 84))["observation"]]
        [torch.Size([4, 2, 50, 50]), torch.Size([4, 2, 50, 50])]
    """
    count = len(network.frames)
    maps = {}
    with torch.no_grad():
        if network.history_encoder.reads_frames:
            tokens = network.as_floats(network.encode_frames(*histories[:count]))
            (name,) = network.observations
            stacked = network.history_encoder.attention_maps(tokens)
            maps[name] = [weights.unsqueeze(-4) for weights in stacked]
        else:
            network.check(*histories[:count])
            for name, encoder, history in zip(
                network.observations, network.frames, histories, strict=False
            ):
                maps[name] = encoder.attention_maps(history)
    maps = {name: blocks for name, blocks in maps.items() if blocks}
    if not maps:
        raise ValueError(
            "this network has no attention over the parts of an observation: only inner "
            "transformers have (Enhanced_TIT, Vanilla_TIT, DT_TIT)"
        )
    return maps


def roll_out(blocks: Sequence[Tensor]) -> Tensor:
    """Follows attention through all blocks: how much each position reads from each input.

    Heads are averaged. To account for residuals, each block reads half according to its attention
    weights and half from the position itself; see Abnar and Zuidema, "Quantifying Attention Flow in
    Transformers", arXiv 2005.00928, section 3.

    Args:
        blocks: the weights of each block, the first one first, float [..., heads, S, S].

    Returns:
        float [..., S, S], rows summing to 1.

    Raises:
        ValueError: if there are no blocks.

    Example:
        >>> uniform = torch.full((1, 2, 2), 0.5)
        >>> roll_out([uniform, uniform])
        tensor([[0.6250, 0.3750],
                [0.3750, 0.6250]])
    """
    if not blocks:
        raise ValueError("there are no attention weights to roll out: the list is empty")
    rolled: Tensor | None = None
    for weights in blocks:
        mean = weights.mean(-3)
        mixed = (mean + torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)) / 2
        rolled = mixed if rolled is None else mixed @ rolled
    assert rolled is not None
    return rolled


def map_attention(network: HistoryNetwork, *histories: Tensor) -> dict[str, Tensor]:
    """Maps how much the class token reads from each patch, rolled out over the inner blocks.

    The outer blocks and the head read only the class token of an observation.

    Args:
        network: the network.
        *histories: as in its ``forward``.

    Returns:
        Maps by the name of the observation, float [..., K, h, w] over the patches, summing to 1;
        for networks that stack the frames as channels, [..., 1, h, w]. The patches of arrays and
        categories form one row, the entities of a set one column.

    Raises:
        ValueError: if the network has no inner blocks.

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> tit = EnhancedTIT((84, 84), num_frames=4, patch_size=12)
        >>> map_attention(tit, torch.rand(4, 84, 84))["observation"].shape
        torch.Size([4, 7, 7])
    """
    maps = {}
    for name, blocks in inner_attention(network, *histories).items():
        row = roll_out(blocks)[..., 0, 1:]  # of the class token, without its attention to itself
        # Nothing is read of a set without entities.
        row = row / row.sum(-1, keepdim=True).clamp(min=torch.finfo(row.dtype).tiny)
        maps[name] = row.unflatten(-1, patch_grid(network, name))
    return maps


def outer_attention(network: HistoryNetwork, *histories: Tensor) -> Tensor:
    """Returns how much the newest step reads from each of the K steps, in each block and head.

    For Decision Transformer, the weights of a step's return, state and action are added.

    Args:
        network: the network.
        *histories: as in its ``forward``.

    Returns:
        float [..., blocks, heads, K], summing to 1 over the steps, the oldest first.

    Raises:
        ValueError: if the network has no attention over time.

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> tit = EnhancedTIT((4,), num_frames=8, num_heads_outer=2)
        >>> outer_attention(tit, torch.rand(5, 8, 4)).shape
        torch.Size([5, 2, 2, 8])
    """
    return outer_weights(network, *histories)[..., -1, :]


def outer_weights(network: HistoryNetwork, *histories: Tensor) -> Tensor:
    """Returns how much each of the K steps reads from each of them, in each block and head.

    It is figure 7 of arXiv 2212.14538. For Decision Transformer, the weights of a step's return,
    state and action are added.

    Args:
        network: the network.
        *histories: as in its ``forward``.

    Returns:
        float [..., blocks, heads, K, K], rows (queries) summing to 1, the oldest step first. Where
        attention is causal, the weights above the diagonal are 0.

    Raises:
        ValueError: if the network has no attention over time.

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> weights = outer_weights(EnhancedTIT((4,), num_frames=3), torch.rand(3, 4))
        >>> weights.shape
        torch.Size([2, 1, 3, 3])
        >>> bool((weights.triu(1) == 0).all())
        True
    """
    count = len(network.frames)
    encoder = network.history_encoder
    maps: list[Tensor] = []
    if not encoder.reads_frames:  # its blocks are inner ones
        with torch.no_grad():
            tokens = network.as_floats(network.encode_frames(*histories[:count]))
            maps = encoder.attention_maps(tokens, *histories[count:])
    if not maps:
        raise ValueError(
            f"{type(encoder).__name__} has no attention over time: outer transformers, Catformer, "
            "GTrXL, CoBERL and Decision Transformer have"
        )
    return torch.stack(maps, dim=-4)

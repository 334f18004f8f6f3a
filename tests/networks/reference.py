"""Vanilla_TIT and Enhanced_TIT once more, as plainly as the paper states them.

Built on ``nn.MultiheadAttention`` and convolutions over the whole window, every position computed.
The parameters bear the names of the authors' release.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

ACTIVATIONS = {"gelu": nn.GELU, "relu": nn.ReLU, "silu": nn.SiLU, "tanh": nn.Tanh}


class ReferenceBlock(nn.Module):
    def __init__(self, width: int, heads: int, expansion: int, activation: str) -> None:
        super().__init__()
        self.ln1 = nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)
        self.ln2 = nn.LayerNorm(width)
        self.ffn = nn.Sequential(
            nn.Linear(width, expansion * width),
            ACTIVATIONS[activation](),
            nn.Linear(expansion * width, width),
            nn.Dropout(0.0),
        )

    def forward(self, x: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        y = self.ln1(x)
        y, weights = self.attention(y, y, y, attn_mask=mask, average_attn_weights=False)
        x = x + y
        return x + self.ffn(self.ln2(x)), weights


class ReferencePair(nn.Module):
    def __init__(self, inner: ReferenceBlock, outer: ReferenceBlock) -> None:
        super().__init__()
        self.inner_Transformer_block = inner
        self.outer_Transformer_block = outer


class ReferenceTIT(nn.Module):
    """Takes the arguments of ``VanillaTIT`` or ``EnhancedTIT``, and ``variant``."""

    def __init__(
        self,
        observation_shape: Sequence[int],
        num_frames: int = 1,
        *,
        variant: str = "enhanced",
        patch_size: int = 1,
        embed_dim: int = 32,
        num_blocks: int = 2,
        num_heads_inner: int = 1,
        num_heads_outer: int = 1,
        ffn_expansion_inner: int = 4,
        ffn_expansion_outer: int = 4,
        activation_inner: str = "gelu",
        activation_outer: str = "gelu",
        position_encoding: bool = True,
        temporal_positions: str = "none",
        share_blocks: bool = False,
        features_dim: int = 64,
        activation_head: str = "tanh",
        dense: bool = True,
        inner: bool = True,
        outer: bool = True,
    ) -> None:
        super().__init__()
        self.shape = tuple(observation_shape)
        self.num_frames = num_frames
        self.variant = variant
        self.dense = dense and variant == "enhanced"
        self.inner, self.outer = inner, outer
        self.num_blocks = num_blocks

        def inner_block() -> ReferenceBlock:
            return ReferenceBlock(embed_dim, num_heads_inner, ffn_expansion_inner, activation_inner)

        def outer_block() -> ReferenceBlock:
            return ReferenceBlock(embed_dim, num_heads_outer, ffn_expansion_outer, activation_outer)

        if inner:
            self.obs_patch_embed, patches = self._patch_embedding(patch_size, embed_dim)
            self.class_token_encoding = nn.Parameter(torch.randn(1, 1, embed_dim))
            if position_encoding:
                self.obs_patch_pos_encoding = nn.Parameter(torch.randn(1, patches + 1, embed_dim))
        else:
            self.embedding = nn.Linear(math.prod(self.shape), embed_dim, bias=False)
        if temporal_positions == "learned" and outer:
            self.step_pos_encoding = nn.Parameter(torch.randn(num_frames, 1, embed_dim))

        count = 1 if share_blocks else num_blocks
        if variant == "enhanced" and inner and outer:
            pairs = [ReferencePair(inner_block(), outer_block()) for _ in range(count)]
            if share_blocks:
                self.block = pairs[0]
            else:
                self.blocks = nn.ModuleList(pairs)
        else:
            if inner:
                self.inner_blocks = nn.ModuleList(inner_block() for _ in range(count))
            if outer:
                self.outer_blocks = nn.ModuleList(outer_block() for _ in range(count))

        size = embed_dim * (num_blocks if self.dense else 1)
        self.ln1 = nn.LayerNorm(size)
        self.head = nn.Sequential(nn.Linear(size, features_dim), ACTIVATIONS[activation_head]())
        self.ln2 = nn.LayerNorm(features_dim)

    def _patch_embedding(self, patch: int, width: int) -> tuple[nn.Module, int]:
        frames = 1 if self.outer else self.num_frames
        if len(self.shape) == 1:
            missing = math.ceil(self.shape[0] / patch) * patch - self.shape[0]
            conv = nn.Conv1d(
                frames, width, patch, stride=patch, padding=math.ceil(missing / 2), bias=False
            )
            return conv, math.ceil(self.shape[0] / patch)
        channels = frames * math.prod(self.shape[:-2])
        rows, columns = (side // patch for side in self.shape[-2:])
        return nn.Conv2d(channels, width, patch, stride=patch, bias=False), rows * columns

    def inner_block(self, index: int) -> ReferenceBlock:
        return self._block(index, "inner")

    def outer_block(self, index: int) -> ReferenceBlock:
        return self._block(index, "outer")

    def _block(self, index: int, part: str) -> ReferenceBlock:
        if hasattr(self, "block"):
            block = getattr(self.block, f"{part}_Transformer_block")
        elif hasattr(self, "blocks"):
            block = getattr(self.blocks[index], f"{part}_Transformer_block")
        else:
            blocks = getattr(self, f"{part}_blocks")
            block = blocks[index % len(blocks)]
        assert isinstance(block, ReferenceBlock)
        return block

    def forward(self, history: Tensor) -> Tensor:
        return self.with_maps(history)[0]

    def with_maps(self, history: Tensor) -> tuple[Tensor, list[Tensor], list[Tensor]]:
        """Features, inner attention weights [.., (K,) h, S, S], outer ones [.., h, K, K]."""
        leading = history.shape[: history.ndim - 1 - len(self.shape)]
        x = history.reshape(-1, self.num_frames, *self.shape)
        if x.dtype == torch.uint8:
            x = x.to(self.ln1.weight.dtype) / 255
        tokens, inner_maps = self._encode_frames(x)  # L x [N, K, D]
        outputs, outer_maps = self._encode_history(tokens) if self.outer else (tokens, [])
        newest = [output[:, -1] for output in outputs]
        y = torch.cat(newest, -1) if self.dense else newest[-1]
        y = self.ln2(self.head(self.ln1(y)))
        steps = (self.num_frames,) if self.outer else ()
        return (
            y.reshape(*leading, -1),
            [m.reshape(*leading, *steps, *m.shape[1:]) for m in inner_maps],
            [m.reshape(*leading, *m.shape[1:]) for m in outer_maps],
        )

    def _encode_frames(self, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        batch, steps = x.shape[:2]
        if not self.inner:
            return [self.embedding(x.flatten(2))] * self.num_blocks, []
        if self.outer:
            x = x.flatten(0, 1)  # one frame at a time
        else:
            steps = 1  # frames as channels
        space = 1 if len(self.shape) == 1 else 2
        x = x.reshape(len(x), -1, *x.shape[-space:])
        x = self.obs_patch_embed(x).flatten(2).transpose(1, 2)
        x = torch.cat([self.class_token_encoding.expand(len(x), -1, -1), x], 1)
        if hasattr(self, "obs_patch_pos_encoding"):
            x = x + self.obs_patch_pos_encoding
        tokens, maps = [], []
        for index in range(self.num_blocks):
            x, weights = self.inner_block(index)(x)
            tokens.append(x[:, 0].reshape(batch, steps, -1))
            maps.append(weights)
        return tokens, maps

    def _encode_history(self, tokens: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        steps = tokens[0].shape[1]
        mask = torch.ones(steps, steps, dtype=torch.bool).triu(1)  # True: not seen
        if hasattr(self, "step_pos_encoding"):
            tokens = [x + self.step_pos_encoding[:, 0] for x in tokens]
        paired = self.variant == "enhanced" and self.inner
        outputs, maps = [], []
        x = tokens[-1]
        for index in range(self.num_blocks):
            x, weights = self.outer_block(index)(tokens[index] if paired else x, mask)
            outputs.append(x)
            maps.append(weights)
        return outputs, maps


def matched_parameters(
    network: nn.Module, reference: ReferenceTIT
) -> Iterator[tuple[str, nn.Parameter, nn.Parameter]]:
    """Pairs each parameter of one of our networks with the reference's: name, ours, reference's."""
    theirs = dict(reference.named_parameters(remove_duplicate=False))
    for name, parameter in network.named_parameters():
        yield name, parameter, theirs[_reference_name(name, reference)]


def _reference_name(name: str, reference: ReferenceTIT) -> str:
    name = name.replace("history_encoder.inner.", "frame_encoder.")
    name = name.replace("frame_encoders.observation.", "frame_encoder.")
    fixed = {
        "frame_encoder.patch_embedding.weight": "obs_patch_embed.weight",
        "frame_encoder.class_token": "class_token_encoding",
        "frame_encoder.positions": "obs_patch_pos_encoding",
        "frame_encoder.linear.weight": "embedding.weight",
        "history_encoder.positions": "step_pos_encoding",
    }
    if name in fixed:
        return fixed[name]
    part, _, rest = name.partition(".")
    if part == "head":
        layer, kind = rest.split(".")
        return {"0": "ln1", "1": "head.0", "3": "ln2"}[layer] + f".{kind}"
    _, index, rest = rest.split(".", 2)
    rest = rest.replace("norm", "ln")
    kind = {"frame_encoder": "inner", "history_encoder": "outer"}[part]
    if hasattr(reference, "block"):
        return f"block.{kind}_Transformer_block.{rest}"
    if hasattr(reference, "blocks"):
        # Without the dense connection we keep the last outer block only.
        if kind == "outer" and not reference.dense:
            index = str(reference.num_blocks - 1)
        return f"blocks.{index}.{kind}_Transformer_block.{rest}"
    return f"{kind}_blocks.{index}.{rest}"


def randomize(network: nn.Module, seed: int = 0) -> None:
    """Draws every parameter anew, LayerNorms and biases too, so that each one matters."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            norm = parameter.ndim == 1 and name.endswith("weight")
            noise = torch.randn(parameter.shape, generator=generator) * 0.2
            parameter.copy_(noise + 1 if norm else noise)


def copy_parameters(network: nn.Module, reference: ReferenceTIT) -> None:
    """Copies the parameters of one of our networks to the reference."""
    with torch.no_grad():
        for _, ours, theirs in matched_parameters(network, reference):
            theirs.copy_(ours)

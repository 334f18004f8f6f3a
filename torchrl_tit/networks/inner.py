"""Frame encoders: one observation to one or several tokens, the same at every step."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from torchrl_tit.networks.block import TransformerBlock
from torchrl_tit.networks.patches import embed, make_patch_embedding


class InnerTransformer(nn.Module):
    """Reads the patches of one observation (arXiv 2212.14538, section "The Inner Transformer").

    Class token and patch tokens, plus position encodings, go through L blocks. What is put out is
    the class token: after every block (Enhanced_TIT) or after the last one (Vanilla_TIT). Of the
    last block nothing else is read, so nothing else is computed.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        patch_size: entries, or pixels along a side, of a patch.
        embed_dim: width D of a token.
        num_blocks: number of blocks L.
        make_block: builds one block of that width.
        every_block: whether the class token of every block is put out, or of the last one only.
        position_encoding: whether a learned position encoding is added.
        share_blocks: whether all L blocks are one and the same.
        frames: number of observations that are stacked as channels; None for a single one.

    Example:
        >>> def make_block():
        ...     return TransformerBlock(32, num_heads=4)
        >>> inner = InnerTransformer((84, 84), 12, 32, num_blocks=2, make_block=make_block)
        >>> inner(torch.zeros(8, 84, 84, dtype=torch.uint8)).shape
        torch.Size([8, 2, 32])
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        patch_size: int,
        embed_dim: int,
        *,
        num_blocks: int,
        make_block: Callable[[], TransformerBlock],
        every_block: bool = True,
        position_encoding: bool = True,
        share_blocks: bool = False,
        frames: int | None = None,
    ) -> None:
        super().__init__()
        self.observation_ndim = len(observation_shape)
        self.frames = frames
        self.num_blocks = num_blocks
        self.num_tokens = num_blocks if every_block else 1
        self.every_block = every_block
        self.patch_embedding = make_patch_embedding(
            observation_shape, patch_size, embed_dim, frames=frames or 1
        )
        self.class_token = nn.Parameter(torch.empty(1, 1, embed_dim))
        self.positions = (
            nn.Parameter(torch.empty(1, 1 + self.patch_embedding.num_patches, embed_dim))
            if position_encoding
            else None
        )
        self.blocks = nn.ModuleList(make_block() for _ in range(1 if share_blocks else num_blocks))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises class token and positions: normal with a standard deviation of 0.02."""
        nn.init.normal_(self.class_token, std=0.02)
        if self.positions is not None:
            nn.init.normal_(self.positions, std=0.02)

    def forward(self, observation: Tensor) -> Tensor:
        """Encodes observations.

        Args:
            observation: [..., *observation_shape], or [..., frames, *observation_shape] where
                frames are stacked as channels; float, or uint8 which is divided by 255.

        Returns:
            Class tokens, float [..., L, D], or [..., 1, D] of the last block only.
        """
        class_token, patches, leading = self._tokens(observation)
        if self.num_blocks == 1:  # before it, the class token is the same for all observations
            x = self._block(0).read_first(class_token, patches)  # [N, 1, D]
            return x.reshape(*leading, 1, x.shape[-1])
        x = _join(class_token, patches)
        class_tokens = []
        for index in range(self.num_blocks):
            last = index == self.num_blocks - 1
            x = self._block(index)(x, read="first" if last else "all")
            if last or self.every_block:
                class_tokens.append(x[:, 0])
        return torch.stack(class_tokens, dim=1).reshape(*leading, self.num_tokens, x.shape[-1])

    def attention_maps(self, observation: Tensor) -> list[Tensor]:
        """Returns the attention weights of each block, L x float [..., heads, S, S].

        S = 1 + patches; position 0 is the class token, the patches follow row by row.
        """
        class_token, patches, leading = self._tokens(observation)
        x = _join(class_token, patches)
        maps = []
        for index in range(self.num_blocks):
            block = self._block(index)
            weights = block.attention_weights(x)
            maps.append(weights.reshape(*leading, *weights.shape[1:]))
            x = block(x)
        return maps

    def _block(self, index: int) -> TransformerBlock:
        block = self.blocks[index % len(self.blocks)]
        assert isinstance(block, TransformerBlock)
        return block

    def _tokens(self, observation: Tensor) -> tuple[Tensor, Tensor, tuple[int, ...]]:
        """[..., *observation] -> class token [1, 1, D], patches [N, patches, D], leading shape."""
        frame_ndim = self.observation_ndim + (self.frames is not None)
        leading = observation.shape[: observation.ndim - frame_ndim]
        shape = observation.shape[observation.ndim - frame_ndim :]
        # Arrays become [N, channels, D], images [N, channels, H, W]: frames are channels too.
        space = 1 if self.observation_ndim == 1 else 2
        channels = math.prod(shape[:-space])
        x = observation.reshape(math.prod(leading), channels, *shape[-space:])
        patches = self.patch_embedding(x)
        if self.positions is None:
            return self.class_token, patches, tuple(leading)
        class_token = self.class_token + self.positions[:, :1]
        return class_token, patches + self.positions[:, 1:], tuple(leading)


def _join(class_token: Tensor, patches: Tensor) -> Tensor:
    """[1, 1, D] and [N, patches, D] -> [N, 1 + patches, D]."""
    return torch.cat([class_token.expand(patches.shape[0], -1, -1), patches], dim=1)


class LinearFrameEncoder(nn.Module):
    """Maps a whole observation to one token with a linear layer.

    The observation embedding of the ablation without inner blocks (arXiv 2212.14538, appendix
    "Ablation Study"); with a bias, that of Decision Transformer.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        embed_dim: width of the token.
        bias: whether the linear layer has a bias.

    Example:
        >>> LinearFrameEncoder((84, 84), 32)(torch.zeros(8, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([8, 4, 1, 32])
    """

    num_tokens = 1

    def __init__(
        self, observation_shape: Sequence[int], embed_dim: int, *, bias: bool = False
    ) -> None:
        super().__init__()
        self.observation_ndim = len(observation_shape)
        self.linear = nn.Linear(math.prod(observation_shape), embed_dim, bias=bias)

    def forward(self, observation: Tensor) -> Tensor:
        """[..., *observation_shape], float or uint8 -> [..., 1, D]."""
        x = observation.flatten(-self.observation_ndim).unsqueeze(-2)  # [..., 1, entries]
        token = embed(x, self.linear.weight)
        return token if self.linear.bias is None else token + self.linear.bias

"""The inner transformer, which maps the patches of one observation to class tokens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.observation import Kind
from torchrl_tit.layers.blocks import TransformerBlock
from torchrl_tit.layers.patches import find_patch_size, make_patch_embedding


class InnerTransformer(FrameEncoder):
    """Reads the patches of one observation (arXiv 2212.14538, section "The Inner Transformer").

    Class token and patch tokens, plus position encodings, go through L blocks. The output is the
    class token after every block (Enhanced_TIT) or after the last one (Vanilla_TIT). The last block
    computes only the class token, because nothing else is read.

    Args:
        settings: patch size, width, blocks and outputs.
        observation_shape: (D,) for arrays and categories, (H, W) or (C, H, W) for images.
        num_frames: number of observations that are stacked as channels; not for categories.
        categories: for categories, the number of values of each entry. Each entry has an embedding,
            and a patch is the sum of its entries' embeddings.

    Raises:
        ValueError: if the patch does not fit the observation, or the heads do not divide the width.

    Example:
        >>> inner = InnerTransformer(settings.Inner(patch_size=12, num_heads=4), (84, 84))
        >>> inner(torch.zeros(8, 84, 84, dtype=torch.uint8)).shape
        torch.Size([8, 2, 32])
        >>> inner = InnerTransformer(settings.Inner(), (2,), categories=(4, 3))
        >>> inner(torch.tensor([[3, 0], [1, 2]])).shape
        torch.Size([2, 2, 32])
    """

    kinds: ClassVar[tuple[Kind, ...]] = ("array", "image", "categories")

    def __init__(
        self,
        settings: settings.Inner | settings.StackedInner,
        observation_shape: Sequence[int],
        *,
        num_frames: int | None = None,
        categories: Sequence[int] | None = None,
    ) -> None:
        super().__init__(
            observation_shape,
            num_tokens=settings.num_blocks if settings.every_block else 1,
            width=settings.embed_dim,
        )
        self.num_frames = num_frames
        self.num_blocks = settings.num_blocks
        self.every_block = settings.every_block
        self.patch_embedding = make_patch_embedding(
            self.observation_shape,
            find_patch_size(
                self.observation_shape, settings.patch_size, categories=categories is not None
            ),
            settings.embed_dim,
            num_frames=num_frames or 1,
            categories=categories,
            own_weights=settings.patch_weights == "own",
        )
        self.class_token = nn.Parameter(torch.empty(1, 1, settings.embed_dim))
        self.positions = (
            nn.Parameter(torch.empty(1, 1 + self.patch_embedding.num_patches, settings.embed_dim))
            if settings.position_encoding
            else None
        )
        self.blocks = nn.ModuleList(
            TransformerBlock(settings.embed_dim, **settings.block())
            for _ in range(1 if settings.share_blocks else settings.num_blocks)
        )
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes class token and positions: normal with a standard deviation of 0.02."""
        nn.init.normal_(self.class_token, std=0.02)
        if self.positions is not None:
            nn.init.normal_(self.positions, std=0.02)

    def forward(self, observation: Tensor, mask: Tensor | None = None) -> Tensor:
        """Encodes observations.

        Args:
            observation: [..., *observation_shape], or [..., num_frames, *observation_shape] if
                frames are stacked as channels; float, or uint8, which is divided by 255; integers
                for categories.
            mask: bool [..., patches], True where a patch is read; None reads all.

        Returns:
            Class tokens, float [..., L, D], or [..., 1, D] of the last block only.
        """
        frame_ndim = len(self.observation_shape) + (self.num_frames is not None)
        leading = observation.shape[: observation.ndim - frame_ndim]
        shape = observation.shape[observation.ndim - frame_ndim :]
        # Arrays become [N, channels, D], images [N, channels, H, W]: frames are channels too.
        space = 1 if len(self.observation_shape) == 1 else 2
        x = observation.reshape(math.prod(leading), math.prod(shape[:-space]), *shape[-space:])
        patches = self.patch_embedding(x)  # [N, patches, D]
        x = torch.cat([self.class_token.expand(patches.shape[0], -1, -1), patches], dim=1)
        x = x if self.positions is None else x + self.positions
        if mask is not None:  # the class token is always read
            mask = mask.reshape(x.shape[0], 1, 1, mask.shape[-1])
            mask = nn.functional.pad(mask, (1, 0), value=True)
        class_tokens = []
        for index in range(self.num_blocks):
            last = index == self.num_blocks - 1
            block = self.blocks[index % len(self.blocks)]
            x = block(x, read="first" if last else "all", mask=mask)
            if last or self.every_block:
                class_tokens.append(x[:, 0])
        return torch.stack(class_tokens, dim=1).reshape(*leading, self.num_tokens, self.width)

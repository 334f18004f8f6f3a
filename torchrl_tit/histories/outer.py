"""The outer transformers of TIT, which map the tokens of K frames to one vector."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.histories.encoder import HistoryEncoder, HistoryShape, OneToken
from torchrl_tit.layers.blocks import TransformerBlock
from torchrl_tit.layers.window_attention import worth_a_table
from torchrl_tit.windows import Windows, take


class OuterTransformer(HistoryEncoder):
    """The base of the outer transformers: causal blocks over the frames, read at the newest one.

    The paper gives the outer transformer no position encoding: the newest frame then sees the past
    as a set. Optional temporal positions tell the frames apart. Learned encodings are added to the
    tokens; a bias for each distance, or rotations, act within attention. Distances are within the
    window of K frames.

    Args:
        settings: heads, FFN, dropout and temporal positions.
        shape: shape of the input.
        num_blocks: number of blocks.
        out_features: size of the output.
    """

    def __init__(
        self,
        settings: settings.Outer | settings.PairedOuter | settings.ChainedOuter,
        shape: HistoryShape,
        *,
        num_blocks: int,
        out_features: int,
    ) -> None:
        super().__init__(shape, out_features=out_features)
        self.num_blocks = num_blocks
        self.positions = (
            nn.Parameter(torch.empty(shape.num_frames, 1, shape.width))
            if settings.temporal_positions == "learned"
            else None
        )
        self.blocks = nn.ModuleList(
            TransformerBlock(
                shape.width,
                **settings.block(),
                causal=True,
                positions=settings.temporal_positions,
                num_frames=shape.num_frames,
            )
            for _ in range(1 if settings.share_blocks else num_blocks)
        )
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes temporal positions: normal with a standard deviation of 0.02."""
        if self.positions is not None:
            nn.init.normal_(self.positions, std=0.02)

    def _block(self, index: int) -> TransformerBlock:
        block = self.blocks[index % len(self.blocks)]
        assert isinstance(block, TransformerBlock)
        return block

    def _with_positions(self, tokens: Tensor) -> Tensor:
        """Adds learned temporal positions, if any, to [..., K, L, D]."""
        return tokens if self.positions is None else tokens + self.positions


class SlidingOuterTransformer(OuterTransformer):
    """The base of outer blocks that read the output of the block before, at all frames.

    If a block attends to A of the K frames, N blocks see N (A - 1) + 1 frames, as the layers of
    Transformer-XL see beyond a segment (arXiv 1901.02860). A block's output at a frame then depends
    on the frames before it alone, not on where the window begins, so that sequences compute it
    once, exactly.

    Args:
        settings: those of the outer blocks.
        shape: shape of the input.
        num_blocks: number N of blocks.
        out_features: size of the output.

    Raises:
        ValueError: if ``attention_frames`` does not fit the number of frames or the positions.
    """

    def __init__(
        self,
        settings: settings.Outer | settings.ChainedOuter,
        shape: HistoryShape,
        *,
        num_blocks: int,
        out_features: int,
    ) -> None:
        super().__init__(settings, shape, num_blocks=num_blocks, out_features=out_features)
        self.attention_frames = attended = settings.attention_frames
        if attended is None:
            return
        seen, positions = num_blocks * (attended - 1) + 1, settings.temporal_positions
        if shape.num_frames != seen:
            raise ValueError(
                f"{num_blocks} outer blocks with attention_frames {attended} see {seen} frames, "
                f"but num_frames is {shape.num_frames}: set it to {seen}"
            )
        if positions in ("learned", "relative"):
            raise ValueError(
                f"attention_frames {attended} needs positions that do not depend on where the "
                f"history begins, not {positions!r}: set temporal_positions to rotary or none"
            )

    def reads_tables(self, windows: Windows) -> bool:
        """Whether blocks can read each frame of a sequence once.

        If they attend to all K frames, what a block passes on depends on where the window begins.
        """
        attended = self.attention_frames
        return attended is not None and worth_a_table(windows.newest(attended))

    def chain(self, tokens: Sequence[Tensor], windows: Windows | None = None) -> list[Tensor]:
        """The output of each block at the newest frame, float [..., D] or [N, T, D] of a table.

        Args:
            tokens: the input of the first block, [..., K, D], or of a table, [R, D]; then what is
                added to the output of each block, if anything is, for the next.
            windows: the rows of each window on the table, [N, T, K].
        """
        x, mask, newest = tokens[0], None, []
        attended = self.attention_frames or self.shape.num_frames
        if windows is not None:
            around = windows.of_every_row(x.shape[0], attended)
        elif self.attention_frames is not None:
            ones = torch.ones(x.shape[-2], x.shape[-2], dtype=torch.bool, device=x.device)
            mask = ones.tril().triu(1 - attended)
        for index in range(self.num_blocks - 1):
            if windows is None:
                x = self._block(index)(x, mask=mask)
                newest.append(x[..., -1, :])
            else:
                x = self._block(index).read_every_row(x, around)
                newest.append(take(x, windows.rows[..., -1]))
            if len(tokens) > 1:
                x = x + tokens[index + 1]
        last = self._block(self.num_blocks - 1)
        if windows is None:
            newest.append(last(x, "last", mask).squeeze(-2))
        else:
            newest.append(last.read_windows(x, windows.newest(attended)))
        return newest


class PairedOuterTransformer(OuterTransformer):
    """The outer blocks of Enhanced_TIT (arXiv 2212.14538, section "Enhanced_TIT").

    Outer block l reads token l of the K frames, which is the output of inner block l, but never the
    previous outer block. The newest frame's outputs of all blocks are concatenated (the dense
    connection). Without the dense connection only the last pair matters, so frames have one token.

    Args:
        settings: heads, FFN, dropout and temporal positions.
        shape: shape of the input.

    Example:
        >>> shape = HistoryShape(num_frames=4, num_tokens=2, width=32)
        >>> outer = PairedOuterTransformer(settings.PairedOuter(num_heads=4), shape)
        >>> outer(torch.randn(8, 4, 2, 32)).shape
        torch.Size([8, 64])
    """

    def __init__(self, settings: settings.PairedOuter, shape: HistoryShape) -> None:
        blocks = shape.num_tokens
        super().__init__(settings, shape, num_blocks=blocks, out_features=blocks * shape.width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K frames, float [..., K, L, D] -> float [..., L * D]."""
        steps = self._with_positions(tokens).unbind(-2)
        newest = [self._block(i)(x, read="last") for i, x in enumerate(steps)]
        return torch.cat(newest, dim=-1).squeeze(-2)

    def reads_tables(self, windows: Windows) -> bool:
        """Whether each block can project the tokens of a frame once for all windows.

        Learned positions are added to the tokens, so these differ from window to window.
        """
        return self.positions is None and worth_a_table(windows)

    def read_table(self, tokens: Tensor, windows: Windows) -> Tensor:
        """Tokens of a table of frames, float [R, L, D] -> float [N, T, L * D]."""
        steps = tokens.unbind(-2)
        newest = [self._block(i).read_windows(x, windows) for i, x in enumerate(steps)]
        return torch.cat(newest, dim=-1)


class ChainedOuterTransformer(SlidingOuterTransformer):
    """The outer blocks of Enhanced_TIT, each also reading the output of the previous one.

    Outer block l reads, at all K frames, the sum of token l (the output of inner block l) and the
    output of outer block l - 1. The newest frame's outputs of all blocks are concatenated, as in
    Enhanced_TIT. So perception and decision alternate, as in the successor of TIT by the same
    authors: Mao et al., "PDiT: Interleaving Perception and Decision-making Transformers for Deep
    Reinforcement Learning", arXiv 2312.15863.

    Unlike in a network that interleaves in both directions, nothing flows from the history back to
    the frames: inner block l + 1 does not see the output of outer block l. The tokens of a frame
    still depend on that frame alone, so each frame is encoded once.

    All blocks but the last compute all K frames, whereas those of :class:`PairedOuterTransformer`
    compute only the newest.

    Args:
        settings: heads, FFN, dropout and temporal positions.
        shape: shape of the input.

    Example:
        >>> shape = HistoryShape(num_frames=4, num_tokens=2, width=32)
        >>> outer = ChainedOuterTransformer(settings.ChainedOuter(num_heads=4), shape)
        >>> outer(torch.randn(8, 4, 2, 32)).shape
        torch.Size([8, 64])
    """

    def __init__(self, settings: settings.ChainedOuter, shape: HistoryShape) -> None:
        blocks = shape.num_tokens
        super().__init__(settings, shape, num_blocks=blocks, out_features=blocks * shape.width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K frames, float [..., K, L, D] -> float [..., L * D]."""
        return torch.cat(self.chain(self._with_positions(tokens).unbind(-2)), dim=-1)

    def read_table(self, tokens: Tensor, windows: Windows) -> Tensor:
        """Tokens of a table of frames, float [R, L, D] -> float [N, T, L * D]."""
        return torch.cat(self.chain(tokens.unbind(-2), windows), dim=-1)


class StackedOuterTransformer(SlidingOuterTransformer):
    """The outer transformer of Vanilla_TIT (arXiv 2212.14538, section "The Outer Transformer").

    A stack of causal blocks over one token per frame. The output is the last block's output for the
    newest frame or, with dense connections (the ablation without inner blocks), the outputs of all
    blocks. If frames have several tokens, a linear layer merges them into one.

    Args:
        settings: blocks, heads, FFN, dropout and temporal positions.
        shape: shape of the input.

    Example:
        >>> shape = HistoryShape(num_frames=4, num_tokens=1, width=32)
        >>> outer = StackedOuterTransformer(settings.Outer(num_heads=4), shape)
        >>> outer(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 32])
    """

    def __init__(self, settings: settings.Outer, shape: HistoryShape) -> None:
        outputs = settings.num_blocks if settings.dense else 1
        super().__init__(
            settings, shape, num_blocks=settings.num_blocks, out_features=outputs * shape.width
        )
        self.dense = settings.dense
        self.one_token = OneToken(shape)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K frames, float [..., K, L, D] -> float [..., D] (dense: [..., blocks * D])."""
        x = self._with_positions(self.one_token(tokens).unsqueeze(-2)).squeeze(-2)
        return self._join(self.chain([x]))

    def read_table(self, tokens: Tensor, windows: Windows) -> Tensor:
        """Tokens of a table of frames, float [R, L, D] -> float [N, T, D or blocks * D]."""
        return self._join(self.chain([self.one_token(tokens)], windows))

    def _join(self, newest: list[Tensor]) -> Tensor:
        return torch.cat(newest, dim=-1) if self.dense else newest[-1]

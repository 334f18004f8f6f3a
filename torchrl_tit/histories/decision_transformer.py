"""Decision Transformer as a history encoder."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_tit import settings
from torchrl_tit.histories.encoder import HistoryEncoder, HistoryShape, OneToken
from torchrl_tit.layers.blocks import GPT2Block

_STATES = slice(1, None, 3)
"""Positions of the states in a sequence of return, state, action, return, state, action, ..."""


class DecisionTransformer(HistoryEncoder):
    """Reads the returns to go, states and actions of a window of K steps.

        return to go, state, action   one token each, plus the embedding of their time step
          LayerNorm, GPT-2 blocks     each token sees itself and the tokens before it
          LayerNorm                   on the state tokens: the features of that step

    Chen et al., "Decision Transformer: Reinforcement Learning via Sequence Modeling", arXiv
    2106.01345, section 3. With a linear frame encoder it is DT; with an inner transformer it is
    DT_TIT of arXiv 2212.14538. The original's predictions of states and returns, which are never
    trained, are left out. GPT-2 blocks are initialized as in GPT-2, all other layers as in PyTorch.

    The last block computes only the state tokens, because only these are read. No state sees the
    action of the last step, so that action is not read.

    Returns to go are divided by the buffer ``return_scale``, which is 1 unless it is filled. It is
    a setting and not in a state dict: fill it again where weights are loaded.

    Args:
        settings: blocks, heads, FFN, dropout and time steps.
        shape: shape of the input; its ``action_dim`` is required.

    Raises:
        ValueError: if ``action_dim`` is missing or below 1, the heads do not divide the width, or
            ``forward`` gets invalid inputs, such as time steps beyond ``max_ep_len`` (checked only
            on a CPU).

    Example:
        >>> shape = HistoryShape(num_frames=20, num_tokens=1, width=128, action_dim=3)
        >>> encoder = DecisionTransformer(settings.DecisionTransformer(), shape)
        >>> tokens, action = torch.randn(2, 20, 1, 128), torch.randn(2, 20, 3)
        >>> return_to_go, timestep = torch.ones(2, 20, 1), torch.arange(20).expand(2, 20)
        >>> encoder(tokens, action, return_to_go, timestep).shape
        torch.Size([2, 128])
        >>> encoder.every_frame(tokens, action, return_to_go, timestep).shape
        torch.Size([2, 20, 128])
    """

    context = ("action", "return_to_go", "timestep", "mask")
    reads_any_length = True
    encodes_every_frame = True
    return_scale: Tensor

    def __init__(self, settings: settings.DecisionTransformer, shape: HistoryShape) -> None:
        if shape.action_dim is None:
            raise ValueError(
                "Decision Transformer reads actions and returns beside observations: give "
                "action_dim (the entries of a continuous action, or the number of discrete ones), "
                "or choose another history encoder if there are only observations"
            )
        if shape.action_dim < 1:
            raise ValueError(f"action_dim must be at least 1, not {shape.action_dim}")
        width = shape.width
        super().__init__(shape, out_features=width)
        self.action_dim = shape.action_dim
        self.max_ep_len = settings.max_ep_len
        self.one_token = OneToken(shape)
        self.action_embedding = nn.Linear(shape.action_dim, width)
        self.register_buffer("return_scale", torch.ones(()), persistent=False)
        self.return_embedding = nn.Linear(1, width)
        self.timestep_embedding = (
            nn.Embedding(settings.max_ep_len, width) if settings.timestep_embedding else None
        )
        self.embedding_norm = nn.LayerNorm(width)
        self.dropout = nn.Dropout(settings.dropout)
        self.blocks = nn.ModuleList(
            GPT2Block(
                width,
                settings.num_heads,
                settings.ffn_dim or 4 * width,
                activation=settings.activation,
                dropout=settings.dropout,
            )
            for _ in range(settings.num_blocks)
        )
        self.norm = nn.LayerNorm(width)

    def forward(  # type: ignore[override]  # it reads more than tokens: see ``context``
        self,
        tokens: Tensor,
        action: Tensor,
        return_to_go: Tensor,
        timestep: Tensor,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Encodes the newest step of a window, for acting.

        Args:
            tokens: tokens of the states, float [..., K, L, D], for any K.
            action: float [..., K, A]; discrete actions are integers [..., K], negative at padding,
                or one-hot [..., K, A]. The action of the last step is not read.
            return_to_go: float [..., K, 1].
            timestep: int64 [..., K], from 0 to below ``max_ep_len``.
            mask: [..., K], 0 or False at padding, which no other step sees (its values are ignored,
                but must be finite); None if there is no padding.

        Returns:
            float [..., D].
        """
        newest = self._encode(slice(-1, None), tokens, action, return_to_go, timestep, mask)
        return newest.squeeze(-2)

    def every_frame(self, tokens: Tensor, *context: Tensor) -> Tensor:
        """Encodes every step of a window from the steps up to it, for training.

        Args:
            tokens: as in ``forward``.
            *context: the other inputs, as in ``forward``.

        Returns:
            float [..., K, D]; finite but meaningless at padding.
        """
        return self._encode(_STATES, tokens, *context)

    def attention_maps(self, tokens: Tensor, *context: Tensor) -> list[Tensor]:
        """Returns how much each step's state attends to each step, float [..., heads, K, K].

        The weights of a step's return to go, state and action are added.

        Args:
            tokens: as in ``forward``.
            *context: the other inputs, as in ``forward``.
        """
        maps = super().attention_maps(tokens, *context)  # [..., heads, 3K - 1, 3K - 1] each
        of_states = (F.pad(weights[..., _STATES, :], (0, 1)) for weights in maps)
        return [weights.unflatten(-1, (-1, 3)).sum(-1) for weights in of_states]

    def _encode(
        self,
        read: slice,
        tokens: Tensor,
        action: Tensor,
        return_to_go: Tensor,
        timestep: Tensor,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Features of the positions ``read`` of the sequence, float [..., positions, D]."""
        state = self.one_token(tokens)  # [..., K, D]
        *leading, steps, _ = state.shape
        action = self._as_vectors(action, (*leading, steps)).to(state.dtype)
        _check(action, (*leading, steps, self.action_dim), "action")
        _check(return_to_go, (*leading, steps, 1), "return_to_go")
        _check(timestep, (*leading, steps), "timestep")
        to_go = self.return_embedding(return_to_go / self.return_scale)
        x = torch.stack([to_go, state, self.action_embedding(action)], dim=-2)  # [..., K, 3, D]
        if self.timestep_embedding is not None:
            x = x + self._embed_time(timestep).unsqueeze(-2)
        # The sequence ends with the last state: no state sees the last action.
        x = x.flatten(-3, -2)[..., :-1, :]  # [..., 3K - 1, D]
        visible = torch.ones(2 * [3 * steps - 1], dtype=torch.bool, device=x.device).tril()
        if mask is not None:
            _check(mask, (*leading, steps), "mask")
            valid = mask.reshape(-1, 1, 1, steps).bool()
            valid = valid.repeat_interleave(3, dim=-1)[..., :-1]  # [N, 1, 1, 3K - 1]
            # Padding sees itself: a softmax over nothing would be NaN.
            itself = torch.eye(3 * steps - 1, dtype=torch.bool, device=x.device)
            visible = (visible & valid) | itself
        x = self.dropout(self.embedding_norm(x))
        for block in self.blocks[:-1]:
            x = block(x, visible)
        return self.norm(self.blocks[-1](x, visible, read))

    def _as_vectors(self, action: Tensor, steps_shape: tuple[int, ...]) -> Tensor:
        """Turns discrete actions [..., K] into one-hot vectors; leaves others unchanged."""
        if action.is_floating_point() or action.ndim != len(steps_shape):
            return action
        classes = torch.arange(self.action_dim, device=action.device)
        return action.unsqueeze(-1) == classes  # zeros at padding, which is negative

    def _embed_time(self, timestep: Tensor) -> Tensor:
        """int64 [..., K] -> [..., K, D]."""
        assert self.timestep_embedding is not None
        try:
            return self.timestep_embedding(timestep)
        except IndexError as error:  # raised on a CPU only; a GPU reports a failed assertion
            raise ValueError(
                f"timesteps range from {int(timestep.min())} to {int(timestep.max())}, but must be "
                f"at least 0 and below max_ep_len {self.max_ep_len}: raise it to the length of the "
                "longest episode, or truncate episodes there"
            ) from error


def _check(x: Tensor, expected: tuple[int, ...], name: str) -> None:
    if tuple(x.shape) != expected:
        raise ValueError(
            f"{name} of shape {tuple(x.shape)} does not fit the states: expected {expected}"
        )

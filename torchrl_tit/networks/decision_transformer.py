"""Decision Transformer, with a linear state embedding (DT) or an inner transformer (DT_TIT)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tit.networks.config import override_config
from torchrl_tit.networks.decision_transformer_config import DecisionTransformerConfig
from torchrl_tit.networks.dropout import Dropout
from torchrl_tit.networks.history_network import check_history, check_observation

_STATES = slice(1, None, 3)
"""Where the states are among the tokens of return, state and action that take turns."""


class DecisionTransformer(nn.Module):
    """Predicts actions from the returns to go, states and actions of a window of K steps.

        return to go, state, action   one token each, plus the embedding of their time step
          LayerNorm, GPT-2 blocks     each token sees itself and those before it
          LayerNorm, linear           on the state tokens: the action of that step

    Chen et al., "Decision Transformer: Reinforcement Learning via Sequence Modeling", arXiv
    2106.01345, section 3; with ``state_encoder="inner_transformer"`` DT_TIT of arXiv 2212.14538.
    The original's predictions of states and returns, which are never trained, are left out. GPT-2
    blocks start as GPT-2 does, the rest as PyTorch's layers do.

    Of the last block only the state tokens are read, so nothing else of it is computed, and no
    state sees the last action, so it is not read.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        action_dim: entries of a continuous action, or number of discrete ones.
        config: hyperparameters.
        **hyperparameters: fields of :class:`DecisionTransformerConfig` that override those of
            ``config``.

    Raises:
        ValueError: if a hyperparameter is not possible, or the inputs do not fit, such as time
            steps beyond ``max_ep_len`` (on a CPU).
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> network = DecisionTransformer(observation_shape=(11,), action_dim=3)
        >>> states, actions = torch.randn(2, 20, 11), torch.randn(2, 20, 3)
        >>> returns_to_go = torch.ones(2, 20, 1)
        >>> network(states, actions, returns_to_go, torch.arange(20).expand(2, 20)).shape
        torch.Size([2, 20, 3])
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        action_dim: int,
        config: DecisionTransformerConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        super().__init__()
        config = override_config(DecisionTransformerConfig, config, hyperparameters)
        check_observation(observation_shape, config.context)
        if action_dim < 1:
            raise ValueError(f"action_dim must be >= 1, not {action_dim}")
        width = config.embed_dim
        self.config = config
        self.observation_shape = tuple(observation_shape)
        self.action_dim = action_dim
        self.features_dim = width
        self.state_encoder = config.make_state_encoder(observation_shape)
        self.action_embedding = nn.Linear(action_dim, width)
        self.return_embedding = nn.Linear(1, width)
        self.timestep_embedding = (
            nn.Embedding(config.max_ep_len, width) if config.timestep_embedding else None
        )
        self.embedding_norm = nn.LayerNorm(width)
        self.dropout = Dropout(config.dropout)
        self.blocks = nn.ModuleList(config.make_block() for _ in range(config.num_blocks))
        self.norm = nn.LayerNorm(width)
        self.action_head = config.make_action_head(action_dim)

    def forward(
        self,
        states: Tensor,
        actions: Tensor,
        returns_to_go: Tensor,
        timesteps: Tensor,
        attention_mask: Tensor | None = None,
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Predicts the action of every step from what came before it.

        Args:
            states: [..., K, *observation_shape], float or uint8 (divided by 255).
            actions: float [..., K, A]; one-hot where actions are discrete. The one of the last step
                is not read.
            returns_to_go: float [..., K, 1].
            timesteps: int64 [..., K], from 0 to below ``max_ep_len``.
            attention_mask: [..., K], 0 or False for padding (of any content, but finite), which no
                other step sees; None where there is no padding.

        Returns:
            float [..., K, A]: actions within -1..1, or logits of discrete ones; with
            ``action_space="gaussian"`` mean and standard deviation. Meaningless, but finite, at
            padding.
        """
        tokens = self.encode_states(states)
        features = self.encode(tokens, actions, returns_to_go, timesteps, attention_mask)
        return self.action_head(features)

    def encode_states(self, states: Tensor) -> Tensor:
        """Makes a token of every state, which depends on that state alone.

        Args:
            states: as in ``forward``.

        Returns:
            float [..., K, D].
        """
        self.check_states(states)
        return self.state_encoder(states).squeeze(-2)

    def check_states(self, states: Tensor) -> None:
        """Raises ValueError or TypeError where states do not fit this network."""
        ndim = len(self.observation_shape)
        steps = states.shape[-ndim - 1] if states.ndim > ndim else 1
        check_history(states, steps, self.observation_shape, self.norm.weight.dtype)

    def encode(
        self,
        state_tokens: Tensor,
        actions: Tensor,
        returns_to_go: Tensor,
        timesteps: Tensor,
        attention_mask: Tensor | None = None,
        *,
        newest: bool = False,
    ) -> Tensor:
        """Maps a window to the features from which its actions are predicted.

        Args:
            state_tokens: what ``encode_states`` made of the states, float [..., K, D].
            actions: as in ``forward``.
            returns_to_go: as in ``forward``.
            timesteps: as in ``forward``.
            attention_mask: as in ``forward``.
            newest: whether only the last step is read: the cheaper way to act.

        Returns:
            float [..., K, D], or [..., 1, D] of the last step.
        """
        *leading, steps, width = state_tokens.shape
        _check(actions, (*leading, steps, self.action_dim), "actions")
        _check(returns_to_go, (*leading, steps, 1), "returns_to_go")
        _check(timesteps, (*leading, steps), "timesteps")
        tokens = torch.stack(
            [
                self.return_embedding(returns_to_go),
                state_tokens,
                self.action_embedding(actions.to(state_tokens.dtype)),
            ],
            dim=-2,
        )  # [..., K, 3, D]
        if self.timestep_embedding is not None:
            tokens = tokens + self._embed_time(timesteps).unsqueeze(-2)
        # Up to the last state: no state sees the last action.
        x = tokens.reshape(math.prod(leading), 3 * steps, width)[:, :-1]  # [N, 3K - 1, D]
        mask = torch.ones(x.shape[1], x.shape[1], dtype=torch.bool, device=x.device).tril()
        if attention_mask is not None:
            _check(attention_mask, (*leading, steps), "attention_mask")
            valid = attention_mask.reshape(-1, 1, 1, steps).bool()
            valid = valid.repeat_interleave(3, dim=-1)[..., :-1]  # [N, 1, 1, 3K - 1]
            # Padding sees itself: a softmax over nothing would be NaN.
            itself = torch.eye(x.shape[1], dtype=torch.bool, device=x.device)
            mask = (mask & valid) | itself
        x = self.dropout(self.embedding_norm(x))
        for block in self.blocks[:-1]:
            x = block(x, mask)
        x = self.blocks[-1](x, mask, slice(-1, None) if newest else _STATES)
        return self.norm(x).reshape(*leading, x.shape[1], width)

    def _embed_time(self, timesteps: Tensor) -> Tensor:
        """int64 [..., K] -> [..., K, D]."""
        assert self.timestep_embedding is not None
        try:
            return self.timestep_embedding(timesteps)
        except IndexError as error:  # on a CPU; a GPU does not say more than that it failed
            raise ValueError(
                f"timesteps reach from {int(timesteps.min())} to {int(timesteps.max())}, but must "
                f"be at least 0 and below max_ep_len {self.config.max_ep_len}: raise it to the "
                "longest episode, or cut episodes off there"
            ) from error


def _check(x: Tensor, expected: tuple[int, ...], name: str) -> None:
    if tuple(x.shape) != expected:
        raise ValueError(
            f"{name} of shape {tuple(x.shape)} do not fit the states: expected {expected}"
        )

"""TorchRL's LSTM as a history encoder."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import LSTMModule

from torchrl_tit import settings
from torchrl_tit.histories.encoder import HistoryShape, OneToken, RecurrentEncoder

_STATE = ["recurrent_state_h", "recurrent_state_c"]


class LSTM(RecurrentEncoder):
    """An LSTM over frames.

    With one frame (K = 1) the state is its memory, which :class:`~torchrl_tit.modules.Backbone`
    carries through an episode with TorchRL's `LSTMModule`. With more, it reads them from a state of
    zeros.

    Args:
        settings: size of the state.
        shape: what it reads.

    Example:
        >>> lstm = LSTM(settings.LSTM(), HistoryShape(num_frames=4, num_tokens=1, width=32))
        >>> lstm(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 64])
    """

    def __init__(self, settings: settings.LSTM, shape: HistoryShape) -> None:
        super().__init__(shape, out_features=settings.hidden_dim)
        self.one_token = OneToken(shape)
        self.memory = LSTMModule(
            shape.width,
            settings.hidden_dim,
            in_keys=["token", *_STATE],
            out_keys=["memory", *(("next", key) for key in _STATE)],
            python_based=shape.num_frames > 1,  # PyTorch's own is faster but not traceable
        )
        self.state_shapes = {key: torch.Size([1, settings.hidden_dim]) for key in _STATE}
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises the LSTM: orthogonal weights, biases 0."""
        for name, parameter in self.memory.lstm.named_parameters():
            if name.startswith("weight"):
                nn.init.orthogonal_(parameter)
            else:
                nn.init.zeros_(parameter)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K frames, float [..., K, L, D] -> the state after the last, float [..., E]."""
        x = self.one_token(tokens)  # [..., K, D]
        states, _ = self.memory.lstm(x.reshape(-1, *x.shape[-2:]))  # [N, K, E]
        return states[:, -1].reshape(*x.shape[:-2], self.out_features)

    def step(
        self, tokens: Tensor, state: dict[str, Tensor], is_init: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Tokens float [*B, L, D] and the state before -> float [*B, E] and the state after."""
        entries = {"token": self.one_token(tokens), **state, "is_init": is_init}
        outcome = self.memory(TensorDict(entries, tokens.shape[:-2]))
        return outcome["memory"], {key: outcome["next", key] for key in _STATE}

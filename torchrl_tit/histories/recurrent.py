"""TorchRL's LSTM and GRU as history encoders."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import GRUModule, LSTMModule

from torchrl_tit import settings
from torchrl_tit.histories.encoder import HistoryShape, OneToken, RecurrentEncoder, State


class _TorchRLEncoder(RecurrentEncoder):
    """One of TorchRL's recurrent modules, over frames.

    With one frame (K = 1), its state is its memory, which :class:`~torchrl_tit.modules.Backbone`
    carries through an episode. With several, the state is zero before the first frame.

    Args:
        settings: size of the state.
        shape: shape of the input.
    """

    memory_class: ClassVar[type[Any]]
    """TorchRL's module, which reads single steps and whole sequences."""
    layer_name: ClassVar[str]
    """Attribute of that module that holds the layers."""
    state: ClassVar[tuple[str, ...]]
    """Keys of the state."""

    def __init__(self, settings: settings.LSTM | settings.GRU, shape: HistoryShape) -> None:
        super().__init__(shape, out_features=settings.hidden_dim)
        self.one_token = OneToken(shape)
        self.memory = self.memory_class(
            shape.width,
            settings.hidden_dim,
            in_keys=["token", *self.state],
            out_keys=["memory", *(("next", key) for key in self.state)],
            python_based=shape.num_frames > 1,  # PyTorch's own is faster but not traceable
        )
        self.state_shapes = {key: torch.Size([1, settings.hidden_dim]) for key in self.state}
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes the layers: orthogonal weights, biases 0."""
        for name, parameter in self._layers.named_parameters():
            if name.startswith("weight"):
                nn.init.orthogonal_(parameter)
            else:
                nn.init.zeros_(parameter)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K frames, float [..., K, L, D] -> the state after the last, float [..., E]."""
        x = self.one_token(tokens)  # [..., K, D]
        states, _ = self._layers(x.reshape(-1, *x.shape[-2:]))  # [N, K, E]
        return states[:, -1].reshape(*x.shape[:-2], self.out_features)

    def step(self, tokens: Tensor, state: State, is_init: Tensor) -> tuple[Tensor, State]:
        """Tokens float [*B, L, D] and the state before -> float [*B, E] and the state after."""
        entries = {"token": self.one_token(tokens), **state, "is_init": is_init}
        outcome = self.memory(TensorDict(entries, tokens.shape[:-2]))
        return outcome["memory"], {key: outcome["next", key] for key in self.state}

    def single_step(self, tokens: Tensor, state: State, is_init: Tensor) -> tuple[Tensor, State]:
        """Like :meth:`step` on single steps, without branches on values and batch sizes."""
        x = self.one_token(tokens)  # [*B, D]
        first = is_init.reshape(-1, 1)
        before = [
            state[key].reshape(-1, self.out_features).masked_fill(first, 0) for key in self.state
        ]
        after = self.cell(x.reshape(-1, x.shape[-1]), before)
        leading = tokens.shape[:-2]
        return after[0].reshape(*leading, self.out_features), {
            key: value.reshape(*leading, 1, self.out_features)
            for key, value in zip(self.state, after, strict=True)
        }

    def cell(self, x: Tensor, state: list[Tensor]) -> tuple[Tensor, ...]:
        """Reads one step: [N, D] and the state before, [N, E] each -> the state after.

        As single operators: the LSTM and GRU of ONNX Runtime turn NaN into finite numbers.
        """
        raise NotImplementedError

    @property
    def _layers(self) -> nn.Module:
        layers = getattr(self.memory, self.layer_name)
        assert isinstance(layers, nn.Module)
        return layers


class _LSTMModule(LSTMModule):
    """TorchRL's module without a primer: the backbone makes it, for the keys of its tensordict."""

    make_tensordict_primer = property()


class _GRUModule(GRUModule):
    """TorchRL's module without a primer, like :class:`_LSTMModule`."""

    make_tensordict_primer = property()


class LSTM(_TorchRLEncoder):
    """An LSTM over frames: TorchRL's `LSTMModule`.

    With one frame (K = 1), its state is its memory, which :class:`~torchrl_tit.modules.Backbone`
    carries through an episode. With several, the state is zero before the first frame.

    Args:
        settings: size of the state.
        shape: shape of the input.

    Example:
        >>> lstm = LSTM(settings.LSTM(), HistoryShape(num_frames=4, num_tokens=1, width=32))
        >>> lstm(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 64])
    """

    memory_class = _LSTMModule
    layer_name = "lstm"
    state = ("recurrent_state_h", "recurrent_state_c")

    def cell(self, x: Tensor, state: list[Tensor]) -> tuple[Tensor, ...]:
        """See :meth:`_TorchRLEncoder.cell`."""
        return torch.lstm_cell(x, state, *self._layers.parameters())


class GRU(_TorchRLEncoder):
    """A GRU over frames: TorchRL's `GRUModule`.

    Cho et al., "Learning Phrase Representations using RNN Encoder-Decoder for Statistical Machine
    Translation", arXiv 1406.1078, in PyTorch's variant. Its state is handled like that of
    :class:`LSTM`; it has three quarters of the weights.

    Args:
        settings: size of the state.
        shape: shape of the input.

    Example:
        >>> gru = GRU(settings.GRU(), HistoryShape(num_frames=4, num_tokens=1, width=32))
        >>> gru(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 64])
    """

    memory_class = _GRUModule
    layer_name = "gru"
    state = ("recurrent_state_h",)

    def cell(self, x: Tensor, state: list[Tensor]) -> tuple[Tensor, ...]:
        """See :meth:`_TorchRLEncoder.cell`."""
        return (torch.gru_cell(x, *state, *self._layers.parameters()),)

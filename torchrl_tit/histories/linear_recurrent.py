"""Recurrent encoders that read whole sequences at once: minGRU, Gated DeltaNet and Mamba-2."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from tensordict.utils import expand_right
from torch import Tensor, nn
from torch.nn.functional import silu, softplus
from torchrl.modules import recurrent_mode

from torchrl_tit import settings
from torchrl_tit.histories.encoder import HistoryShape, OneToken, RecurrentEncoder, State
from torchrl_tit.layers.linear_recurrences import ShortConvolution, scan_matrices, scan_vectors

_EPS = 1e-5  # of all norms, as in both papers' code
_Entries = list[Tensor]  # of a block's state, in the order of its shapes


class LinearRecurrentEncoder(RecurrentEncoder):
    """Residual blocks with a recurrence that is linear in its state.

        x = x + mixer(RMSNorm(x))      reads this step and the state
        x = x + FFN(RMSNorm(x))        W3 (silu(W1 x) * W2 x), if there is one

    A single step costs the same at any length of the past. A sequence needs no loop over its steps:
    episodes that begin within it are told apart by masks, so it is neither cut nor padded (as
    TorchRL's `LSTMModule` does). The output is the last block's, as wide as a token; the norm that
    usually follows is the head's.

    Args:
        settings: blocks, and size of the state.
        shape: shape of the input.
    """

    mixer: ClassVar[type[_Mixer]]
    """The layer that reads the past."""

    def __init__(self, settings: settings.LinearRecurrentSettings, shape: HistoryShape) -> None:
        super().__init__(shape, out_features=shape.width)
        self.one_token = OneToken(shape)
        mixers = [self.mixer(shape.width, settings) for _ in range(settings.num_blocks)]
        self.blocks = nn.ModuleList(
            _Block(mixer, shape.width, settings.ffn_expansion) for mixer in mixers
        )
        self.state_shapes = {
            key: torch.Size([settings.num_blocks, *size])
            for key, size in mixers[0].state_shapes.items()
        }

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K frames, float [..., K, L, D] -> those after the last, float [..., D]."""
        x = self.one_token(tokens)  # [..., K, D]
        sequences = x.reshape(-1, *x.shape[-2:])
        state = {
            key: x.new_zeros(sequences.shape[0], *size) for key, size in self.state_shapes.items()
        }
        is_init = torch.zeros(sequences.shape[:2], dtype=torch.bool, device=x.device)
        outputs, _ = self.read(sequences, state, is_init)
        return outputs[:, -1].reshape(*x.shape[:-2], self.out_features)

    def step(self, tokens: Tensor, state: State, is_init: Tensor) -> tuple[Tensor, State]:
        """Tokens float [*B, L, D] and the state before -> float [*B, D] and the state after.

        In a sequence, the state after its last step stands at every step.
        """
        batch = tokens.shape[:-2]
        length = batch[-1] if recurrent_mode() else 1
        x = self.one_token(tokens).reshape(-1, length, self.out_features)
        shapes = self.state_shapes
        before = {key: state[key].reshape(-1, length, *shapes[key])[:, 0] for key in shapes}
        outputs, after = self.read(x, before, is_init.reshape(-1, length))
        return outputs.reshape(*batch, self.out_features), {
            key: value.unsqueeze(1).expand(-1, length, *shapes[key]).reshape(*batch, *shapes[key])
            for key, value in after.items()
        }

    def read(self, x: Tensor, state: State, is_init: Tensor) -> tuple[Tensor, State]:
        """Reads sequences, float [N, T, D].

        Args:
            x: one token of each step.
            state: the state before the first step, float [N, num_blocks, ...] each.
            is_init: bool [N, T], True where an episode begins.

        Returns:
            float [N, T, D], and the state after the last step.
        """
        begins, states = is_init[:, 0], []
        state = {  # a NaN of the last episode times 0 would be NaN
            key: x.masked_fill(expand_right(begins, x.shape), 0) for key, x in state.items()
        }
        for index, block in enumerate(self.blocks):
            before = [state[key][:, index] for key in self.state_shapes]
            x, after = block(x, before, is_init)
            states.append(after)
        stacked = (torch.stack(entry, dim=1) for entry in zip(*states, strict=True))
        return x, dict(zip(self.state_shapes, stacked, strict=True))


class _Mixer(nn.Module):
    """A layer that reads the past: ``mixer(x, state, is_init) -> (x, state)``, x [N, T, D]."""

    state_shapes: dict[str, tuple[int, ...]]
    """Shape of each entry of its state, without the batch."""


class _Block(nn.Module):
    """A mixer and, if ``ffn_expansion`` is not 0, a gated FFN, both on residuals."""

    def __init__(self, mixer: _Mixer, width: int, ffn_expansion: int) -> None:
        super().__init__()
        self.norm1, self.mixer = nn.RMSNorm(width, eps=_EPS), mixer
        hidden, self.has_ffn = ffn_expansion * width, ffn_expansion > 0
        if self.has_ffn:
            self.norm2 = nn.RMSNorm(width, eps=_EPS)
            self.gate_and_value = nn.Linear(width, 2 * hidden, bias=False)
            self.output = nn.Linear(hidden, width, bias=False)

    def forward(self, x: Tensor, state: _Entries, is_init: Tensor) -> tuple[Tensor, _Entries]:
        mixed, state = self.mixer(self.norm1(x), state, is_init)
        x = x + mixed
        if self.has_ffn:
            gate, value = self.gate_and_value(self.norm2(x)).chunk(2, dim=-1)
            x = x + self.output(silu(gate) * value)
        return x, state


class _MinGRUMixer(_Mixer):
    """See :class:`MinGRU`."""

    def __init__(self, width: int, settings: settings.MinGRU) -> None:
        super().__init__()
        hidden = settings.expansion * width
        self.state_shapes = {"recurrent_state_h": (hidden,)}
        self.gate = nn.Linear(width, hidden, bias=False)
        self.gate_bias = nn.Parameter(torch.empty(hidden))
        self.candidate = nn.Linear(width, hidden)
        self.output = nn.Linear(hidden, width, bias=False)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        with torch.no_grad():
            self.gate_bias.copy_(_rates(len(self.gate_bias)).logit())

    def forward(self, x: Tensor, state: _Entries, is_init: Tensor) -> tuple[Tensor, _Entries]:
        rate = (self.gate(x) + self.gate_bias).sigmoid()  # z, [N, T, H]
        decay = (1 - rate).masked_fill(is_init.unsqueeze(-1), 0)
        states = scan_vectors(decay, rate * self.candidate(x), state[0])
        return self.output(states), [states[:, -1]]


class MinGRU(LinearRecurrentEncoder):
    """minGRU over frames: a GRU whose gate does not read the state.

        h_t = (1 - z_t) * h_{t-1} + z_t * (W_h x_t + b_h)      z_t = sigmoid(W_z x_t + b_z)

    Feng et al., "Were RNNs All We Needed?", arXiv 2410.01201, section 3.1. The sum over the past is
    taken with the decays themselves, not with their logarithms, so the candidate may be negative.
    The biases of the gate start so that the entries of a state forget over 2 to 1,000 steps.

    Args:
        settings: blocks, and size of the state.
        shape: shape of the input.

    Example:
        >>> memory = MinGRU(settings.MinGRU(), HistoryShape(num_frames=1, num_tokens=1, width=32))
        >>> state = {key: torch.zeros(8, *size) for key, size in memory.state_shapes.items()}
        >>> output, state = memory.step(torch.randn(8, 1, 32), state, torch.ones(8, 1).bool())
        >>> output.shape, state["recurrent_state_h"].shape
        (torch.Size([8, 32]), torch.Size([8, 2, 64]))
    """

    mixer = _MinGRUMixer


class _MatrixMixer(_Mixer):
    """What the mixers whose state is a matrix for each head share.

    Args:
        width: width D of a token.
        settings: heads, and sizes of keys and values.
        keys: number of keys and queries of the convolution.
        bias: whether the convolution has one.
    """

    def __init__(
        self, width: int, settings: settings.MatrixMemorySettings, *, keys: int, bias: bool = False
    ) -> None:
        super().__init__()
        heads, values = settings.num_heads, settings.num_heads * settings.value_dim
        self.num_heads, self.key_dim = heads, settings.key_dim
        self.sizes = [values, values + keys * settings.key_dim, heads]
        self.inputs = nn.Linear(width, sum(self.sizes), bias=False)
        self.convolution = ShortConvolution(self.sizes[1], bias=bias)
        self.state_shapes = {
            "recurrent_state_h": (heads, settings.key_dim, settings.value_dim),
            "recurrent_state_inputs": self.convolution.state_shape,
        }
        self.rate_bias = nn.Parameter(torch.empty(heads))
        self.log_a = nn.Parameter(torch.empty(heads))
        self.output = nn.Linear(values, width, bias=False)

    def reset_parameters(self) -> None:
        # The rates start at 0.5, also those of slow heads, which would otherwise hardly be written.
        nn.init.constant_(self.rate_bias, math.log(math.expm1(0.5)))
        with torch.no_grad():
            self.log_a.copy_((_rates(self.num_heads) / 0.5).log())

    def rates(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """[N, T, H] -> softplus(x + bias), and minus the decay's logarithm, [N, H, T] each."""
        rate = softplus(x + self.rate_bias).mT
        return rate, -self.log_a.exp().unsqueeze(-1) * rate

    def heads(self, x: Tensor) -> Tensor:
        """[N, T, H * size] -> [N, H, T, size]."""
        return x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)


class _GatedDeltaMixer(_MatrixMixer):
    """See :class:`GatedDeltaNet`."""

    def __init__(self, width: int, settings: settings.GatedDeltaNet) -> None:
        heads = settings.num_heads
        super().__init__(width, settings, keys=2 * heads)
        self.beta = nn.Linear(width, heads, bias=False)
        self.norm = nn.RMSNorm(settings.value_dim, eps=_EPS)
        self.reset_parameters()

    def forward(self, x: Tensor, state: _Entries, is_init: Tensor) -> tuple[Tensor, _Entries]:
        memory, before = state
        beta = self.beta(x).sigmoid().mT
        gate, x, rate = self.inputs(x).split(self.sizes, dim=-1)
        x, before = self.convolution(x, before, is_init)
        keys = self.num_heads * self.key_dim
        query, key, value = map(self.heads, x.split([keys, keys, x.shape[-1] - 2 * keys], dim=-1))
        _, log_decay = self.rates(rate)
        query, key = _unit(query) * self.key_dim**-0.5, _unit(key)
        output, memory = scan_matrices(query, key, value, log_decay, is_init, memory, beta)
        output = self.norm(output).transpose(1, 2).flatten(-2) * silu(gate)
        return self.output(output), [memory, before]


class GatedDeltaNet(LinearRecurrentEncoder):
    """Gated DeltaNet over frames: a memory from keys to values that replaces what it holds.

        S_t = a_t S_{t-1} + beta_t k_t (v_t - a_t S_{t-1}^T k_t)^T        [K, V] for each head
        o_t = W_o (RMSNorm(S_t^T q_t) * silu(W_g x_t))
        a_t = exp(-A softplus(W_a x_t + b_a)),  beta_t = sigmoid(W_b x_t)

    q, k and v are projections of x through a convolution over four steps and SiLU; q and k have
    length 1 (q then 1 / sqrt(K)). Yang et al., "Gated Delta Networks: Improving Mamba2 with Delta
    Rule", arXiv 2412.06464, section 3 and figure 1. The softplus starts at 0.5, and A so that the
    heads forget over 2 to 1,000 steps, evenly spaced (in the paper, which has many heads, both are
    drawn at random).

    Args:
        settings: blocks, heads, and sizes of keys and values.
        shape: shape of the input.

    Example:
        >>> shape = HistoryShape(num_frames=4, num_tokens=1, width=32)
        >>> GatedDeltaNet(settings.GatedDeltaNet(), shape)(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 32])
    """

    mixer = _GatedDeltaMixer


class _Mamba2Mixer(_MatrixMixer):
    """See :class:`Mamba2`."""

    def __init__(self, width: int, settings: settings.Mamba2) -> None:
        super().__init__(width, settings, keys=2, bias=True)
        self.skip = nn.Parameter(torch.empty(settings.num_heads))
        self.norm = nn.RMSNorm(settings.num_heads * settings.value_dim, eps=_EPS)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        super().reset_parameters()
        nn.init.ones_(self.skip)

    def forward(self, x: Tensor, state: _Entries, is_init: Tensor) -> tuple[Tensor, _Entries]:
        memory, before = state
        gate, x, rate = self.inputs(x).split(self.sizes, dim=-1)
        x, before = self.convolution(x, before, is_init)
        x, key, query = x.split([gate.shape[-1], self.key_dim, self.key_dim], dim=-1)
        value = self.heads(x)
        rate, log_decay = self.rates(rate)
        output, memory = scan_matrices(
            query.unsqueeze(1),  # one for all heads
            key.unsqueeze(1),
            value * rate.unsqueeze(-1),
            log_decay,
            is_init,
            memory,
        )
        output = output + self.skip[:, None, None] * value
        output = self.norm(output.transpose(1, 2).flatten(-2) * silu(gate))
        return self.output(output), [memory, before]


class Mamba2(LinearRecurrentEncoder):
    """Mamba-2 over frames: a state space whose decay, input and output depend on the step.

        S_t = exp(-A r_t) S_{t-1} + r_t B_t x_t^T        [N, P] for each head
        y_t = W_o RMSNorm((S_t^T C_t + D x_t) * silu(W_z u_t))
        r_t = softplus(W_r u_t + b_r)

    x, B and C are projections of the input u through a convolution over four steps and SiLU; B and
    C are shared by all heads. Dao and Gu, "Transformers are SSMs", arXiv 2405.21060, sections 6 and
    7. ``key_dim`` and ``value_dim`` are the paper's N and P. Rates and A start as in
    :class:`GatedDeltaNet`.

    Args:
        settings: blocks, heads, and sizes of keys and values.
        shape: shape of the input.

    Example:
        >>> shape = HistoryShape(num_frames=4, num_tokens=1, width=32)
        >>> Mamba2(settings.Mamba2(), shape)(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 32])
    """

    mixer = _Mamba2Mixer


def _unit(x: Tensor) -> Tensor:
    """Scales vectors to length 1, or less if they are shorter than about 0.001."""
    return x * (x.square().sum(-1, keepdim=True) + 1e-6).rsqrt()


def _rates(count: int) -> Tensor:
    """Rates of forgetting from one in a thousand to a half of the state at a step, [count]."""
    return torch.logspace(-3, -0.301, count)

"""Recurrences that are linear in their state, step by step and over whole sequences at once.

In all of them, the state is 0 before a step at which an episode begins (``is_init``). Over
sequences this is a mask: what lies in another episode has a weight of exactly 0, and no gradient.
So finite numbers of another episode have no effect, but NaN and infinity spread.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

_KERNEL = 4  # steps that the convolutions of both papers read


def scan_vectors(decay: Tensor, values: Tensor, state: Tensor) -> Tensor:
    """Computes h_t = decay_t * h_{t-1} + values_t for all steps, in log2(T) passes.

    Each pass doubles the number of steps that are summed up (Hillis and Steele, "Data Parallel
    Algorithms", 1986). A single step takes none.

    Args:
        decay: float [N, T, H], in [0, 1]; 0 where an episode begins.
        values: float [N, T, H].
        state: the state h_0 before the first step, float [N, H].

    Returns:
        The states after each step, float [N, T, H].

    Example:
        >>> decay, values = torch.tensor([[[0.5], [0.0], [0.5]]]), torch.ones(1, 3, 1)
        >>> scan_vectors(decay, values, torch.full((1, 1), 4.0)).flatten().tolist()
        [3.0, 1.0, 1.5]
    """
    first = values[:, :1] + decay[:, :1] * state.unsqueeze(1)
    states, reach = torch.cat([first, values[:, 1:]], dim=1), 1
    while reach < states.shape[1]:
        later = states[:, reach:] + decay[:, reach:] * states[:, :-reach]
        states = torch.cat([states[:, :reach], later], dim=1)
        decay = torch.cat([decay[:, :reach], decay[:, reach:] * decay[:, :-reach]], dim=1)
        reach *= 2
    return states


def scan_matrices(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    log_decay: Tensor,
    is_init: Tensor,
    state: Tensor,
    beta: Tensor | None = None,
    *,
    chunk: int = 64,
) -> tuple[Tensor, Tensor]:
    """Reads and writes a matrix of associations from keys to values, for each of H heads.

        S_t = a_t S_{t-1} + k_t v_t^T                                       without beta
        S_t = a_t S_{t-1} + beta_t k_t (v_t - a_t S_{t-1}^T k_t)^T          the gated delta rule
        o_t = S_t^T q_t

    The first is Mamba-2's recurrence (Dao and Gu, arXiv 2405.21060, section 6, where k, v and q are
    called B, x and C). The second (Yang et al., arXiv 2412.06464, section 3) replaces the share
    beta of the value that is stored under a key. A sequence is read in chunks, by matrix products:
    with g_i for the sum of log a within a chunk up to its step i, and S for the state before it,

        D_ij = exp(g_i - g_j) if j <= i and step j is of the episode of step i, else 0
        u_i  = v_i, or beta_i (v_i - exp(g_i) S^T k_i - sum over j < i of D_ij (k_i k_j) u_j)
        o_i  = exp(g_i) S^T q_i + sum over j of D_ij (q_i k_j) u_j
        S    <- exp(g_C) S + sum over j of D_Cj k_j u_j^T

    where the terms of S are left out once an episode has begun. The triangular system of u is the
    WY form of arXiv 2406.06484. A single step follows the formulas above.

    Args:
        query: q, float [N, H or 1, T, K].
        key: k, float [N, H or 1, T, K]; of length 1 for the delta rule.
        value: v, float [N, H, T, V].
        log_decay: log a, float [N, H, T], at most 0.
        is_init: bool [N, T], True where an episode begins.
        state: S before the first step, float [N, H, K, V].
        beta: float [N, H, T] in [0, 1].
        chunk: steps of a chunk; it changes the result only by rounding.

    Returns:
        The outputs o, float [N, H, T, V], and the state after the last step, [N, H, K, V].

    Example:
        >>> key = nn.functional.normalize(torch.randn(2, 1, 100, 8), dim=-1)
        >>> output, state = scan_matrices(
        ...     query=key, key=key, value=torch.randn(2, 3, 100, 4),
        ...     log_decay=torch.zeros(2, 3, 100), beta=torch.ones(2, 3, 100),
        ...     is_init=torch.zeros(2, 100, dtype=torch.bool), state=torch.zeros(2, 3, 8, 4),
        ... )
        >>> output.shape, state.shape
        (torch.Size([2, 3, 100, 4]), torch.Size([2, 3, 8, 4]))
    """
    log_decay = log_decay.unsqueeze(-1)
    beta = None if beta is None else beta.unsqueeze(-1)
    if value.shape[2] == 1:
        return _read_step(query, key, value, log_decay, beta, is_init, state)
    outputs = []
    for start in range(0, value.shape[2], chunk):
        part = slice(start, start + chunk)
        output, state = _read_chunk(
            query[:, :, part],
            key[:, :, part],
            value[:, :, part],
            log_decay[:, :, part],
            None if beta is None else beta[:, :, part],
            is_init[:, part],
            state,
        )
        outputs.append(output)
    return torch.cat(outputs, dim=2), state


def _read_step(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    log_decay: Tensor,
    beta: Tensor | None,
    is_init: Tensor,
    state: Tensor,
) -> tuple[Tensor, Tensor]:
    """Reads one step: see :func:`scan_matrices`."""
    state = (state * log_decay.exp()).masked_fill(is_init[:, :, None, None], 0)
    if beta is not None:
        value = beta * (value - key @ state)
    state = state + key.mT @ value
    return query @ state, state


def _read_chunk(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    log_decay: Tensor,
    beta: Tensor | None,
    is_init: Tensor,
    state: Tensor,
) -> tuple[Tensor, Tensor]:
    """Reads C steps: see :func:`scan_matrices`."""
    episode = is_init.cumsum(1)  # [N, C]; 0 is the episode of the state
    same = (episode.unsqueeze(-1) == episode.unsqueeze(-2)).tril().unsqueeze(1)  # [N, 1, C, C]
    # A difference of two sums would depend, by rounding, on steps before both.
    between = log_decay.expand(-1, -1, -1, log_decay.shape[2]).tril(-1).cumsum(2)  # [N, H, C, C]
    decay = between.masked_fill(~same, -math.inf).exp()
    carried = log_decay.cumsum(2).exp() * (episode == 0)[:, None, :, None]  # [N, H, C, 1]
    if beta is not None:
        rest = beta * (value - carried * (key @ state))
        overlap = beta * decay * (key @ key.mT)  # below the diagonal; the rest is not read
        full = torch.promote_types(rest.dtype, torch.float32)  # it solves in no smaller type
        value = torch.linalg.solve_triangular(
            overlap.to(full), rest.to(full), upper=False, unitriangular=True
        ).to(rest.dtype)
    output = carried * (query @ state) + (decay * (query @ key.mT)) @ value
    state = carried[:, :, -1:] * state + (key * decay[:, :, -1].unsqueeze(-1)).mT @ value
    return output, state


class ShortConvolution(nn.Module):
    """A causal convolution of each channel over the last four steps of an episode, then SiLU.

    Args:
        channels: number C of channels.
        bias: whether it has one.

    Example:
        >>> x, is_init = torch.randn(2, 7, 8), torch.zeros(2, 7, dtype=torch.bool)
        >>> convolution = ShortConvolution(8)
        >>> output, last = convolution(x, torch.zeros(2, *convolution.state_shape), is_init)
        >>> output.shape, last.shape
        (torch.Size([2, 7, 8]), torch.Size([2, 3, 8]))
    """

    def __init__(self, channels: int, *, bias: bool = False) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(channels, _KERNEL))
        self.bias = nn.Parameter(torch.empty(channels)) if bias else None
        self.state_shape = (_KERNEL - 1, channels)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes the weights as in `nn.Conv1d`, and the bias with 0."""
        nn.init.uniform_(self.weight, -(_KERNEL**-0.5), _KERNEL**-0.5)
        if self.bias is not None:
            nn.init.zeros_(self.bias)

    def forward(self, x: Tensor, before: Tensor, is_init: Tensor) -> tuple[Tensor, Tensor]:
        """Convolves sequences.

        Args:
            x: float [N, T, C].
            before: the three steps before them, float [N, 3, C].
            is_init: bool [N, T], True where an episode begins.

        Returns:
            float [N, T, C], and the last three steps, those of earlier episodes as zeros.
        """
        length = x.shape[1]
        x = torch.cat([before, x], dim=1)
        episode = nn.functional.pad(is_init.cumsum(1), (_KERNEL - 1, 0))  # 0 is that of `before`
        newest = episode[:, _KERNEL - 1 :]
        output = torch.zeros_like(x[:, :length]) if self.bias is None else self.bias
        for tap in range(_KERNEL):
            steps = slice(tap, tap + length)
            other = (episode[:, steps] != newest).unsqueeze(-1)
            output = output + self.weight[:, tap] * x[:, steps].masked_fill(other, 0)
        other = (episode[:, length:] != episode[:, -1:]).unsqueeze(-1)
        return nn.functional.silu(output), x[:, length:].masked_fill(other, 0)

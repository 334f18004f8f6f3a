"""minGRU, Gated DeltaNet and Mamba-2: one step after the other, and sequences at once."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from tests.networks.reference import randomize
from torchrl_tit import settings
from torchrl_tit.histories import HistoryShape
from torchrl_tit.histories.linear_recurrent import LinearRecurrentEncoder
from torchrl_tit.layers.linear_recurrences import scan_matrices, scan_vectors
from torchrl_tit.settings import HistorySettings

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

N, T, D = 3, 23, 6
MATRICES: dict[str, Any] = {"num_heads": 2, "key_dim": 4, "value_dim": 3}
MEMORIES: dict[str, HistorySettings] = {
    "mingru": settings.MinGRU(),
    "gated-deltanet": settings.GatedDeltaNet(**MATRICES),
    "mamba2": settings.Mamba2(**MATRICES),
}
every_memory = pytest.mark.parametrize("name", MEMORIES)
State = dict[str, Tensor]


def build(name: str, tokens: int = 1, frames: int = 1) -> LinearRecurrentEncoder:
    shape = HistoryShape(num_frames=frames, num_tokens=tokens, width=D)
    encoder = MEMORIES[name].build(shape)
    randomize(encoder)
    return encoder


@every_memory
@pytest.mark.parametrize("length", [1, T])
def test_a_state_that_is_not_read_may_be_nan(name: str, length: int) -> None:
    encoder = build(name)
    tokens, state, is_init = draw(encoder)
    tokens, is_init = tokens[:, :length], is_init[:, :length]
    is_init[:, 0] = True
    lost = {key: torch.full_like(x, torch.nan) for key, x in state.items()}
    outputs, after = read(encoder, tokens, lost, is_init)
    expected, expected_after = read(encoder, tokens, state, is_init)
    assert torch.equal(outputs, expected)
    for key, x in after.items():
        assert torch.equal(x, expected_after[key])


def mixer_of(encoder: LinearRecurrentEncoder) -> Any:
    """The layer of its first block that reads the past."""
    return encoder.blocks[0].mixer


def draw(encoder: LinearRecurrentEncoder) -> tuple[Tensor, State, Tensor]:
    """Tokens, states before the first step, and where episodes begin: first, last, in a row."""
    is_init = torch.rand(N, T, 1) < 0.2
    is_init[0], is_init[1, [0, 1, 7, T - 1]], is_init[2, 0] = False, True, False
    state = {key: torch.randn(N, *size) for key, size in encoder.state_shapes.items()}
    return torch.randn(N, T, 1, D), state, is_init


def read(encoder: LinearRecurrentEncoder, tokens: Tensor, state: State, is_init: Tensor) -> Any:
    """Reads sequences at once, from the state before their first steps."""
    length = tokens.shape[1]
    given = {key: x.unsqueeze(1).expand(-1, length, *x.shape[1:]) for key, x in state.items()}
    with set_recurrent_mode(True):
        outputs, after = encoder.step(tokens, given, is_init)
    return outputs, {key: x[:, -1] for key, x in after.items()}


def walk(encoder: LinearRecurrentEncoder, tokens: Tensor, state: State, is_init: Tensor) -> Any:
    """Reads one step after the other."""
    outputs = []
    for t in range(tokens.shape[1]):
        output, state = encoder.single_step(tokens[:, t], state, is_init[:, t])
        outputs.append(output)
    return torch.stack(outputs, 1), state


def near(actual: Any, expected: Any) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-9)


@every_memory
def test_sequences_equal_single_steps_with_gradients_and_states(name: str) -> None:
    encoder = build(name)
    tokens, state, is_init = draw(encoder)
    leaves = [tokens, *state.values(), *encoder.parameters()]
    for leaf in leaves:
        leaf.requires_grad_()
    found = []
    for reader in (read, walk):
        outputs, after = reader(encoder, tokens, state, is_init)
        total = outputs.square().sum() + sum(x.sin().sum() for x in after.values())
        found.append((outputs, after, torch.autograd.grad(total, leaves)))
    near(*found)
    assert all(gradient.abs().max() > 1e-6 for gradient in found[0][2])


@every_memory
def test_a_cut_changes_nothing_if_the_state_is_carried_over_it(name: str) -> None:
    encoder = build(name)
    tokens, state, is_init = draw(encoder)
    whole, last = read(encoder, tokens, state, is_init)
    for cut in (1, 2, 10):
        first, after = read(encoder, tokens[:, :cut], state, is_init[:, :cut])
        second, after = read(encoder, tokens[:, cut:], after, is_init[:, cut:])
        near((torch.cat([first, second], 1), after), (whole, last))


@every_memory
def test_a_step_sees_its_own_episode_up_to_itself_and_nothing_else(name: str) -> None:
    """Exactly: other steps can be anything, and no gradient reaches them."""
    encoder = build(name)
    tokens, state, _ = draw(encoder)
    is_init = torch.zeros(N, T, 1, dtype=torch.bool)
    is_init[:, 6] = True
    tokens.requires_grad_()
    expected, _ = read(encoder, tokens, state, is_init)
    (gradient,) = torch.autograd.grad(expected[:, 15].sum(), tokens)
    seen = gradient.flatten(2).abs().sum(-1).ne(0)
    assert seen[:, 6:16].all()
    assert not seen[:, :6].any()
    assert not seen[:, 16:].any()
    other = tokens.detach().clone()
    other[:, :6] = 100 * torch.randn(N, 6, 1, D)
    other[:, 16:] = 100 * torch.randn(N, T - 16, 1, D)
    others = {key: 100 * torch.randn_like(x) for key, x in state.items()}
    near(read(encoder, other, others, is_init)[0][:, 6:16], expected[:, 6:16])


@every_memory
def test_several_frames_are_read_from_a_state_of_zeros(name: str) -> None:
    encoder = build(name, tokens=2, frames=5)
    tokens = torch.randn(2, N, 5, 2, D)
    zeros = {key: torch.zeros(2 * N, *size) for key, size in encoder.state_shapes.items()}
    outputs, _ = walk(encoder, tokens.flatten(0, 1), zeros, torch.zeros(2 * N, 5, 1).bool())
    near(encoder(tokens), outputs[:, -1].unflatten(0, (2, N)))


@pytest.mark.parametrize("delta", [False, True])
def test_the_size_of_a_chunk_does_not_matter(delta: bool) -> None:
    heads = 2
    query, key = torch.randn(2, N, 1, T, 4)
    key = nn.functional.normalize(key, dim=-1)
    value, log_decay = torch.randn(N, heads, T, 3), -3 * torch.rand(N, heads, T)
    beta = torch.rand(N, heads, T) if delta else None
    is_init = torch.rand(N, T) < 0.1
    steps = (query, key, value, log_decay, is_init, torch.randn(N, heads, 4, 3), beta)
    expected = scan_matrices(*steps, chunk=T)
    for chunk in (1, 4, 7, 22, 100):
        near(scan_matrices(*steps, chunk=chunk), expected)


def test_long_sequences_neither_overflow_nor_lose_what_is_kept() -> None:
    """Where decays differ by hundreds of orders of magnitude, in float32."""
    decay = torch.tensor([1.0, 1e-30]).float().repeat(300).view(1, -1, 1)
    ones = torch.ones(1, 600, 1).float()
    states = scan_vectors(decay, ones, ones[:, 0])
    assert states.isfinite().all()
    near(states[0, -2:, 0], torch.tensor([2.0, 1.0]).float())
    log_decay = torch.tensor([0.0, -200.0]).float().repeat(300).view(1, 1, -1)
    key, value = ones.unsqueeze(1), ones.unsqueeze(1)
    is_init, state = torch.zeros(1, 600).bool(), ones[:, :1, None]
    outputs, state = scan_matrices(key, key, value, log_decay, is_init, state)
    near(outputs[0, 0, -2:, 0], torch.tensor([2.0, 1.0]).float())


def test_mingru_is_the_papers() -> None:
    mixer = mixer_of(build("mingru"))
    x, state = torch.randn(N, T, D), torch.randn(N, 2 * D)
    h, expected = state, []
    for t in range(T):
        z = torch.sigmoid(mixer.gate(x[:, t]) + mixer.gate_bias)
        h = (1 - z) * h + z * mixer.candidate(x[:, t])
        expected.append(mixer.output(h))
    near(mixer(x, [state], torch.zeros(N, T).bool())[0], torch.stack(expected, 1))


def of_transformers(name: str) -> tuple[Any, dict[str, str]]:
    """That library's layer of the same sizes, and the names of its weights here."""
    # Not at the top: it takes seconds to import.
    if name == "mamba2":
        from transformers.models.mamba2.modeling_mamba2 import Mamba2Config, Mamba2Mixer

        config = Mamba2Config(
            hidden_size=D, num_heads=2, head_dim=3, expand=1, state_size=4, n_groups=1, chunk_size=8
        )
        return Mamba2Mixer(config, layer_idx=0), {
            "skip": "D",
            "inputs.weight": "in_proj.weight",
            "norm.weight": "norm.weight",
        }
    from transformers.models.olmo_hybrid import modeling_olmo_hybrid as olmo

    sizes = olmo.OlmoHybridConfig(
        hidden_size=D,
        linear_num_value_heads=2,
        linear_num_key_heads=2,
        linear_key_head_dim=4,
        linear_value_head_dim=3,
        linear_allow_neg_eigval=False,
    )
    parts = [f"{part}_proj.weight" for part in ("g", "q", "k", "v", "a")]
    return olmo.OlmoHybridGatedDeltaNet(sizes, layer_idx=0), {
        "beta.weight": "b_proj.weight",
        "inputs.weight": " ".join(parts),
        "norm.weight": "o_norm.weight",
    }


@pytest.mark.parametrize("name", ["gated-deltanet", "mamba2"])
def test_layers_are_those_of_transformers(name: str) -> None:
    layer, names = of_transformers(name)
    randomize(layer)
    names |= {"log_a": "A_log", "rate_bias": "dt_bias", "convolution.weight": "conv1d.weight"}
    names |= {"output.weight": "out_proj.weight" if name == "mamba2" else "o_proj.weight"}
    if name == "mamba2":
        names["convolution.bias"] = "conv1d.bias"
    theirs, mixer = layer.state_dict(), mixer_of(build(name))
    weights = {ours: torch.cat([theirs[x] for x in of.split()]) for ours, of in names.items()}
    weights["convolution.weight"] = weights["convolution.weight"].squeeze(1)
    mixer.load_state_dict(weights)
    x = torch.randn(N, T, D)
    state = [torch.zeros(N, *size) for size in mixer.state_shapes.values()]
    output, _ = mixer(x, state, torch.zeros(N, T).bool())
    # Theirs is in float32.
    torch.testing.assert_close(output, layer.eval()(x).double(), rtol=0, atol=1e-5)


@every_memory
def test_a_new_memory_forgets_over_short_and_long_spans(name: str) -> None:
    mixer = mixer_of(MEMORIES[name].build(HistoryShape(num_frames=1, num_tokens=1, width=D)))
    if name == "mingru":
        rates = mixer.gate_bias.sigmoid()
    else:
        rates = nn.functional.softplus(mixer.rate_bias) * mixer.log_a.exp()
    near(rates, torch.logspace(-3, -0.301, len(rates)))

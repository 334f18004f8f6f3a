"""Decision Transformer: its behavior beyond equality with the reference in tests/interop."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.networks.reference import randomize
from torchrl_tit.histories.decision_transformer import DecisionTransformer as Encoder
from torchrl_tit.modules import DTHead
from torchrl_tit.modules.decision_transformer import ActionSpace
from torchrl_tit.networks import DTTIT, DecisionTransformer, HistoryNetwork

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


@dataclass(frozen=True)
class Case:
    observation_shape: tuple[int, ...]
    network: type[DecisionTransformer | DTTIT]
    action_space: ActionSpace = "continuous"
    options: dict[str, Any] = field(default_factory=dict)


CASES: dict[str, Case] = {
    "dt": Case((11,), DecisionTransformer),
    "dt_tit": Case((11,), DTTIT),
    "dt on images": Case((3, 8, 8), DecisionTransformer),
    "dt_tit on images": Case((8, 8), DTTIT, options={"patch_size": 4, "position_encoding": True}),
    "discrete": Case((11,), DecisionTransformer, "discrete"),
    "no time": Case((11,), DecisionTransformer, options={"timestep_embedding": False}),
}
every_case = pytest.mark.parametrize("case", CASES)
SMALL: dict[str, Any] = {"embed_dim": 16, "num_heads": 2, "num_blocks": 2, "max_ep_len": 30}


class Predictor(nn.Module):
    """The action of every step."""

    def __init__(self, network: HistoryNetwork, head: DTHead) -> None:
        super().__init__()
        self.network, self.head = network, head

    @property
    def encoder(self) -> Encoder:
        encoder = self.network.history_encoder
        assert isinstance(encoder, Encoder)
        return encoder

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.head(self.network.every_frame(*inputs))


def make(case: str, seed: int = 0, **hyperparameters: Any) -> Predictor:
    """In double precision, so that what must be equal is equal on any processor."""
    the = CASES[case]
    network = the.network(
        the.observation_shape, action_dim=3, **{**SMALL, **the.options, **hyperparameters}
    )
    predictor = Predictor(network, DTHead(network.features_dim, 3, the.action_space))
    randomize(predictor, seed)
    return predictor.double().eval()


def make_inputs(case: str, *leading: int, steps: int = 5) -> list[Tensor]:
    shape = CASES[case].observation_shape
    torch.manual_seed(7)
    if len(shape) > 1:
        states = torch.randint(0, 256, (*leading, steps, *shape), dtype=torch.uint8)
    else:
        states = torch.randn(*leading, steps, *shape, dtype=torch.float64)
    if CASES[case].action_space == "discrete":
        actions = nn.functional.one_hot(torch.randint(3, (*leading, steps)), 3)
    else:
        actions = torch.rand(*leading, steps, 3, dtype=torch.float64) * 2 - 1
    returns_to_go = torch.rand(*leading, steps, 1, dtype=torch.float64)
    timesteps = torch.arange(steps).expand(*leading, steps)
    return [states, actions, returns_to_go, timesteps]


@every_case
def test_padding_is_not_seen_and_stays_finite(case: str) -> None:
    predictor, inputs = make(case), make_inputs(case, 3)
    mask = torch.tensor([[1, 1, 1, 1, 1], [0, 0, 1, 1, 1], [0, 0, 0, 0, 0]])
    actions = predictor(*inputs, mask)
    assert actions.isfinite().all()
    torch.testing.assert_close(actions[0], predictor(*inputs)[0])
    shorter = predictor(*(x[1:2, 2:] for x in inputs))
    torch.testing.assert_close(actions[1, 2:], shorter[0])
    padding = [torch.where(mask.view(3, 5, *[1] * (x.ndim - 2)) == 0, 1, x) for x in inputs]
    torch.testing.assert_close(predictor(*padding, mask.bool())[mask == 1], actions[mask == 1])

    predictor.train()
    predictor(*inputs, mask)[mask == 1].sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in predictor.parameters())


@every_case
def test_the_newest_step_alone_equals_the_last_of_all(case: str) -> None:
    predictor, inputs = make(case), make_inputs(case, 2)
    network, (states, *others) = predictor.network, inputs
    mask = torch.tensor([[0, 1, 1, 1, 1], [1, 1, 1, 1, 1]])
    features = network(*inputs, mask)
    assert features.shape == (2, network.features_dim)
    torch.testing.assert_close(predictor.head(features), predictor(*inputs, mask)[:, -1])
    # A state's tokens depend on that state alone, so they can be kept.
    tokens = network.encode_frames(states)
    one_by_one = [network.encode_frames(states[:, k : k + 1]) for k in range(5)]
    torch.testing.assert_close(torch.cat(one_by_one, 1), tokens)
    torch.testing.assert_close(network.encode_history(tokens, *others, mask), features)


def test_action_heads() -> None:
    continuous = make("dt")(*make_inputs("dt", 4)).abs()
    assert continuous.max() < 1
    predictor, inputs = make("discrete"), make_inputs("discrete", 4)
    linear = predictor.head.get_submodule("layers.0")
    features = predictor.network.every_frame(*inputs)
    torch.testing.assert_close(predictor(*inputs), linear(features))  # logits as they are


def test_discrete_actions_are_read_as_integers_or_one_hot() -> None:
    predictor, (states, actions, *others) = make("discrete"), make_inputs("discrete", 4)
    expected = predictor(states, actions, *others)
    for same in (actions.bool(), actions.argmax(-1)):
        assert torch.equal(predictor(states, same, *others), expected)
    # Padding is negative: a vector of zeros.
    nothing = actions.argmax(-1).clone()
    nothing[:, 1], actions[:, 1] = -10, 0
    assert torch.equal(
        predictor(states, nothing, *others), predictor(states, actions.double(), *others)
    )


def test_time_steps_matter_unless_switched_off() -> None:
    for case, matters in (("dt", True), ("no time", False)):
        predictor, inputs = make(case), make_inputs(case, 2)
        later = predictor(*inputs[:3], inputs[3] + 7)
        assert torch.allclose(later, predictor(*inputs)) != matters


def test_gpt2_blocks_start_as_gpt2_and_the_rest_as_pytorch() -> None:
    torch.manual_seed(0)
    network = DecisionTransformer((11,), action_dim=3)
    encoder = network.history_encoder
    assert isinstance(encoder, Encoder)
    for name, parameter in encoder.blocks.named_parameters():
        if "norm" in name:
            assert (parameter == float(name.endswith("weight"))).all()
        elif name.endswith("bias"):
            assert not parameter.any()
        else:
            assert abs(parameter.std().item() - 0.02) < 1e-3
    assert encoder.timestep_embedding is not None
    assert abs(encoder.timestep_embedding.weight.std().item() - 1) < 0.01
    bound = 1 / 11**0.5
    weight = network.frames[0].get_parameter("linear.weight")
    assert bound / 2 < weight.abs().max() <= bound


def test_tokens_are_dropped_before_the_blocks() -> None:
    predictor, inputs = make("dt", dropout=0.5), make_inputs("dt", 2)
    predictor.encoder.blocks.eval()
    predictor.encoder.dropout.train()
    assert not torch.equal(predictor(*inputs), predictor(*inputs))


def test_wrong_shapes_and_types_are_named() -> None:
    predictor, inputs = make("dt"), make_inputs("dt", 2)
    names = ["of shape", "action", "return_to_go", "timestep", "mask"]
    inputs.append(torch.ones(2, 5))
    for index, name in enumerate(names):
        wrong = list(inputs)
        wrong[index] = wrong[index][..., :-1]
        for call in (predictor, predictor.network):
            with pytest.raises(ValueError, match=rf"{name}.*fit"):
                call(*wrong)
    with pytest.raises(ValueError, match=r"history of shape \(11,\) does not fit"):
        predictor.network.encode_frames(torch.randn(11))
    with pytest.raises(TypeError, match="float32 does not fit"):
        predictor(inputs[0].float(), *inputs[1:])
    for step in (-1, 30):
        late = inputs[3].clone()
        late[1, 2] = step
        first, last = min(step, 0), max(step, 4)
        message = rf"timesteps range from {first} to {last}, .* below max_ep_len 30"
        with pytest.raises(ValueError, match=message):
            predictor(*inputs[:3], late)

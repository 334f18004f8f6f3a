"""Decision Transformer: what it does beyond equality with the reference in tests/interop."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state

from tests.networks.reference import randomize
from torchrl_tit.networks import DecisionTransformer, DecisionTransformerConfig, GPT2Block

CASES: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {
    "dt": ((11,), {}),
    "dt_tit": ((11,), {"state_encoder": "inner_transformer"}),
    "dt on images": ((3, 8, 8), {}),
    "dt_tit on images": (
        (8, 8),
        {"state_encoder": "inner_transformer", "patch_size": 4, "position_encoding": True},
    ),
    "discrete": ((11,), {"action_space": "discrete"}),
    "no time": ((11,), {"timestep_embedding": False}),
}
every_case = pytest.mark.parametrize("case", CASES)
SMALL: dict[str, Any] = {"embed_dim": 16, "num_heads": 2, "num_blocks": 2, "max_ep_len": 30}


@pytest.fixture(autouse=True)
def _fresh_compiler() -> Iterator[None]:
    yield
    torch.compiler.reset()


def make(case: str, seed: int = 0, **settings: Any) -> DecisionTransformer:
    shape, options = CASES[case]
    network = DecisionTransformer(shape, 3, **{**SMALL, **options, **settings})
    randomize(network, seed)
    return network.eval()


def make_inputs(case: str, *leading: int, steps: int = 5) -> list[Tensor]:
    shape, options = CASES[case]
    torch.manual_seed(7)
    if len(shape) > 1:
        states = torch.randint(0, 256, (*leading, steps, *shape), dtype=torch.uint8)
    else:
        states = torch.randn(*leading, steps, *shape)
    if options.get("action_space") == "discrete":
        actions = nn.functional.one_hot(torch.randint(3, (*leading, steps)), 3)
    else:
        actions = torch.rand(*leading, steps, 3) * 2 - 1
    returns_to_go = torch.rand(*leading, steps, 1)
    timesteps = torch.arange(steps).expand(*leading, steps)
    return [states, actions, returns_to_go, timesteps]


def changed(inputs: list[Tensor], entry: int, step: int) -> list[Tensor]:
    """The inputs with one entry of one step replaced."""
    inputs = [x.clone() for x in inputs]
    x = inputs[entry]
    x[:, step] = x[:, step].roll(1, dims=-1) if x.shape[-1] > 1 else x[:, step] + 1
    return inputs


@every_case
def test_actions_come_from_what_is_before_them(case: str) -> None:
    network, inputs = make(case), make_inputs(case, 2)
    actions = network(*inputs)
    assert actions.shape == (2, 5, 3)
    for entry in range(3):
        other = network(*changed(inputs, entry, 2))
        same = (other - actions).abs().amax((0, 2)) < 1e-6
        # The action of step 2 sees the state and return of its step, but not itself.
        first = 3 if entry == 1 else 2
        assert same.tolist() == [step < first for step in range(5)], entry


@every_case
def test_padding_is_not_seen_and_stays_finite(case: str) -> None:
    network, inputs = make(case), make_inputs(case, 3)
    mask = torch.tensor([[1, 1, 1, 1, 1], [0, 0, 1, 1, 1], [0, 0, 0, 0, 0]])
    actions = network(*inputs, mask)
    assert actions.isfinite().all()
    torch.testing.assert_close(actions[0], network(*inputs)[0], rtol=1e-5, atol=1e-6)
    shorter = network(*(x[1:2, 2:] for x in inputs))
    torch.testing.assert_close(actions[1, 2:], shorter[0], rtol=1e-5, atol=1e-6)
    padding = [torch.where(mask.view(3, 5, *[1] * (x.ndim - 2)) == 0, 1, x) for x in inputs]
    torch.testing.assert_close(network(*padding, mask.bool())[mask == 1], actions[mask == 1])

    network.train()
    network(*inputs, mask)[mask == 1].sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


@every_case
def test_newest_step_alone_equals_the_last_of_all(case: str) -> None:
    network, inputs = make(case), make_inputs(case, 2)
    states, actions, returns_to_go, timesteps = inputs
    tokens = network.encode_states(states)
    mask = torch.tensor([[0, 1, 1, 1, 1], [1, 1, 1, 1, 1]])
    features = network.encode(tokens, actions, returns_to_go, timesteps, mask, newest=True)
    assert features.shape == (2, 1, network.features_dim)
    expected = network(*inputs, mask)[:, -1:]
    torch.testing.assert_close(network.action_head(features), expected)
    # A state's token depends on that state alone, so it can be kept.
    one_by_one = [network.encode_states(states[:, k : k + 1]) for k in range(5)]
    torch.testing.assert_close(torch.cat(one_by_one, 1), tokens)


@every_case
def test_leading_dimensions_are_free(case: str) -> None:
    network, inputs = make(case), make_inputs(case, 2, 3)
    mask = torch.ones(2, 3, 5)
    expected = network(*(x.flatten(0, 1) for x in inputs), mask.flatten(0, 1))
    torch.testing.assert_close(network(*inputs, mask).flatten(0, 1), expected)
    alone = network(*(x[1, 2] for x in inputs), mask[1, 2])
    torch.testing.assert_close(alone, expected[5], rtol=1e-5, atol=1e-6)


def test_action_heads() -> None:
    continuous = make("dt")(*make_inputs("dt", 4)).abs()
    assert continuous.max() < 1
    network, inputs = make("discrete"), make_inputs("discrete", 4)
    features = network.encode(network.encode_states(inputs[0]), *inputs[1:])
    linear = network.action_head.get_submodule("0")
    torch.testing.assert_close(network(*inputs), linear(features))  # logits as they are
    torch.testing.assert_close(network(inputs[0], inputs[1].bool(), *inputs[2:]), network(*inputs))


def test_time_steps_matter_unless_switched_off() -> None:
    for case, matters in (("dt", True), ("no time", False)):
        network, inputs = make(case), make_inputs(case, 2)
        later = network(*inputs[:3], inputs[3] + 7)
        assert torch.allclose(later, network(*inputs)) != matters


def test_defaults_are_the_protocols() -> None:
    network = DecisionTransformer((11,), 3)
    shapes = {name: tuple(p.shape) for name, p in network.named_parameters()}
    assert shapes["timestep_embedding.weight"] == (1000, 128)
    assert shapes["blocks.2.ffn.0.weight"] == (512, 128)
    assert "blocks.3.ffn.0.weight" not in shapes
    drops = [module.p for module in network.modules() if isinstance(module, nn.Dropout)]
    assert drops == [0.1] * 10  # tokens; weights, attention's and FFN's output of three blocks
    block = network.blocks[0]
    assert isinstance(block, GPT2Block)
    assert block.attention.num_heads == 1
    tit = DecisionTransformer((11,), 3, state_encoder="inner_transformer")
    inner = {n: tuple(p.shape) for n, p in tit.state_encoder.named_parameters()}
    assert inner["patch_embedding.weight"] == (128, 1, 11)
    assert inner["blocks.0.ffn.0.weight"] == (128, 128)
    assert not any("positions" in n or "blocks.1" in n for n in inner)


def test_gpt2_blocks_start_as_gpt2_and_the_rest_as_pytorch() -> None:
    torch.manual_seed(0)
    network = DecisionTransformer((11,), 3)
    for name, parameter in network.blocks.named_parameters():
        if "norm" in name:
            assert (parameter == float(name.endswith("weight"))).all()
        elif name.endswith("bias"):
            assert not parameter.any()
        else:
            assert abs(parameter.std().item() - 0.02) < 1e-3
    assert network.timestep_embedding is not None
    assert abs(network.timestep_embedding.weight.std().item() - 1) < 0.01
    bound = 1 / 11**0.5
    weight = network.state_encoder.get_parameter("linear.weight")
    assert bound / 2 < weight.abs().max() <= bound


def test_dropout_only_while_training() -> None:
    network, inputs = make("dt", dropout=0.5), make_inputs("dt", 2)
    assert torch.equal(network(*inputs), network(*inputs))
    network.train()
    assert not torch.equal(network(*inputs), network(*inputs))


def test_tokens_are_dropped_before_the_blocks() -> None:
    network, inputs = make("dt", dropout=0.5), make_inputs("dt", 2)
    network.blocks.eval()
    network.dropout.train()
    assert not torch.equal(network(*inputs), network(*inputs))


@pytest.mark.parametrize("part", ["attention", "ffn"])
def test_both_residuals_of_a_block_are_dropped(part: str) -> None:
    torch.manual_seed(0)
    block = GPT2Block(8, 2, 16, dropout=0.25)
    randomize(block)
    other = block.ffn.get_submodule("2") if part == "attention" else block.attention.out_proj
    for parameter in other.parameters():
        nn.init.zeros_(parameter)
    block.attention.dropout.p = 0.0
    x, mask = torch.randn(2000, 2, 8), torch.ones(2, 2, dtype=torch.bool).tril()
    with torch.no_grad():
        kept = block.eval()(x, mask) - x
        update = block.train()(x, mask) - x
    dropped = update == 0
    assert abs(dropped.float().mean() - 0.25) < 0.02
    torch.testing.assert_close(update[~dropped], kept[~dropped] / 0.75, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("case", ["dt", "dt_tit on images"])
@pytest.mark.parametrize("training", [False, True])
def test_compile_in_one_graph_equals_eager(case: str, training: bool) -> None:
    network, inputs = make(case).train(training), make_inputs(case, 2)
    mask = torch.tensor([[0, 0, 1, 1, 1], [1, 1, 1, 1, 1]])
    compiled = torch.compile(network, fullgraph=True, backend="aot_eager")
    results = []
    for call in (network, compiled):
        network.zero_grad()
        torch.manual_seed(0)
        actions = call(*inputs, mask)
        actions.square().sum().backward()
        results.append([actions, *(p.grad for p in network.parameters())])
    torch.testing.assert_close(results[1], results[0], rtol=1e-4, atol=1e-5)


@every_case
def test_vmap_over_stacked_parameters(case: str) -> None:
    networks = [make(case, seed) for seed in range(2)]
    parameters, buffers = stack_module_state(list(networks))
    inputs = (*make_inputs(case, 2), torch.tensor([[0, 0, 1, 1, 1], [1, 1, 1, 1, 1]]))

    def call(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> Any:
        return functional_call(networks[0], (parameters, buffers), inputs)

    actions = torch.vmap(call)(parameters, buffers)
    torch.testing.assert_close(actions, torch.stack([network(*inputs) for network in networks]))


@every_case
def test_copies_export_and_autocast(case: str) -> None:
    network, inputs = make(case), make_inputs(case, 2)
    expected = network(*inputs)
    assert torch.equal(copy.deepcopy(network)(*inputs), expected)
    exported = torch.export.export(network, tuple(inputs)).module()
    torch.testing.assert_close(exported(*inputs), expected)
    with torch.autocast("cpu", torch.bfloat16):
        actions = network(*inputs)
    assert 1e-5 < (actions.float() - expected).norm() / expected.norm() < 0.05


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"context": 31, "max_ep_len": 30}, "context of 31 steps is longer than max_ep_len 30"),
        ({"context": 0}, "context must be >= 1, not 0"),
        ({"ffn_dim": 0}, "ffn_dim must be >= 1, not 0"),
        ({"patch_size": 0}, "patch_size must be >= 1, not 0"),
        ({"num_heads": 3}, "width 128 cannot be split over 3 attention heads"),
        ({"dropout": 1.0}, r"dropout is a probability in \[0, 1\), not 1.0"),
        ({"state_encoder": "cnn"}, r"unknown state_encoder 'cnn': choose one of \('linear'"),
        ({"action_space": "box"}, r"unknown action_space 'box': choose one of \('continuous'"),
        ({"activation": "gelo"}, "unknown activation 'gelo'"),
    ],
)
def test_wrong_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DecisionTransformer((11,), 3, **settings)


def test_wrong_shapes_and_types_are_named() -> None:
    with pytest.raises(ValueError, match="action_dim must be >= 1, not 0"):
        DecisionTransformer((11,), 0)
    with pytest.raises(ValueError, match=r"observation_shape \(\) is not"):
        DecisionTransformer((), 3)
    with pytest.raises(TypeError, match="expected DecisionTransformerConfig"):
        DecisionTransformer((11,), 3, config={})  # type: ignore[arg-type]
    assert DecisionTransformer((11,), 3, DecisionTransformerConfig()).config.context == 20
    network, inputs = make("dt"), make_inputs("dt", 2)
    names = ["of shape", "actions", "returns_to_go", "timesteps", "attention_mask"]
    inputs.append(torch.ones(2, 5))
    for index, name in enumerate(names):
        wrong = list(inputs)
        wrong[index] = wrong[index][..., :-1]
        with pytest.raises(ValueError, match=rf"{name}.*fit"):
            network(*wrong)
    with pytest.raises(ValueError, match=r"history of shape \(11,\) does not fit"):
        network.encode_states(torch.randn(11))
    with pytest.raises(TypeError, match="float64 does not fit"):
        network(inputs[0].double(), *inputs[1:])
    for step in (-1, 30):
        late = inputs[3].clone()
        late[1, 2] = step
        message = rf"timesteps reach from {min(step, 0)} to {max(step, 4)}, .* below max_ep_len 30"
        with pytest.raises(ValueError, match=message):
            network(*inputs[:3], late)

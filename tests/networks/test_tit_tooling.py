"""The networks under PyTorch's tools: compile, export, vmap, autocast, copies."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit.networks import EnhancedTIT, HistoryNetwork, VanillaTIT

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

NETWORKS: dict[str, tuple[type[Any], dict[str, Any]]] = {
    "vanilla": (VanillaTIT, {}),
    "enhanced": (EnhancedTIT, {}),
    "enhanced, temporal, shared": (
        EnhancedTIT,
        {"temporal_positions": "learned", "share_blocks": True},
    ),
    "without dense": (EnhancedTIT, {"dense": False}),
    "without inner": (EnhancedTIT, {"inner": False}),
    "without outer": (EnhancedTIT, {"outer": False}),
}
OBSERVATIONS: dict[str, tuple[tuple[int, ...], int, dict[str, Any]]] = {
    "array, K=1": ((5,), 1, {"patch_size": 2}),
    "array, K=3": ((5,), 3, {"patch_size": 2}),
    "image": ((8, 8), 2, {"patch_size": 4}),
}
DROPOUT: dict[str, Any] = {
    "attention_dropout_inner": 0.2,
    "attention_dropout_outer": 0.2,
    "ffn_dropout_inner": 0.2,
    "ffn_dropout_outer": 0.2,
}

every_network = pytest.mark.parametrize("network", NETWORKS)
every_observation = pytest.mark.parametrize("observation", OBSERVATIONS)


# Tracing takes seconds: every network and every observation once.
traced_cases = pytest.mark.parametrize(
    ("network", "observation"),
    [
        ("vanilla", "array, K=3"),
        ("enhanced", "image"),
        ("enhanced, temporal, shared", "array, K=3"),
        ("without dense", "array, K=1"),
        ("without inner", "array, K=3"),
        ("without outer", "image"),
    ],
)


def make(network: str, observation: str, seed: int = 0, **settings: Any) -> HistoryNetwork:
    kind, options = NETWORKS[network]
    shape, num_frames, patches = OBSERVATIONS[observation]
    settings = {"embed_dim": 16, "num_heads_inner": 2, "features_dim": 12, **options, **settings}
    if num_frames == 1:  # there is nothing to tell apart
        settings.pop("temporal_positions", None)
    built = kind(shape, num_frames, **patches, **settings)
    randomize(built, seed)
    assert isinstance(built, HistoryNetwork)
    return built


def make_history(observation: str, *leading: int) -> Tensor:
    shape, num_frames, _ = OBSERVATIONS[observation]
    if observation == "image":
        return torch.randint(0, 256, (*leading, num_frames, *shape), dtype=torch.uint8)
    return torch.randn(*leading, num_frames, *shape)


def loss_and_gradients(network: Any, module: nn.Module, history: Tensor) -> list[Tensor]:
    module.zero_grad()
    features = network(history)
    features.square().sum().backward()
    return [features.detach(), *(p.grad for p in module.parameters() if p.grad is not None)]


@pytest.fixture(autouse=True)
def _fresh_compiler() -> Iterator[None]:
    yield
    torch.compiler.reset()


@pytest.mark.parametrize(
    ("network", "observation"),
    [("enhanced, temporal, shared", "array, K=3"), ("without outer", "image")],
)
def test_compile_in_one_graph_equals_eager(network: str, observation: str) -> None:
    """With dropout; tests/networks/test_pairs.py compiles every pair without."""
    module = make(network, observation, **DROPOUT).train()
    history = make_history(observation, 4)
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
    torch.manual_seed(0)
    expected = loss_and_gradients(module, module, history)
    torch.manual_seed(0)
    actual = loss_and_gradients(compiled, module, history)
    assert_near(actual, expected)


def test_compile_with_any_batch_size_is_done_once() -> None:
    module = make("enhanced", "array, K=3")
    graphs = []

    def backend(graph: torch.fx.GraphModule, _: object) -> Callable[..., Any]:
        graphs.append(graph)
        return graph.forward

    compiled = torch.compile(module, fullgraph=True, backend=backend, dynamic=True)
    for batch in (7, 4, 9):
        history = make_history("array, K=3", batch)
        assert_near(compiled(history), module(history))
    assert len(graphs) == 1


@traced_cases
def test_export_with_a_dynamic_batch(network: str, observation: str) -> None:
    module = make(network, observation).eval()
    exported = torch.export.export(
        module,
        (make_history(observation, 4),),
        dynamic_shapes={"inputs": ({0: torch.export.Dim("batch")},)},
        strict=network == "enhanced",
    ).module()
    for batch in (1, 4, 7):
        history = make_history(observation, batch)
        assert_near(exported(history), module(history))


# On CPUs, PyTorch's attention kernel runs once per set of parameters, and says so.
vmap_of_attention = pytest.mark.filterwarnings("ignore:There is a performance drop")


@vmap_of_attention
@every_network
@every_observation
def test_vmap_over_stacked_parameters(network: str, observation: str) -> None:
    modules = [make(network, observation, seed, **DROPOUT).eval() for seed in range(3)]
    stacked, buffers = stack_module_state(list(modules))
    history = make_history(observation, 4)

    def call(parameters: dict[str, Tensor], buffers: dict[str, Tensor], x: Tensor) -> Tensor:
        return functional_call(modules[0], (parameters, buffers), (x,))

    features = torch.vmap(call, in_dims=(0, 0, None))(stacked, buffers, history)
    expected = torch.stack([module(history) for module in modules])
    assert_near(features, expected)

    features.square().sum().backward()
    expected.square().sum().backward()
    for name, parameter in stacked.items():
        for index, module in enumerate(modules):
            gradient = module.get_parameter(name).grad
            assert parameter.grad is not None
            assert_near(parameter.grad[index], gradient)


@vmap_of_attention
@every_network
@pytest.mark.parametrize("setting", DROPOUT)
def test_vmap_drops_differently_for_each(network: str, setting: str) -> None:
    if (network == "without inner" and setting.endswith("inner")) or (
        network == "without outer" and setting.endswith("outer")
    ):
        pytest.skip("there is no such part")
    settings: dict[str, Any] = {setting: 0.5}
    modules = [make(network, "array, K=3", **settings).train() for _ in range(3)]
    stacked, buffers = stack_module_state(list(modules))
    features = torch.vmap(
        lambda p, b, x: functional_call(modules[0], (p, b), (x,)),
        in_dims=(0, 0, None),
        randomness="different",
    )(stacked, buffers, make_history("array, K=3", 4))
    assert not torch.equal(features[0], features[1])
    assert not torch.equal(features[1], features[2])


@every_network
def test_parameters_swapped_by_tensordict(network: str) -> None:
    from tensordict import TensorDict

    module, other = make(network, "image", 0), make(network, "image", 1)
    history = make_history("image", 4)
    own = module(history)
    with TensorDict.from_module(other).data.clone().to_module(module):
        assert_near(module(history), other(history))
    assert_near(module(history), own)


@every_network
@every_observation
def test_copies_compute_the_same_and_are_apart(network: str, observation: str) -> None:
    module = make(network, observation)
    history = make_history(observation, 2)
    expected = module(history)
    fresh = make(network, observation, seed=1)
    assert not torch.allclose(fresh(history), expected)
    file = io.BytesIO()
    torch.save(module.state_dict(), file)
    file.seek(0)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    copies = [copy.deepcopy(module), pickle.loads(pickle.dumps(module)), fresh]
    for other in copies:
        assert torch.equal(other(history), expected)
        nn.init.zeros_(other.head[3].weight)
    assert torch.equal(module(history), expected)


@every_network
@every_observation
def test_autocast_to_bfloat16_stays_close(network: str, observation: str) -> None:
    module = make(network, observation).float()
    history = make_history(observation, 8)
    history = history.float() if history.is_floating_point() else history
    expected = module(history)
    with torch.autocast("cpu", torch.bfloat16):
        features = module(history)
    features.float().square().sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in module.parameters())
    error = (features.float() - expected).norm() / expected.norm()
    assert 1e-5 < error < 0.05  # not equal: it did run in bfloat16


@every_network
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@every_observation
def test_whole_network_in_another_float_type(
    network: str, observation: str, dtype: torch.dtype
) -> None:
    module = make(network, observation)
    history = make_history(observation, 4)
    expected = module(history)
    features = module.to(dtype)(history.to(dtype) if history.is_floating_point() else history)
    assert features.dtype == dtype
    error = (features.double() - expected).norm() / expected.norm()
    assert error < (1e-5 if dtype == torch.float32 else 0.1)


@every_network
@every_observation
def test_nothing_is_held_that_a_pass_made(network: str, observation: str) -> None:
    module = make(network, observation)
    before = {name: set(vars(child)) for name, child in module.named_modules()}
    module(make_history(observation, 2))
    module.attention_maps(make_history(observation, 2))
    assert {name: set(vars(child)) for name, child in module.named_modules()} == before
    assert set(module.state_dict()) == {name for name, _ in module.named_parameters()}

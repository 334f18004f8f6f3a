"""What a checkpoint holds comes back as it was, to the last bit, and nothing else is accepted."""

from __future__ import annotations

import json
import random
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load, save
from tensordict import LazyStackedTensorDict, TensorDict

from tests.recipes.states import assert_same
from torchrl_tit.checkpoint import (
    decode,
    encode,
    global_rng_state,
    load_checkpoint,
    save_checkpoint,
    set_global_rng_state,
)

INFINITY = float("inf")
DTYPES = [
    *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
    *(torch.uint16, torch.uint32, torch.uint64, torch.float16, torch.bfloat16),
    *(torch.float32, torch.float64, torch.complex64, torch.complex128),
    *(torch.float8_e4m3fn, torch.float8_e5m2, torch.float8_e4m3fnuz, torch.float8_e5m2fnuz),
]
SHAPES: list[tuple[int, ...]] = [(), (0,), (3, 2), (2, 0, 4)]
INNER = TensorDict(
    {"x": torch.ones(3, 2, 4), "done": torch.zeros(3, 2, 1, dtype=torch.bool)}, [3, 2]
)


def tensor_of(dtype: torch.dtype, shape: tuple[int, ...]) -> torch.Tensor:
    size = dtype.itemsize * int(np.prod(shape))
    content = torch.randint(0, 2, (size,), dtype=torch.uint8)
    return content.view(dtype).reshape(shape) if shape else torch.ones((), dtype=dtype)


VALUES: list[Any] = [
    *(None, True, False, 0, -1, 2**53, -(2**127) - 1, 10**5000, 0.1, -0.0, 5e-324),
    *(INFINITY, -INFINITY, float("nan"), "", 'é"\n\ud800', "$tensor"),
    *([], (), {}, [()], ((1,), [2]), torch.Size([]), torch.Size([2, 3])),
    *({0: "int", "0": "str", -7: None}, {"$tuple": [1]}, {"": {"$": {1: {}}}}),
    OrderedDict([("b", 1), ("a", (2,)), (3, OrderedDict())]),
    *(tensor_of(dtype, shape) for dtype in DTYPES for shape in SHAPES),
    *(np.array(1.5), np.zeros((0, 3), dtype=">i2"), np.arange(10)[::-2], np.array([True, False])),
    np.asfortranarray(np.arange(6, dtype=np.uint16).reshape(2, 3)),
    *(np.array([1 + 2j], dtype=np.complex64), np.array(["a", "bcd"])),
    np.array(["2020-01-01"], dtype="datetime64[D]"),
    *(np.float64("nan"), np.float32(0.1), np.int8(-3), np.uint64(2**64 - 1), np.bool_(True)),
    *(np.str_("é"), np.longdouble(1) / 3, np.complex128(1j)),
    TensorDict({"inner": INNER, "y": torch.zeros(3, dtype=torch.bfloat16)}, [3]),
    TensorDict({"x": torch.ones(2, 5)}, [2, 5], device="cpu", names=[None, "time"]),
    *(TensorDict({}, [4]), TensorDict({"x": torch.tensor(1.0)}, [])),
]


def round_trip(state: Any) -> Any:
    """Through the very bytes that reach the disk."""
    tensors, tree = encode(state)
    return decode(load(save(tensors)), json.loads(json.dumps(tree, allow_nan=False)))


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_values(value: Any) -> None:
    for state in (value, {"nested": [value, (value,)]}):
        assert_same(round_trip(state), state)
    if isinstance(value, np.ndarray):
        assert round_trip(value).flags.writeable


def nested(source: random.Random, depth: int) -> Any:
    if depth == 0:
        return source.choice(VALUES)
    number = source.randrange(9)
    keys = [number, str(number), f"k.{number}", f"${number}"]
    children = [nested(source, depth - 1) for _ in range(source.randrange(4))]
    pairs = [(source.choice(keys), child) for child in children]
    return source.choice([children, tuple(children), dict(pairs), OrderedDict(pairs)])


@pytest.mark.parametrize("seed", range(40))
def test_any_nesting(seed: int) -> None:
    state = nested(random.Random(seed), depth=4)
    assert_same(round_trip(state), state)


def test_tensors_that_are_views_or_shared() -> None:
    base = torch.arange(12.0).reshape(3, 4)
    state = [base, base, base.T, base[1], base[:1].expand(3, 4)]
    assert_same(round_trip(state), state)
    conjugate = torch.tensor([1 + 2j]).conj()
    assert round_trip(conjugate).equal(conjugate.resolve_conj())
    parameter = torch.nn.Parameter(torch.ones(2))
    assert_same(round_trip(parameter), parameter.detach())


def test_encoding_is_a_snapshot_and_decoded_tensors_are_aligned() -> None:
    tensor, array = torch.zeros(2), np.zeros(2)
    tensors, tree = encode([tensor, array])
    tensor += 1
    array += 1
    assert_same(decode(tensors, tree), [torch.zeros(2), np.zeros(2)])
    # In the file the second one begins at an odd place.
    state = [torch.ones(3, dtype=torch.uint8), torch.ones(5), torch.ones(3, dtype=torch.float64)]
    assert all(decoded.data_ptr() % 64 == 0 for decoded in round_trip(state))


class Named(dict):
    pass


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        *((object(), "object"), (Named, "type"), (print, "builtin"), ({1, 2}, "set")),
        *((b"raw", "bytes"), (1j, "complex"), (Named(), "Named"), (slice(1), "slice")),
        *((np.array([None]), "ndarray"), (np.zeros(1, dtype=[("a", int)]), "ndarray")),
        *((torch.ones(2).to_sparse(), "Tensor"), (torch.ones(2, device="meta"), "Tensor")),
        (torch.nn.parameter.UninitializedBuffer(), "UninitializedBuffer"),
        (LazyStackedTensorDict(TensorDict({}), TensorDict({})), "LazyStackedTensorDict"),
        *((torch.float32, "dtype"), (torch.device("cpu"), "device")),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_saved_is_named_with_its_place(value: Any, kind: str) -> None:
    with pytest.raises(TypeError, match=rf"state\['a'\]\[3\]\[1\] is a .*{kind}"):
        encode({"a": {3: (0, value)}})


@pytest.mark.parametrize("key", [True, None, 1.0, (1,)])
def test_keys_that_cannot_be_saved(key: Any) -> None:
    with pytest.raises(TypeError, match=r"state\['a'\] has the key"):
        encode({"a": {key: 1}})


@pytest.mark.parametrize(
    "tree",
    [
        *({"$eval": "1"}, {"$tensor": "missing"}, {"$tensor": "x", "dtype": "load", "shape": [1]}),
        {"$array": "x", "dtype": "|O", "shape": [1]},
        *({"$scalar": "00" * 8, "dtype": "|O"}, {"$int": "zz"}),
        1,  # leaves the tensor without a place
    ],
    ids=str,
)
def test_foreign_trees_are_refused(tree: Any) -> None:
    with pytest.raises(ValueError, match=r"."):
        decode({"x": torch.zeros(8, dtype=torch.uint8)}, tree)


def draw() -> tuple[object, ...]:
    numbers = random.random(), random.gauss(0, 1), np.random.normal(), *np.random.rand(3)
    return *numbers, *torch.randn(5).tolist(), *torch.randn(17).tolist()


def seed(number: int) -> None:
    for set_seed in (random.seed, np.random.seed, torch.manual_seed):
        set_seed(number)


def draw_on_gpu() -> list[float]:
    return torch.rand(3, device="cuda").tolist()


GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@pytest.mark.parametrize("numbers", [draw, pytest.param(draw_on_gpu, marks=GPU)])
def test_generators_go_on_where_they_were(tmp_path, numbers: Callable[[], object]) -> None:
    seed(1)
    numbers()  # leaves halves of normal pairs behind
    save_checkpoint(tmp_path, 1, global_rng_state())
    expected = numbers()
    seed(2)
    set_global_rng_state(load_checkpoint(tmp_path)[1])
    assert numbers() == expected


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without a GPU")
def test_state_with_gpus_is_taken_on_a_machine_without() -> None:
    state = global_rng_state()
    expected = draw()
    set_global_rng_state(state | {"cuda": [torch.zeros(16, dtype=torch.uint8)]})
    assert draw() == expected

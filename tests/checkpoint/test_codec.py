import json
import random
from collections import OrderedDict
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load, save
from tensordict import LazyStackedTensorDict, TensorDict

from torchrl_tit.checkpoint import decode, encode

INFINITY = float("inf")


def round_trip(state: Any) -> Any:
    """Through the very bytes that reach the disk."""
    tensors, tree = encode(state)
    return decode(load(save(tensors)), json.loads(json.dumps(tree, allow_nan=False)))


def assert_same(left: Any, right: Any) -> None:
    """Equal to the last bit, and of the same types all the way down."""
    assert type(left) is type(right)
    if isinstance(left, dict):
        assert list(left) == list(right)
        assert [type(key) for key in left] == [type(key) for key in right]
        for key in left:
            assert_same(left[key], right[key])
    elif isinstance(left, (list, tuple)):
        assert len(left) == len(right)
        for a, b in zip(left, right, strict=True):
            assert_same(a, b)
    elif isinstance(left, torch.Tensor):
        assert (left.dtype, left.shape) == (right.dtype, right.shape)
        assert (
            left.contiguous()
            .reshape(-1)
            .view(torch.uint8)
            .equal(right.contiguous().reshape(-1).view(torch.uint8))
        )
    elif isinstance(left, (np.ndarray, np.generic)):
        assert (left.dtype, left.shape) == (right.dtype, right.shape)
        assert left.tobytes() == right.tobytes()
    elif isinstance(left, TensorDict):
        assert (left.batch_size, left.device) == (right.batch_size, right.device)
        assert left.names == right.names
        assert_same(dict(left.items()), dict(right.items()))
    elif isinstance(left, float):
        assert left.hex() == right.hex()
    else:
        assert left == right


@pytest.mark.parametrize(
    "value",
    [
        *(None, True, False, 0, -1, 2**53, -(2**127) - 1, 10**5000, 0.1, -0.0, 5e-324),
        *(INFINITY, -INFINITY, float("nan"), "", 'é"\n\ud800', "$tensor"),
        *([], (), {}, [()], ((1,), [2]), torch.Size([]), torch.Size([2, 3])),
        *({0: "int", "0": "str", -7: None}, {"$tuple": [1]}, {"": {"$": {1: {}}}}),
        OrderedDict([("b", 1), ("a", (2,)), (3, OrderedDict())]),
    ],
    ids=lambda value: type(value).__name__,
)
def test_plain_values(value: Any) -> None:
    assert_same(round_trip(value), value)
    assert_same(round_trip({"nested": [value, (value,)]}), {"nested": [value, (value,)]})


@pytest.mark.parametrize(
    "dtype",
    [
        *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
        *(torch.uint16, torch.uint32, torch.uint64, torch.float16, torch.bfloat16),
        *(torch.float32, torch.float64, torch.complex64, torch.complex128),
        *(torch.float8_e4m3fn, torch.float8_e5m2, torch.float8_e4m3fnuz, torch.float8_e5m2fnuz),
    ],
)
@pytest.mark.parametrize("shape", [(), (0,), (3, 2), (2, 0, 4)])
def test_tensors(dtype: torch.dtype, shape: tuple[int, ...]) -> None:
    generator = torch.Generator().manual_seed(0)
    size = dtype.itemsize * int(np.prod(shape))
    content = torch.randint(0, 2, (size,), dtype=torch.uint8, generator=generator)
    tensor = content.view(dtype).reshape(shape) if shape else torch.ones((), dtype=dtype)
    assert_same(round_trip([tensor]), [tensor])


def test_tensors_that_are_views_or_shared() -> None:
    base = torch.arange(12.0).reshape(3, 4)
    state = {
        "whole": base,
        "again": base,
        "turned": base.T,
        "row": base[1],
        "wide": base[:1].expand(3, 4),
    }
    assert_same(round_trip(state), state)
    conjugate = torch.tensor([1 + 2j]).conj()
    assert round_trip(conjugate).equal(conjugate.resolve_conj())
    parameter = torch.nn.Parameter(torch.ones(2))
    assert_same(round_trip(parameter), parameter.detach())


def test_encoding_is_a_snapshot() -> None:
    tensor, array = torch.zeros(2), np.zeros(2)
    tensors, tree = encode({"tensor": tensor, "array": array})
    tensor += 1
    array += 1
    assert_same(decode(tensors, tree), {"tensor": torch.zeros(2), "array": np.zeros(2)})


def test_decoded_tensors_are_aligned() -> None:
    # In the file the second one begins at an odd place.
    state = [torch.ones(3, dtype=torch.uint8), torch.ones(5), torch.ones(3, dtype=torch.float64)]
    assert all(tensor.data_ptr() % 64 == 0 for tensor in round_trip(state))


@pytest.mark.parametrize(
    "array",
    [
        np.array(1.5),
        np.zeros((0, 3), dtype=">i2"),
        np.asfortranarray(np.arange(6, dtype=np.uint16).reshape(2, 3)),
        np.arange(10)[::-2],
        np.array([True, False]),
        np.array([1 + 2j], dtype=np.complex64),
        np.array(["a", "bcd"]),
        np.array(["2020-01-01"], dtype="datetime64[D]"),
        *(np.float64("nan"), np.float32(0.1), np.int8(-3), np.uint64(2**64 - 1), np.bool_(True)),
        *(np.str_("é"), np.longdouble(1) / 3, np.complex128(1j)),
    ],
    ids=repr,
)
def test_numpy(array: Any) -> None:
    back = round_trip({"x": array})["x"]
    assert_same(back, array)
    if isinstance(back, np.ndarray):
        assert back.flags.writeable


def test_numpy_generators() -> None:
    for bits in (np.random.PCG64(3), np.random.MT19937(3), np.random.Philox(3)):
        generator = np.random.Generator(bits)
        generator.integers(10, dtype=np.int32)  # leaves half a word in the buffer
        state = round_trip(bits.state)
        first = generator.random(5), generator.integers(10, dtype=np.int32)
        bits.state = state
        assert first[0].tolist() == generator.random(5).tolist()
        assert first[1] == generator.integers(10, dtype=np.int32)


def test_tensordicts() -> None:
    inner = TensorDict(
        {"x": torch.ones(3, 2, 4), "done": torch.zeros(3, 2, 1, dtype=torch.bool)}, [3, 2]
    )
    plain = TensorDict({"inner": inner, "y": torch.zeros(3, dtype=torch.bfloat16)}, [3])
    placed = TensorDict({"x": torch.ones(2, 5)}, [2, 5], device="cpu", names=[None, "time"])
    for value in (plain, placed, TensorDict({}, [4]), TensorDict({"x": torch.tensor(1.0)}, [])):
        assert_same(round_trip({"td": value}), {"td": value})


def test_optimizer_continues() -> None:
    torch.manual_seed(0)

    def make() -> tuple[torch.nn.Linear, torch.optim.Optimizer]:
        net = torch.nn.Linear(3, 2)
        return net, torch.optim.Adam(net.parameters(), lr=1e-2, eps=1e-5, amsgrad=True)

    def update(net: torch.nn.Linear, optimizer: torch.optim.Optimizer) -> None:
        optimizer.zero_grad()
        net(torch.linspace(-1, 1, 12).reshape(4, 3)).square().sum().backward()
        optimizer.step()

    net, optimizer = make()
    for _ in range(3):
        update(net, optimizer)
    state = {"net": net.state_dict(), "optimizer": optimizer.state_dict()}
    assert_same(round_trip(state["optimizer"]), state["optimizer"])
    other_net, other_optimizer = make()
    back = round_trip(state)
    other_net.load_state_dict(back["net"])
    other_optimizer.load_state_dict(back["optimizer"])
    for _ in range(3):
        update(net, optimizer)
        update(other_net, other_optimizer)
    assert other_net.weight.equal(net.weight)


def random_state(source: random.Random, depth: int) -> Any:
    def key() -> str | int:
        number = source.randrange(9)
        keys: list[str | int] = [number, str(number), f"k.{number}", f"${number}"]
        return source.choice(keys)

    def children() -> list[Any]:
        return [random_state(source, depth - 1) for _ in range(source.randrange(4))]

    leaves = [
        lambda: source.choice([None, True, "a", 2**70, -INFINITY, 1e-300]),
        lambda: source.getrandbits(128),
        lambda: torch.randn(source.randrange(3), 2),
        lambda: np.random.default_rng(source.randrange(9)).integers(9, size=(2, 2)),
        lambda: np.float32(source.random()),
        lambda: TensorDict({"x": torch.randn(2, 3)}, [2]),
    ]
    branches = [
        children,
        lambda: tuple(children()),
        lambda: {key(): child for child in children()},
        lambda: OrderedDict((key(), child) for child in children()),
    ]
    return source.choice(leaves if depth == 0 else branches)()


@pytest.mark.parametrize("seed", range(40))
def test_any_nesting(seed: int) -> None:
    state = random_state(random.Random(seed), depth=4)
    assert_same(round_trip(state), state)


class Custom:
    pass


class Named(dict):
    pass


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        *((Custom(), "Custom"), (Custom, "type"), (print, "builtin"), ({1, 2}, "set")),
        *((b"raw", "bytes"), (1j, "complex"), (Named(), "Named"), (slice(1), "slice")),
        *((np.array([None]), "ndarray"), (np.zeros(1, dtype=[("a", int)]), "ndarray")),
        (torch.ones(2).to_sparse(), "Tensor"),
        (torch.ones(2, device="meta"), "Tensor"),
        (torch.nn.parameter.UninitializedBuffer(), "UninitializedBuffer"),
        (LazyStackedTensorDict(TensorDict({}), TensorDict({})), "LazyStackedTensorDict"),
        (torch.float32, "dtype"),
        (torch.device("cpu"), "device"),
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
        {"$scalar": "00" * 8, "dtype": "|O"},
        {"$int": "zz"},
        1,  # leaves the tensor without a place
    ],
    ids=str,
)
def test_foreign_trees_are_refused(tree: Any) -> None:
    with pytest.raises(ValueError, match=r"."):
        decode({"x": torch.zeros(8, dtype=torch.uint8)}, tree)

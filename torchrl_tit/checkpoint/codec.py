"""Converts nested Python state to named tensors and a JSON tree, and back without loss.

An object whose first key is a tag stands for what JSON cannot express:

    {"$tensor": name, ...}    {"$array": name, ...}    {"$scalar": hex, ...}
    {"$tuple": [...]}         {"$size": [...]}         {"$dict": [[key, value], ...]}
    {"$int": hex}             {"$float": "nan"}        {"$ordered": [[key, value], ...]}
    {"$tensordict": {...}, ...}

A tree cannot name a class or a function, so reading one never runs code from a file.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.parameter import is_lazy

# Safetensors stores these dtypes; all others are stored as bytes.
_NATIVE_DTYPES = {
    *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
    *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
}
_DTYPES: dict[str, torch.dtype] = {
    str(value): value for value in vars(torch).values() if isinstance(value, torch.dtype)
}
_EXACT_IN_JSON = 2**53  # other JSON readers use doubles


def encode(state: Any) -> tuple[dict[str, Tensor], Any]:
    """Splits a nested state into tensors and a tree for JSON.

    Args:
        state: dicts with str or int keys (also ordered ones), lists, tuples, `torch.Size`, None,
            bools, ints of any size, floats (also infinite ones and NaN), strings, dense tensors of
            any dtype and shape, numpy arrays and scalars, and TensorDicts of these.

    Returns:
        Contiguous CPU tensors that share no memory with the state, by their place in it
        (`"state['actor']['weight']"`), and the tree. Tensors lose their device and their gradient;
        parameters become plain tensors.

    Raises:
        TypeError: the state holds anything else; the message gives the place and the type.

    Example:
        >>> import torch
        >>> tensors, tree = encode({"weight": torch.ones(2), "betas": (0.9, 0.999)})
        >>> tensors
        {"state['weight']": tensor([1., 1.])}
        >>> tree["betas"]
        {'$tuple': [0.9, 0.999]}
    """
    tensors: dict[str, Tensor] = {}
    return tensors, _encode(state, "state", tensors)


def decode(tensors: dict[str, Tensor], tree: Any) -> Any:
    """Rebuilds a state that :func:`encode` split.

    Args:
        tensors: tensors by their place in the state.
        tree: the tree, as made by :func:`encode` or read back from JSON.

    Returns:
        The state, with the same types, keys, dtypes and values, on the CPU.

    Raises:
        ValueError: the tree and the tensors do not match, or a tag is unknown.

    Example:
        >>> decode(*encode({0: (1, 2.5, float("inf"))}))
        {0: (1, 2.5, inf)}
    """
    left = dict(tensors)
    state = _decode(tree, left)
    if left:
        raise ValueError(f"tensors that the state does not mention: {', '.join(sorted(left))}")
    return state


def _encode(value: Any, path: str, tensors: dict[str, Tensor]) -> Any:
    kind = type(value)
    if value is None or kind in (bool, str):
        return value
    if kind is int:
        return value if abs(value) < _EXACT_IN_JSON else {"$int": hex(value)}
    if kind is float:
        return value if abs(value) < float("inf") else {"$float": str(value)}
    if kind in (list, tuple, torch.Size):
        items = [_encode(item, f"{path}[{i}]", tensors) for i, item in enumerate(value)]
        return items if kind is list else {"$tuple" if kind is tuple else "$size": items}
    if kind in (dict, OrderedDict):
        return _encode_dict(value, path, tensors)
    if kind is TensorDict:
        return {
            "$tensordict": {k: _encode(v, f"{path}[{k!r}]", tensors) for k, v in value.items()},
            "batch_size": list(value.batch_size),
            "names": list(value.names) if any(value.names) else None,
            "device": value.device is not None,
        }
    if isinstance(value, Tensor) and value.layout is torch.strided and _has_data(value):
        return _encode_tensor(value, path, tensors)
    if kind is np.ndarray and _is_plain(value.dtype):
        # The copy is in C order and writeable, as torch requires.
        tensors[path] = torch.from_numpy(np.array(value, order="C").reshape(-1).view(np.uint8))
        return {"$array": path, "dtype": value.dtype.str, "shape": list(value.shape)}
    if isinstance(value, np.generic) and _is_plain(value.dtype):
        return {"$scalar": value.tobytes().hex(), "dtype": value.dtype.str}
    raise TypeError(
        f"{path} is a {kind.__module__}.{kind.__qualname__}, which a checkpoint cannot hold; "
        "turn it into tensors, arrays, numbers, strings, lists, tuples or dicts first"
    )


def _encode_dict(value: dict[Any, Any], path: str, tensors: dict[str, Tensor]) -> Any:
    for key in value:
        if type(key) not in (str, int):
            raise TypeError(
                f"{path} has the key {key!r} of type {type(key).__name__}, expected str or int"
            )
    items = {key: _encode(item, f"{path}[{key!r}]", tensors) for key, item in value.items()}
    if type(value) is OrderedDict:
        return {"$ordered": [[_encode(key, path, tensors), item] for key, item in items.items()]}
    if all(type(key) is str and not key.startswith("$") for key in items):
        return items
    return {"$dict": [[_encode(key, path, tensors), item] for key, item in items.items()]}


def _encode_tensor(value: Tensor, path: str, tensors: dict[str, Tensor]) -> Any:
    # Copied even if it is on the CPU, because safetensors rejects tensors that share memory.
    plain = value.detach().resolve_conj().resolve_neg().cpu()
    plain = plain.clone(memory_format=torch.contiguous_format)
    if value.dtype in _NATIVE_DTYPES:
        tensors[path] = plain
        return {"$tensor": path}
    tensors[path] = plain.reshape(-1).view(torch.uint8)
    return {"$tensor": path, "dtype": str(value.dtype), "shape": list(value.shape)}


def _decode(tree: Any, left: dict[str, Tensor]) -> Any:
    if isinstance(tree, list):
        return [_decode(item, left) for item in tree]
    if not isinstance(tree, dict):
        return tree
    tag = next(iter(tree), "")
    if not tag.startswith("$"):
        return {key: _decode(item, left) for key, item in tree.items()}
    content = tree[tag]
    match tag:
        case "$int":
            return int(content, 16)
        case "$float":
            return float(content)
        case "$tuple":
            return tuple(_decode(item, left) for item in content)
        case "$size":
            return torch.Size(content)
        case "$dict":
            return {_decode(key, left): _decode(item, left) for key, item in content}
        case "$ordered":
            return OrderedDict((_decode(key, left), _decode(item, left)) for key, item in content)
        case "$tensordict":
            return TensorDict(
                {key: _decode(item, left) for key, item in content.items()},
                batch_size=tree["batch_size"],
                names=tree["names"],
                device="cpu" if tree["device"] else None,
            )
        case "$tensor":
            return _decode_tensor(tree, _take(content, left))
        case "$array":
            data = _take(content, left).numpy().view(_numpy_dtype(tree["dtype"]))
            return data.reshape(tree["shape"])
        case "$scalar":
            return np.frombuffer(bytes.fromhex(content), _numpy_dtype(tree["dtype"]))[0]
        case _:
            raise ValueError(f"unknown tag {tag!r}")


def _decode_tensor(tree: dict[str, Any], tensor: Tensor) -> Tensor:
    if "dtype" not in tree:
        return tensor
    if tree["dtype"] not in _DTYPES:
        raise ValueError(f"unknown tensor dtype {tree['dtype']!r}")
    return tensor.view(_DTYPES[tree["dtype"]]).reshape(tree["shape"])


def _take(name: str, left: dict[str, Tensor]) -> Tensor:
    if name not in left:
        raise ValueError(f"no tensor for {name}")
    # Tensors read from a file may be unaligned in its memory map. Kernels can round differently
    # on unaligned memory, which would change a resumed run.
    return left.pop(name).clone()


def _has_data(tensor: Tensor) -> bool:
    return not (tensor.is_meta or tensor.is_nested or tensor.is_quantized or is_lazy(tensor))


def _is_plain(dtype: np.dtype[Any]) -> bool:
    """Whether a dtype is defined by its short name and holds no pointers or fields."""
    return not dtype.hasobject and dtype.kind != "V" and dtype.itemsize > 0


def _numpy_dtype(name: str) -> np.dtype[Any]:
    dtype = np.dtype(name)
    if not _is_plain(dtype):
        raise ValueError(f"numpy dtype {name!r} is not plain data")
    return dtype

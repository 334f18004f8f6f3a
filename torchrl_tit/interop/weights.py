"""Loads weights under new names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence

from torch import Tensor, nn

Renaming = Sequence[tuple[str, str]]
"""Pairs of a regular expression and its replacement, tried in order on the whole name."""


def load_renamed(network: nn.Module, params: Mapping[str, Tensor], renaming: Renaming) -> None:
    r"""Loads parameters with other names into a network; names must match one to one.

    Args:
        network: the network, changed in place.
        params: parameters by their old names.
        renaming: the first expression that matches a whole old name gives the new one.

    Raises:
        ValueError: if a name is unknown, or names or shapes do not match the network.

    Example:
        >>> import torch
        >>> linear = nn.Linear(2, 1, bias=False)
        >>> load_renamed(linear, {"old.w": torch.ones(1, 2)}, [(r"old\.w", "weight")])
        >>> linear.weight.tolist()
        [[1.0, 1.0]]
    """
    new_names = {name: _rename(name, renaming) for name in params}
    renamed = {new_names[name]: value for name, value in params.items()}
    own = network.state_dict()
    counts = Counter(new_names.values())
    problems = [f"{count} parameters for {name}" for name, count in counts.items() if count > 1]
    problems += [f"missing {name}" for name in own.keys() - renamed.keys()]
    problems += [f"left over {name}" for name in renamed.keys() - own.keys()]
    problems += [
        f"{name} has shape {tuple(renamed[name].shape)} instead of {tuple(own[name].shape)}"
        for name in own.keys() & renamed.keys()
        if renamed[name].shape != own[name].shape
    ]
    if problems:
        raise ValueError("the parameters do not fit the config: " + "; ".join(sorted(problems)))
    network.load_state_dict(renamed)


def strip_prefix(params: Mapping[str, Tensor], marker: str) -> dict[str, Tensor]:
    """Strips the prefix of one parameter from all names; drops parameters without the prefix.

    Args:
        params: parameters by name.
        marker: the name of a parameter without its prefix.

    Raises:
        ValueError: if there is no such parameter.

    Example:
        >>> import torch
        >>> w = torch.ones(1)
        >>> sorted(strip_prefix({"net.a.w": w, "net.b": w, "other": w}, "a.w"))
        ['a.w', 'b']
    """
    names = [name for name in params if name == marker or name.endswith(f".{marker}")]
    if not names:
        raise ValueError(f"there is no parameter {marker!r}: these are not the authors' parameters")
    prefix = names[0].removesuffix(marker)
    return {n.removeprefix(prefix): p for n, p in params.items() if n.startswith(prefix)}


def count_layers(params: Mapping[str, Tensor], pattern: str) -> int:
    r"""Counts the layers whose parameters match an expression with the index as its group.

    Example:
        >>> count_layers({"h.0.w": Tensor(), "h.1.w": Tensor(), "h.1.b": Tensor()}, r"h\.(\d+)\..*")
        2
    """
    matches = (re.fullmatch(pattern, name) for name in params)
    return len({match.group(1) for match in matches if match})


def size_of(params: Mapping[str, Tensor], name: str, axis: int = 0) -> int:
    """Returns the size of a parameter along an axis.

    Raises:
        ValueError: if there is no such parameter.
    """
    if name not in params:
        raise ValueError(f"there is no parameter {name!r}: these are not the authors' parameters")
    return params[name].shape[axis]


def _rename(name: str, renaming: Renaming) -> str:
    for pattern, replacement in renaming:
        if re.fullmatch(pattern, name):
            return re.sub(pattern, replacement, name)
    raise ValueError(f"unknown parameter {name!r}: it is not one of the authors' parameters")

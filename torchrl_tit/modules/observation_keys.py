"""Keys of the histories that a network reads."""

from __future__ import annotations

from collections.abc import Mapping

from tensordict import NestedKey
from torchrl.data import Composite


def history_keys(observation: object) -> list[NestedKey]:
    """Names the histories of a task's observations: the ``in_keys`` of a backbone.

    Args:
        observation: the argument that builds a network: the shape or spec of the only observation,
            or those of several by name (a mapping or a ``Composite``), as
            :func:`~torchrl_tit.envs.observation_specs` returns them.

    Returns:
        ``"history"`` for the only observation, or ``("history", NAME)`` for each.

    Example:
        >>> history_keys((4,)), history_keys({"image": (3, 84, 84), "state": (4,)})
        (['history'], [('history', 'image'), ('history', 'state')])
    """
    if isinstance(observation, Mapping | Composite):
        return [("history", name) for name in observation.keys()]  # noqa: SIM118
    return ["history"]

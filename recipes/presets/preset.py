"""A named recipe as data, for which neither its algorithm nor PyTorch is imported."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torchrl_tit.settings import Network


class Preset:
    """The name of an algorithm, and the fields of its recipe that differ from the defaults.

    Args:
        algorithm: its name, such as "ppo".
        **fields: the fields, with the recipe's name among them.

    Example:
        >>> from torchrl_tit.settings.networks import mlp
        >>> first = Preset("ppo", name="mine/first", env="CartPole-v1", backbone=mlp())
        >>> first.replace(name="mine/second").name
        'mine/second'
    """

    def __init__(self, algorithm: str, **fields: Any) -> None:
        self.algorithm = algorithm
        self.fields = fields

    @property
    def name(self) -> str:
        """The recipe's name."""
        return self.fields["name"]

    def replace(self, **fields: Any) -> Preset:
        """Returns a copy with other values of some fields."""
        return Preset(self.algorithm, **{**self.fields, **fields})


def of_networks(
    make: Callable[..., Preset], task: str, networks: Mapping[str, Network], **fields: Any
) -> list[Preset]:
    """Returns a recipe for each network, which is called ``TASK/NETWORK``.

    Args:
        make: the algorithm, one of those below.
        task: what the names begin with, such as ppo/cartpole.
        networks: the networks by name.
        **fields: the fields that all of them have.
    """
    return [
        make(name=f"{task}/{name}", backbone=network, **fields)
        for name, network in networks.items()
    ]


PPO, ContrastivePPO, NovelPPO, SmoothPPO, SAC, DQN, CQL, DiscreteCQL, BC, IQL, TD3BC, DT, ODT = (
    partial(Preset, algorithm)
    for algorithm in (
        *("ppo", "ppo-coberl", "ppo-noveld", "ppo-gsde", "sac", "dqn"),
        *("cql", "discrete-cql", "bc", "iql", "td3bc", "dt", "odt"),
    )
)

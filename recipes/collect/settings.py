"""What `data collect` is told to make."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

import tyro

from ..recipe import check_at_least, check_at_most
from .sac import SAC

Kind = Literal["random", "mixed", "medium", "expert"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""The kinds of data, in the order in which they are made."""


@dataclass(frozen=True, kw_only=True)
class Collection:
    """Data sets of one task and one agent, made the way D4RL's were (arXiv 2004.07219).

    An agent is trained until it reaches a mark: everything it saw until then is the mixed set
    ("medium-replay"), and what it does from then on, without learning, the medium set. At a second
    mark it is the expert. The random set has uniformly drawn actions.
    """

    env: Annotated[str, tyro.conf.Positional]
    """Name of the Gymnasium task, such as Hopper-v5, CartPole-v1 or ALE/Pong-v5."""
    agent: str = "sac"
    """What is trained: sac (continuous actions), or a PPO recipe by name or JSON file. Or what was
    trained before: the folder of a PPO run, which gives a medium or an expert set."""
    sets: tuple[Kind, ...] = ("random", "mixed", "medium", "expert")
    """Which sets are made. More can be asked for later, with the same folder."""
    transitions: int = 100_000
    """Transitions in a set, but for the mixed one, which has those that the training took; the last
    episode is played to its end."""
    medium_return: float | None = None
    """Mean return of the evaluation that ends the mixed set and makes the medium agent; where
    missing, these are those of the whole training."""
    expert_return: float | None = None
    """Mean return that makes the expert; where missing, that is the agent at the training's end."""
    total_steps: int = 1_000_000
    """Environment steps that the agent is trained for at most, and a PPO recipe no longer than it
    says itself. Can be raised later where a mark was not reached."""
    evaluation_interval: int = 5_000
    """Environment steps between the evaluations that marks are held against."""
    evaluation_episodes: int = 10
    """Episodes in each."""
    deterministic: bool = False
    """Whether medium and expert take their most likely actions, in the data and in the evaluations,
    instead of drawn ones."""
    num_envs: int = 8
    """Environments side by side that medium, expert and random sets are played in."""
    checkpoint_interval: int = 10_000
    """Environment steps of the training that a kill loses at most. Games and other tasks that
    cannot be saved begin new episodes at each checkpoint, so for these it should be large."""
    seed: int = 0
    """Seed of everything."""
    threads: int = 1
    """PyTorch's threads on the CPU."""
    sac: SAC = field(default_factory=SAC)
    """Settings of SAC."""

    def __post_init__(self) -> None:
        check_at_least(
            self,
            transitions=1,
            total_steps=1,
            evaluation_interval=1,
            evaluation_episodes=1,
            num_envs=1,
            checkpoint_interval=1,
            seed=0,
            threads=1,
        )
        check_at_most(self, seed=2**31)
        unknown = [kind for kind in self.sets if kind not in KINDS]
        if unknown or not self.sets or len(set(self.sets)) < len(self.sets):
            raise ValueError(
                f"sets must be some of {', '.join(KINDS)}, each once, not {list(self.sets)}"
            )
        for name in ("medium_return", "expert_return"):
            if (mark := getattr(self, name)) is not None and not math.isfinite(mark):
                raise ValueError(f"{name} must be finite, not {mark}")
        if self.medium_return is None and {"medium", "expert"} <= set(self.sets):
            raise ValueError(
                "medium and expert would be the same agent: give medium_return, the mean return at "
                "which it is medium, or ask for one of these sets"
            )
        if (
            self.medium_return is not None
            and self.expert_return is not None
            and not self.medium_return < self.expert_return
        ):
            raise ValueError(
                f"expert_return {self.expert_return:g} must be above medium_return "
                f"{self.medium_return:g}"
            )

    def mark(self, kind: Kind) -> tuple[str, float | None]:
        """The name of the mark that the agent of a kind of data must reach, and the mark."""
        name = "expert_return" if kind == "expert" else "medium_return"
        return name, getattr(self, name)

"""The settings of `data collect`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import tyro

from torchrl_tit.settings.checks import check_fields
from torchrl_tit.settings.numbers import Batch, Copies, Episodes, Real, Seed, Steps, Threads

Kind = Literal["random", "mixed", "medium", "expert"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""The kinds of data sets, in the order in which they are made."""


@dataclass(frozen=True, kw_only=True)
class Collection:
    """Data sets of one task and one agent, made the way D4RL's were (arXiv 2004.07219).

    An agent is trained until its mean return reaches a mark. The mixed set ("medium-replay")
    holds everything that the agent saw until then; the medium set holds episodes played with the
    weights of that point. At a second mark, the agent becomes the expert. The random set has
    uniformly random actions.
    """

    env: Annotated[str, tyro.conf.Positional]
    """Name of the Gymnasium task, such as Hopper-v5, CartPole-v1 or ALE/Pong-v5."""
    agent: str = "sac"
    """The agent: sac (SAC's defaults with an MLP, for continuous actions); any ppo or sac recipe,
    by name or as a JSON file; or the folder of a finished ppo or sac run, for a medium or an expert
    set."""
    sets: tuple[Kind, ...] = ("random", "mixed", "medium", "expert")
    """Which sets to make. More sets can be added to the same folder later."""
    transitions: Batch = 100_000
    """Minimum number of transitions in a set; the last episode is complete, unless a single one is
    longer than the set. The mixed set has as many as the training took."""
    medium_return: Real | None = None
    """Mean return in an evaluation at which the mixed set ends and the agent is medium; by default
    at the end of training."""
    expert_return: Real | None = None
    """Mean return in an evaluation at which the agent is the expert; by default at the end of
    training."""
    total_steps: Steps = 1_000_000
    """Maximum number of environment steps to train the agent for; the recipe's own maximum also
    holds. Can be raised later if a mark was not reached."""
    evaluation_interval: Steps = 5_000
    """Environment steps between the evaluations that are compared with the marks."""
    evaluation_episodes: Episodes = 10
    """Number of episodes in an evaluation."""
    deterministic: bool = False
    """Whether medium and expert agents take their most likely actions instead of sampled ones, in
    the data and in the evaluations."""
    num_envs: Copies = 8
    """Number of environments for medium, expert and random sets."""
    checkpoint_interval: Steps = 10_000
    """Environment steps between checkpoints of the training."""
    seed: Seed = 0
    """Seed of agent, environments and sets."""
    threads: Threads = 1
    """PyTorch's CPU threads."""

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.sets or len(set(self.sets)) < len(self.sets):
            raise ValueError(
                f"sets must be some of {', '.join(KINDS)}, each once, not {list(self.sets)}"
            )
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
        """Returns the name and the value of the mark that the agent of a set must reach."""
        name = "expert_return" if kind == "expert" else "medium_return"
        return name, getattr(self, name)

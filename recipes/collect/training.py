"""An agent on its way to a mark, and everything that it sees until then."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from gymnasium import Space
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint, save_checkpoint
from torchrl_tit.datasets import TransitionParts
from torchrl_tit.evaluation import evaluate
from torchrl_tit.files import write_text_atomic

from ..watcher import RecallingWatcher
from .rollout import as_fields

# Far from the seeds of training and of what is rolled out.
_EVALUATION_SEED = 1_000_000


class Learner(Protocol):
    """An algorithm with all that it needs, but for the folder."""

    algorithm: str
    """Its name."""
    final_step: int
    """Environment steps after which there is no more training."""

    def make_env(self, num_envs: int, seed: int) -> EnvBase:
        """Makes environments that the policy acts in."""

    def make_policy(self) -> TensorDictModuleBase:
        """Makes the policy, with weights that are still to be loaded."""

    def train(self, folder: Path, watcher: RecallingWatcher) -> None:
        """Trains from the newest of ``folder/checkpoints`` on, until the watcher says enough."""


@dataclass(frozen=True)
class Score:
    """What an agent was worth."""

    step: int
    """Environment steps that it was trained for."""
    mean: float
    """Mean return of evaluation episodes, with such actions as the data are to have."""
    std: float
    """Standard deviation of their returns (population)."""


def score_policy(
    policy: TensorDictModuleBase,
    step: int,
    make_env: Callable[[int, int], EnvBase],
    episodes: int,
    *,
    deterministic: bool,
) -> Score:
    """Evaluates a policy.

    Args:
        policy: the policy.
        step: environment steps that it was trained for.
        make_env: makes environments from their number and the seed of the first.
        episodes: how many it plays.
        deterministic: whether it takes its most likely actions instead of drawn ones.
    """
    returns = evaluate(
        lambda num_envs: make_env(num_envs, _EVALUATION_SEED),
        policy,
        episodes,
        seed=_EVALUATION_SEED,
        deterministic=deterministic,
    )
    return Score(step, returns.mean().item(), returns.std(correction=0).item())


class Training:
    """The training of one agent, in a folder from which it goes on.

        checkpoints/, metrics.csv, ...   what the algorithm keeps
        evaluations.json                 scores of the agent on the way
        agents/                          its weights where it reached a mark
        seen/                            all transitions, in parts

    It is the watcher of its own training: it keeps the transitions, evaluates the agent, and ends
    the training where a mark is reached, so that it can go on from there.

    Args:
        folder: the folder; made where missing.
        learner: the algorithm.
        action_space: the task's.
        marks: mean returns at which the agent is kept, beside that of the end.
        evaluation_interval: environment steps between evaluations.
        evaluation_episodes: episodes in each.
        deterministic: whether the most likely actions are taken in them.
    """

    def __init__(
        self,
        folder: Path,
        learner: Learner,
        action_space: Space,
        *,
        marks: list[float],
        evaluation_interval: int,
        evaluation_episodes: int,
        deterministic: bool,
    ) -> None:
        self._learner = learner
        self.parts = TransitionParts(folder / "seen")
        self._folder = folder
        self._action_space = action_space
        self._marks = marks
        self._interval = evaluation_interval
        self._episodes = evaluation_episodes
        self._deterministic = deterministic
        self._step = 0
        self._scores: list[Score] = []
        self._load()

    @property
    def algorithm(self) -> str:
        """The algorithm's name."""
        return self._learner.algorithm

    def make_env(self, num_envs: int, seed: int) -> EnvBase:
        """Makes environments that the policy acts in."""
        return self._learner.make_env(num_envs, seed)

    def reach(self, name: str, mark: float | None) -> Score:
        """Trains on until a mark is reached, unless it was before.

        Args:
            name: the mark's name, for messages.
            mark: a mean return, one of the marks; the end of the training where None.

        Returns:
            The first score that reached it.

        Raises:
            ValueError: if the training ends before that.
        """
        while (score := self._first(mark)) is None:
            if self._step >= self._learner.final_step:
                if mark is None or not self._scores:
                    raise ValueError(
                        f"{self._folder / 'evaluations.json'} has lost the evaluations: delete "
                        f"{self._folder} to train anew"
                    )
                best = max(score.mean for score in self._scores)
                raise ValueError(
                    f"{name} {mark:g} was never reached in {self._step} steps: the best of "
                    f"{len(self._scores)} evaluations had a mean return of {best:.1f}. Raise "
                    "total_steps, with which the same command goes on, or choose another mark and "
                    "another folder"
                )
            self._learner.train(self._folder, self)
            self._load()
        return score

    def load_policy(self, score: Score) -> TensorDictModuleBase:
        """Loads the policy that had a score, one of :meth:`reach`."""
        _, state = load_checkpoint(self._folder / "agents", score.step)
        policy = self._learner.make_policy()
        policy.load_state_dict(state)
        return policy.eval()

    def collected(self, step: int, batch: TensorDictBase) -> None:
        """Keeps the transitions."""
        fields = as_fields(batch, self._action_space)
        self.parts.write(step, {name: tensor.numpy() for name, tensor in fields.items()})

    def updated(self, step: int, policy: TensorDictModuleBase) -> bool:
        """Evaluates the agent where that is due; says whether it is the first to reach a mark."""
        before, self._step = self._step, step
        ends = step >= self._learner.final_step
        if not ends and (not self._marks or step // self._interval == before // self._interval):
            return False
        score = score_policy(
            policy, step, self.make_env, self._episodes, deterministic=self._deterministic
        )
        self._scores.append(score)
        scores = json.dumps([asdict(score) for score in self._scores], indent=2) + "\n"
        write_text_atomic(self._folder / "evaluations.json", scores)
        if not ends and all(self._first(mark) is not score for mark in self._marks):
            return False
        # All are kept: there are no more than marks, and ends that were put off.
        save_checkpoint(self._folder / "agents", step, policy.state_dict(), keep=step)
        return True

    def recall(self, step: int) -> Iterator[TensorDictBase]:
        """Gives back the transitions up to a step."""
        for number in self.parts.numbers(step):
            fields = {
                name: torch.from_numpy(array) for name, array in self.parts.read(number).items()
            }
            yield as_batch(fields)

    def _first(self, mark: float | None) -> Score | None:
        """The first score that reached a mark, or that of the end."""
        if mark is None:
            reached = (s for s in self._scores if s.step >= self._learner.final_step)
        else:
            reached = (s for s in self._scores if s.mean >= mark)
        return next(reached, None)

    def _load(self) -> None:
        """Takes over what belongs to the newest checkpoint; what came after it is done again."""
        self._step = max(checkpoint_steps(self._folder / "checkpoints"), default=0)
        path = self._folder / "evaluations.json"
        scores = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
        self._scores = [Score(**score) for score in scores if score["step"] <= self._step]
        self.parts.drop_after(self._step)


def as_batch(fields: dict[str, Any]) -> TensorDict:
    """Transitions under TorchRL's names.

    Args:
        fields: D4RL's fields, tensors [envs, time, ...].

    Returns:
        A tensordict [envs, time].
    """
    terminated, truncated = (fields[name].unsqueeze(-1) for name in ("terminals", "timeouts"))
    return TensorDict(
        {
            "observation": fields["observations"],
            "action": fields["actions"],
            "next": {
                "observation": fields["next_observations"],
                "reward": fields["rewards"].unsqueeze(-1),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
        },
        fields["rewards"].shape,
    )

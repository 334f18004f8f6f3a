"""Whose data are collected: SAC, a PPO recipe, or a run that was trained before."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_tit.envs import make_env
from torchrl_tit.files import write_text_atomic

from ..ppo.agent import Agent
from ..ppo.recipe import PPO
from ..ppo.training import train as train_ppo
from ..recipe import Recipe, recipe_to_json
from ..registry import find_recipe
from ..run import Run
from ..watcher import RecallingWatcher
from . import sac
from .settings import Collection
from .training import Score, score_policy


class SACLearner:
    """Soft actor-critic, for continuous actions.

    Args:
        settings: what is collected.

    Raises:
        ValueError: if the task cannot be made, its actions are not continuous, or its observations
            are pictures.
    """

    algorithm = "SAC"
    recipe = None

    def __init__(self, settings: Collection) -> None:
        self.final_step = settings.total_steps
        self._settings = settings
        with closing(self.make_env(1, settings.seed)) as env:
            if not env.action_spec.dtype.is_floating_point:
                raise ValueError(
                    f"sac needs continuous actions, but those of {settings.env} are discrete: name "
                    "a PPO recipe with --agent, such as ppo/cartpole/mlp"
                )
            if env.observation_spec["observation"].ndim != 2:
                raise ValueError(
                    f"sac reads arrays, but {settings.env} has observations of another shape: name "
                    "a PPO recipe with --agent"
                )

    def make_env(self, num_envs: int, seed: int) -> EnvBase:
        """Makes environments whose action spec has the task's bounds."""
        return make_env(self._settings.env, num_envs, seed=seed, clip_actions=False)

    def make_policy(self) -> TensorDictModuleBase:
        """Makes the actor."""
        with closing(self.make_env(1, self._settings.seed)) as env:
            return self._settings.sac.make_actor(env)

    def train(self, folder: Path, watcher: RecallingWatcher) -> None:
        """Trains from the newest checkpoint on."""
        sac.train(
            self._settings.sac,
            self.make_env,
            folder,
            watcher,
            total_steps=self.final_step,
            checkpoint_interval=self._settings.checkpoint_interval,
            seed=self._settings.seed,
        )


class PPOLearner:
    """A PPO recipe, whose learning rate and the like fall as over its own full length.

    Args:
        recipe: the recipe; seed, threads and checkpoints are those of what is collected.
        settings: what is collected.

    Raises:
        ValueError: if the recipe is of another task or algorithm, hides a part of the observations,
            or cannot be run.
    """

    algorithm = "PPO"

    def __init__(self, recipe: Recipe, settings: Collection) -> None:
        self.recipe = replace(
            _check(recipe, settings.env),
            seed=settings.seed,
            threads=settings.threads,
            checkpoint_interval=settings.checkpoint_interval,
            collectors=1,  # the batches of several do not go on from one to the next
            async_collection=False,
        )
        self.recipe.check()
        self.final_step = min(self.recipe.final_step, settings.total_steps)

    def make_env(self, num_envs: int, seed: int) -> EnvBase:
        """Makes environments with the recipe's history."""
        return self.recipe.make_env(num_envs, seed)

    def make_policy(self) -> TensorDictModuleBase:
        """Makes the agent's policy."""
        with closing(self.make_env(1, self.recipe.seed)) as env:
            return Agent(self.recipe, env).policy

    def train(self, folder: Path, watcher: RecallingWatcher) -> None:
        """Trains from the newest checkpoint on, in a run folder."""
        folder.mkdir(parents=True, exist_ok=True)
        write_text_atomic(folder / "recipe.json", recipe_to_json(self.recipe))
        with Run(folder, self.recipe) as run:
            train_ppo(self.recipe, run, watcher)


class FinishedRun:
    """The newest checkpoint of a PPO run: an agent without the data that it was trained on.

    Args:
        settings: what is collected, with the run's folder as its agent.

    Raises:
        ValueError: if it is a run of another task or algorithm.
        FileNotFoundError: if there is no checkpoint.
    """

    algorithm = "PPO"

    def __init__(self, settings: Collection) -> None:
        self._folder = Path(settings.agent)
        self._settings = settings
        run = Run.open(self._folder)
        self.recipe = replace(_check(run.recipe, settings.env), threads=settings.threads)
        self._step, self._agent = self.recipe.load_agent(run)

    def make_env(self, num_envs: int, seed: int) -> EnvBase:
        """Makes environments with the recipe's history."""
        return self.recipe.make_env(num_envs, seed)

    def reach(self, name: str, mark: float | None) -> Score:
        """Evaluates the agent.

        Raises:
            ValueError: if it is below the mark.
        """
        score = score_policy(
            self._agent.policy,
            self._step,
            self.make_env,
            self._settings.evaluation_episodes,
            deterministic=self._settings.deterministic,
        )
        if mark is not None and score.mean < mark:
            raise ValueError(
                f"{name} {mark:g} is not reached by the run in {self._folder}: its agent has a "
                f"mean return of {score.mean:.1f} after {self._step} steps"
            )
        return score

    def load_policy(self, score: Score) -> TensorDictModuleBase:
        """The agent's policy."""
        return self._agent.policy.eval()


Source = SACLearner | PPOLearner | FinishedRun
"""Where an agent comes from."""


def find_agent(settings: Collection) -> Source | None:
    """Finds what the settings call the agent, and checks that it fits the task.

    Returns:
        The agent; None where no set needs one.

    Raises:
        ValueError: if there is none of that name, or it does not fit the task or the sets.
        FileNotFoundError: if it is a run without a checkpoint, or a JSON file that is not there.
    """
    if set(settings.sets) == {"random"}:
        return None
    if (Path(settings.agent) / "recipe.json").is_file():
        if "mixed" in settings.sets:
            raise ValueError(
                f"the run in {settings.agent} has kept nothing of what it saw, so it gives no "
                "mixed set: leave that out with --sets, or train a recipe with --agent"
            )
        return FinishedRun(settings)
    if settings.agent == "sac":
        return SACLearner(settings)
    return PPOLearner(find_recipe(settings.agent), settings)


def _check(recipe: Recipe, env: str) -> PPO:
    """The recipe, if data of a task can be collected with it."""
    if not isinstance(recipe, PPO):
        raise ValueError(
            f"data are collected with sac or a PPO recipe, but {recipe.name or 'that'} is one of "
            f"{recipe.algorithm}"
        )
    problem = None
    if recipe.env != env:
        problem = f"is of the task {recipe.env}, not {env}"
    elif recipe.hide_velocities:
        problem = "hides the velocities, which the data are to have"
    if problem:
        raise ValueError(f"the recipe {recipe.name} {problem}: choose another one with --agent")
    return recipe

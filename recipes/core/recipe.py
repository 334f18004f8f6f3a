"""The base classes of recipes: the settings of an experiment, without its code."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

from torchrl_tit.settings import Network
from torchrl_tit.settings.checks import check_fields
from torchrl_tit.settings.choices import Device, Gaps, ImageLayout
from torchrl_tit.settings.literals import parse_assignments, parse_call
from torchrl_tit.settings.numbers import (
    Batch,
    Episodes,
    Probability,
    Seed,
    Steps,
    StepsOrNone,
    Threads,
)
from torchrl_tit.settings.parts import Names

try:
    from tyro.conf import Suppress
except ModuleNotFoundError:  # an extra: only the command line reads this mark
    Suppress = None  # type: ignore[misc]

Compile = Literal["auto", "on", "off"]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Settings that every experiment has.

    Each algorithm has a subclass, which is registered when it is defined, by the name of its
    ``algorithm`` in JSON and on the command line. Its :meth:`build` makes the algorithm.
    """

    algorithm: ClassVar[str]
    registered: ClassVar[Names[type[Recipe]]] = Names("algorithm")
    """Recipes by the name of their algorithm."""
    offline: ClassVar[bool] = False
    """Whether it trains offline: steps are gradient steps, and returns are from evaluations."""
    supplies_actions: ClassVar[bool] = False
    """Whether networks read past actions and returns-to-go in addition to observations."""
    removed: ClassVar[dict[str, Any]] = {}
    """Fields of older versions that no longer exist, with the values at which they did nothing."""
    length: ClassVar[str] = "total_steps"
    """The field that sets the length of a run, which ``train --resume RUN`` can raise."""

    name: Annotated[str, Suppress] = ""
    """The recipe's name, such as ppo/cartpole/enhanced-tit."""
    backbone: Network
    """The network: its frame encoder, its history encoder, and the number of frames it reads."""
    env: str
    """The task: the name of a Gymnasium environment, or module:Name for one that the module
    registers or for a TorchRL environment in it."""
    env_settings: tuple[str, ...] = ()
    """Settings of the task, such as is_slippery=False map_name=8x8."""
    wrappers: tuple[str, ...] = ()
    """Gymnasium wrappers and TorchRL transforms around the task, the innermost first, such as
    "minigrid.wrappers:RGBImgPartialObsWrapper(tile_size=8)"."""
    observation_keys: tuple[str, ...] = ()
    """Which observations are read, if the task has several; all by default."""
    image_layout: ImageLayout = "auto"
    """Order of an image's dimensions, for images whose sizes do not determine it."""
    seed: Seed = 0
    """Seed of the networks, the environments and the order of minibatches."""
    device: Device = "cpu"
    """Device of the networks: cpu, cuda, cuda:1, mps, ...; "auto" is the GPU if there is one."""
    threads: Threads = 1
    """PyTorch's CPU threads; small networks are fastest with one."""
    log_interval: Steps = 1
    """Steps between rows of metrics; at least one batch."""
    checkpoint_interval: Steps = 10_000
    """Steps between checkpoints."""
    evaluation_episodes: Episodes = 100
    """Number of episodes in an evaluation."""
    evaluation_seed: Seed = 1_000_000
    """Seed of the first evaluation episode; episode i has this seed + i."""

    def __init_subclass__(cls, *, algorithm: str | None = None) -> None:
        super().__init_subclass__()
        if algorithm is not None:  # base classes of several algorithms have none
            Recipe.registered.add(algorithm, cls, f"{cls.__module__}.{cls.__qualname__}")
            cls.algorithm = algorithm

    def build(self) -> Any:
        """Builds the :class:`~recipes.core.algorithm.Algorithm` with these settings.

        Raises:
            ValueError: if its networks cannot be built with them.
        """
        raise NotImplementedError

    def __post_init__(self) -> None:
        if not isinstance(self.backbone, Network):
            raise ValueError(
                f"field 'backbone' must be the settings of a network, such as "
                f"torchrl_tit.settings.networks.mlp(), not {self.backbone!r}"
            )
        _check_all(self)
        if self.backbone.history.reads_actions and not self.supplies_actions:
            raise ValueError(
                f"{self.backbone.history.name} reads actions and returns beside observations, "
                f"which {self.algorithm} does not supply: use a dt or odt recipe"
            )
        parse_assignments(self.env_settings)
        for wrapper in self.wrappers:
            _, _, name = parse_call(wrapper)[0].partition(":")
            if name in _LEARNS:
                raise ValueError(
                    f"{wrapper} learns statistics, which neither evaluations nor a saved agent "
                    f"would have: use the field {_LEARNS[name]} instead"
                )
        if self.name and not re.fullmatch(r"\w[\w.-]*(/\w[\w.-]*)*", self.name):
            raise ValueError(
                f"name must be words joined by '/', such as ppo/cartpole/mine, not {self.name!r}"
            )

    @property
    def task_settings(self) -> dict[str, Any]:
        """The values of :attr:`env_settings` by name."""
        return parse_assignments(self.env_settings)

    @property
    def final_step(self) -> int:
        """Environment steps, or gradient steps, at which training is complete."""
        raise NotImplementedError

    @property
    def schedules(self) -> tuple[str, ...]:
        """The active fields that make training depend on the length of the whole run."""
        return ()

    @property
    def task_name(self) -> str:
        """The environment's name; without one, that of the data."""
        return self.env

    @property
    def unit(self) -> str:
        """The unit of its steps: "updates" offline, else "steps" of the environment."""
        return "updates" if self.offline else "steps"

    @property
    def target_columns(self) -> dict[float | None, str]:
        """Columns of metrics for each target return of the evaluations."""
        return {}

    def evaluation_due(self, before: int, step: int) -> bool:
        """Returns whether to evaluate after a batch, in addition to the evaluation at the end.

        Args:
            before: number of steps before the batch.
            step: number of steps after it.
        """
        return False

    def check_divides(self, field: str, name: str, value: int) -> None:
        """Raises ValueError if a field does not divide a value."""
        if value % getattr(self, field):
            raise ValueError(
                f"{field} {getattr(self, field)} does not divide {name} {value}: change one of them"
            )


@dataclass(frozen=True, kw_only=True)
class SamplesRecipe(Recipe):
    """Settings of every recipe that learns from samples of transitions."""

    batch_size: Batch = 256
    """Transitions in one gradient step, sampled with replacement."""
    slice_length: Batch = 1
    """Number of consecutive transitions that are drawn together, so that a backbone encodes their
    frames once; must divide batch_size. 1 draws transitions one by one, from which a network that
    carries a state cannot learn."""
    burn_in: StepsOrNone = 0
    """Number of steps before each slice that a network that carries a state reads first, from a
    state of zeros and without gradient. They do not count as transitions."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_divides("slice_length", "batch_size", self.batch_size)
        name, carries_state = self.backbone.history.name, self.backbone.carries_state
        if carries_state and self.slice_length == 1:
            raise ValueError(
                f"{name} carries a state and learns from sequences, but slice_length is 1: set it "
                "to their number of steps, such as 16, or backbone.num_frames to 2 or more"
            )
        if self.burn_in and not carries_state:
            raise ValueError(
                f"burn_in is {self.burn_in}, but {name} carries no state here: set it to 0"
            )

    @property
    def critic_backbone(self) -> Network | None:
        """The settings of each critic's backbone; None if it reads the newest observation."""
        return self.backbone if getattr(self, "critic", "") == "backbone" else None

    @property
    def drawn_length(self) -> int:
        """Number of consecutive steps that are drawn together, with those of the burn-in."""
        return self.burn_in + self.slice_length

    @property
    def drawn_size(self) -> int:
        """Number of steps in all that are drawn for one gradient step."""
        return self.batch_size // self.slice_length * self.drawn_length


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe(Recipe):
    """Settings of every recipe that trains on a data set.

    The policy is evaluated in an environment, if there is one, and measured on held-out episodes,
    if there are any.
    """

    offline: ClassVar[bool] = True

    dataset: str
    """A data set: a file in D4RL's layout, or the name of one of D4RL's or Minari's."""
    env: str = ""
    """Name of the Gymnasium environment that the network is evaluated in. Without one, the data
    alone say what observations and actions are, and env_settings records it."""
    validation_fraction: Probability | None = None
    """Share of the episodes that are held out of training and that the networks are measured on,
    chosen by the seed; by default a tenth without an environment, and none with one."""
    max_episode_steps: Steps | None = None
    """Time limit of the task, for data files that do not record it; see docs/datasets.md."""
    gaps: Gaps = "error"
    """What to do at gaps in a data file's next observations or timestamps: "error" refuses the
    data, "cut" ends the episode there."""
    batch_size: Batch = 64
    """Batch size of a gradient step."""
    storage_device: Device = "cpu"
    """Device of the stored data, from which batches are moved to the networks; the CPU if these are
    there. "cuda" is faster if all data fit on the GPU."""
    log_interval: Steps = 100
    """Gradient steps between rows of metrics."""
    checkpoint_interval: Steps = 1000
    """Gradient steps between checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.env or self.held_out_fraction):
            raise ValueError(
                "validation_fraction is 0, and there is no environment, so nothing would tell how "
                "good the policy is: hold at least one episode out, such as 0.01 of them"
            )

    def reading(self) -> dict[str, Any]:
        """How the data are read: arguments of :func:`~torchrl_tit.datasets.load_episodes`."""
        return {"max_episode_steps": self.max_episode_steps, "gaps": self.gaps}

    @property
    def held_out_fraction(self) -> float:
        """The share of the episodes that are held out."""
        if self.validation_fraction is None:
            return 0.0 if self.env else 0.1
        return self.validation_fraction

    @property
    def task_name(self) -> str:
        """The environment's name; without one, that of the data."""
        return self.env or self.dataset or "the data"


_LEARNS = {
    "NormalizeObservation": "normalize_observations",
    "NormalizeReward": "normalize_rewards",
    "VecNorm": "normalize_observations",
    "VecNormV2": "normalize_observations",
}
"""Wrappers whose statistics each environment learns for itself, and what to use instead."""
_OF_THE_MACHINE = ("device", "storage_device", "threads", "compile", "checkpoint_interval")


def experiment_of(recipe: Recipe) -> Recipe:
    """Returns the settings that runs of one experiment share: all settings but seed and machine.

    Example:
        >>> from torchrl_tit.settings.networks import mlp
        >>> from recipes.ppo import PPO
        >>> recipe = PPO(env="CartPole-v1", backbone=mlp(), seed=3, threads=2, compile="off")
        >>> experiment_of(recipe) == PPO(env="CartPole-v1", backbone=mlp())
        True
    """
    defaults: dict[str, Any] = {
        f.name: f.default for f in fields(recipe) if f.name in _OF_THE_MACHINE
    }
    return replace(recipe, seed=0, **defaults)


def _check_all(settings: object) -> None:
    """Checks settings and nested settings, because a user's own part may not check its fields."""
    check_fields(settings)
    for value in vars(settings).values():
        for part in value.values() if isinstance(value, Mapping) else [value]:
            if is_dataclass(part):
                _check_all(part)


_MODULES = {
    "bc": "bc",
    "cql": "cql",
    "discrete-cql": "cql",
    "dqn": "dqn",
    "dt": "decision_transformer",
    "iql": "iql",
    "odt": "online_decision_transformer",
    "ppo": "ppo",
    "ppo-coberl": "coberl",
    "ppo-gsde": "gsde",
    "ppo-noveld": "novelty",
    "sac": "sac",
    "td3bc": "td3bc",
}
"""The modules of this package's algorithms, which are imported when one of them is looked up."""

LENGTHS = ("total_steps", "total_updates", "iterations", "rounds")
"""The fields that set the length of a run, of all of these algorithms."""


def recipe_classes() -> dict[str, type[Recipe]]:
    """Imports all algorithms, and returns their recipe classes by name.

    Example:
        >>> recipe_classes()["sac"].length
        'total_steps'
    """
    for module in sorted({*_MODULES.values()}):
        importlib.import_module(f"..{module}", __package__)
    return dict(Recipe.registered)


def get_recipe_class(algorithm: str) -> type[Recipe]:
    """Looks up the recipe class of an algorithm, including those of installed plugins.

    Raises:
        ValueError: if there is no such algorithm, or more than one.
    """
    if str(algorithm) in _MODULES:
        importlib.import_module(f"..{_MODULES[algorithm]}", __package__)
    else:  # of a plugin, or misspelled: similar names are suggested
        recipe_classes()
    return Recipe.registered.find(algorithm)

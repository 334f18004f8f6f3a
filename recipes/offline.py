"""What algorithms share that learn from a data set: from windows, or from transitions of it."""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol, TypeVar

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, Space
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import MultiCategorical, ReplayBuffer
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

from torchrl_tit.datasets import (
    DatasetError,
    Episodes,
    EpisodeStorage,
    HistoryStorage,
    TaskSpaces,
    load_episodes,
    make_replay_buffer,
    split_episodes,
    task_spaces,
)
from torchrl_tit.datasets.checks import check_actions, check_bytes, check_shape
from torchrl_tit.datasets.episodes import memory_mapped_rows, rows_per_chunk
from torchrl_tit.envs import make_env, observation_specs
from torchrl_tit.envs.spaces import ObservationReader
from torchrl_tit.evaluation import used_gpus
from torchrl_tit.networks.building import evaluating
from torchrl_tit.settings.choices import ImageLayout, Padding
from torchrl_tit.settings.numbers import Batch, Fraction, Steps, Widths
from torchrl_tit.settings.numbers import Episodes as EpisodeCount

from .core.algorithm import (
    Algorithm,
    Stateful,
    storage_device,
    to_networks,
)
from .core.compilation import check_compiler, compile_and_time, should_compile
from .core.evaluation import HeldOut
from .core.networks import (
    LearnsFromSamples,
    arranging,
    check_normalizes,
    set_statistics,
    state_transforms,
)
from .core.recipe import Compile, DatasetRecipe, Recipe, SamplesRecipe
from .core.task import make_task


class Buffer(Stateful, Protocol):
    """A source of batches, such as a replay buffer."""

    def sample(self) -> TensorDictBase:
        """Samples a batch."""


DatasetRecipeT = TypeVar("DatasetRecipeT", bound=DatasetRecipe)


def read_data(recipe: DatasetRecipe) -> Episodes:
    """Reads the data set of a recipe, unless it is the one that was read last and has not changed.

    Raises:
        FileNotFoundError: if there are no such data.
        DatasetError: if they cannot be used, or belong to another task.
        ValueError: if the recipe names none.
    """
    if not recipe.dataset:
        raise ValueError(
            f"{recipe.name or recipe.algorithm} is a recipe for any data: name them with "
            "--dataset FILE"
        )
    path = Path(recipe.dataset)
    files = [path, *path.rglob("*")] if path.is_dir() else [path]
    stamps = {file: file.stat().st_mtime_ns for file in files if file.exists()}
    settings = (recipe.wrappers, recipe.env_settings, recipe.observation_keys)
    task = (recipe.env, *settings) if recipe.env else ()
    reading = (*recipe.reading().values(), recipe.image_layout, task)
    key = repr((recipe.dataset, path.absolute(), reading, stamps))
    if key not in _NEWEST:
        _NEWEST.clear()  # frees their memory first
        _NEWEST[key] = load_data(recipe, recipe.dataset, **recipe.reading())
    episodes, spaces = _NEWEST[key], recipe.task_settings
    if recipe.env or "observation_shape" not in spaces:
        return episodes
    return _checked(episodes, spaces)


_NEWEST: dict[str, Episodes] = {}
"""The episodes that were read last, by what they were read from: commands need them repeatedly."""


def load_data(recipe: Recipe, source: str, **reading: Any) -> Episodes:
    """Loads a data set as the task has it: channels first, flat actions, what is discrete from 0.

    Args:
        recipe: its task is that of the data.
        source: the data set.
        **reading: passed to :func:`~torchrl_tit.datasets.load_episodes`.

    Raises:
        FileNotFoundError: if there are no such data.
        DatasetError: if they cannot be used, or belong to another task.
        ValueError: if the task cannot be made.
    """
    names = ("wrappers", "observation_keys", "image_layout")
    reads: dict[str, Any] = {name: getattr(recipe, name) for name in names}
    spaces = task_spaces(recipe.env, **reads, **recipe.task_settings) if recipe.env else None
    episodes = load_episodes(source, task=spaces, **reading)
    if np.any(start := getattr(spaces and spaces.action, "start", 0)):
        episodes.rows["action"] -= torch.as_tensor(start)
    stored = episodes.rows["observation"]
    if spaces is not None:
        _convert(episodes, spaces.observation, recipe.image_layout)
        if (action := episodes.rows["action"]).ndim > 2:
            episodes.rows["action"] = action.flatten(1)
    elif stored.ndim == 4:  # images with channels
        kind = np.uint8 if stored.dtype == torch.uint8 else np.float32
        _convert(episodes, Box(0, 255, tuple(stored.shape[1:]), kind), recipe.image_layout)
    return episodes


def _convert(episodes: Episodes, space: Space, layout: ImageLayout) -> None:
    """Replaces the observations by those that an environment with this space writes.

    Raises:
        DatasetError: if categories are no integers, or there is none of that number.
        ValueError: if it is not clear where images have their channels.
    """
    [leaf] = ObservationReader(space, image_layout=layout).leaves.values()
    spec, stored = leaf.spec, episodes.rows["observation"]
    categories = isinstance(spec, MultiCategorical)
    if not categories and (stored.shape[1:], stored.dtype) == (spec.shape, spec.dtype):
        return
    if categories and stored.is_floating_point():
        problem = "are floats, but the task counts categories: store integers."
        raise DatasetError(episodes.source, problem, "observations")
    field = {"observation": (tuple(spec.shape), spec.dtype)}
    found = memory_mapped_rows(len(stored), field)["observation"]
    size = rows_per_chunk(8 * stored[0].numel())
    for part in (slice(start, start + size) for start in range(0, len(stored), size)):
        found[part] = torch.from_numpy(leaf.read(stored[part].numpy()))
    if categories:
        found[episodes.last_rows[~episodes.final_known] + 1] = 0  # zeros before the shift
        if len(wrong := found[((found < 0) | (found >= spec.nvec)).any(-1)]):
            problem = f"are {(wrong[0] + leaf.start).tolist()}, which {space} does not have."
            raise DatasetError(episodes.source, problem, "observations")
    episodes.rows["observation"] = found


def _checked(episodes: Episodes, spaces: Mapping[str, Any]) -> Episodes:
    """Checks episodes against spaces that other data said, and reshapes discrete actions to [R].

    Raises:
        DatasetError: if shapes differ, or an action is outside.
    """
    source, rows = episodes.source, episodes.rows.copy()
    shape, kind = tuple(spaces["observation_shape"]), spaces.get("observation_dtype", "float32")
    observation, action = Box(0, 255, shape, np.dtype(kind).type), rows["action"]
    if "num_actions" in spaces:
        space: Space = Discrete(spaces["num_actions"])
        rows["action"] = action = action.squeeze(-1) if action.shape[1:] == (1,) else action
    else:
        low, high = (np.atleast_1d(np.float32(spaces[name])) for name in ("low", "high"))
        space = Box(low, high)
    task = TaskSpaces(observation, space, "the recipe")
    check_shape(source, "observations", tuple(rows["observation"].shape[1:]), observation, task)
    check_bytes(source, rows["observation"].dtype, observation, task)
    check_shape(source, "actions", tuple(action.shape[1:]), space, task)
    check_actions(source, action[episodes.step_rows].numpy(), space)
    return replace(episodes, rows=rows)


def with_spaces(recipe: DatasetRecipeT) -> DatasetRecipeT:
    """Adds what the data say about observations and actions to a recipe without an environment.

    They become its ``env_settings``, so that its policy can act without the data. Continuous
    actions range from -1 to 1 if all are within, otherwise from the lowest to the highest of each
    entry, and from 1 below to 1 above an entry that is constant. Settings that the recipe has
    already are kept.

    Raises:
        DatasetError: if the observations are of another kind, or actions exceed the bounds that the
            recipe has already.
    """
    known = recipe.task_settings
    if recipe.env or "observation_shape" in known:
        return recipe
    episodes = read_data(recipe)
    observation, action = episodes.rows["observation"], episodes.rows["action"]
    if not (observation.is_floating_point() or observation.dtype == torch.uint8):
        problem = f"is {observation.dtype}: store arrays as floats, and images as uint8."
        raise DatasetError(episodes.source, problem, "observations")
    kind = "uint8" if observation.dtype == torch.uint8 else "float32"
    found: dict[str, Any] = {
        "observation_shape": list(observation.shape[1:]),
        "observation_dtype": kind,
    }
    steps, discrete = action[episodes.step_rows], not action.is_floating_point()
    if steps.shape[1:] not in ((), (1,)) if discrete else steps.ndim != 2:
        problem = (
            f"are {action.dtype} {list(steps.shape)}: store continuous actions as floats [N, A], "
            "and one choice as integers [N]."
        )
        raise DatasetError(episodes.source, problem, "actions")
    if discrete:
        found["num_actions"] = max(1, int(steps.max()) + 1)  # negative ones are refused below
    else:
        low, high = steps.amin(0), steps.amax(0)
        if low.min() >= -1 and high.max() <= 1:
            low, high = -torch.ones_like(low), torch.ones_like(high)
        constant = low == high
        for entry in constant.nonzero().flatten().tolist():
            warnings.warn(
                f"{episodes.source}: entry {entry} of all actions is {low[entry]:g}, so its bounds "
                f"are {low[entry] - 1:g} and {high[entry] + 1:g}",
                stacklevel=2,
            )
        found |= {"low": (low - 1.0 * constant).tolist(), "high": (high + 1.0 * constant).tolist()}
        make_env("", **{**found, **known}).close()  # checks what the recipe has already
    settings = {**found, **known}
    _checked(episodes, settings)
    return replace(recipe, env_settings=tuple(f"{x}={value}" for x, value in settings.items()))


BY_DATA: Mapping[str, float] = {"limit": math.inf, "eps": 1e-3}
"""Normalization by the statistics of a data set, as the authors of TD3+BC and d3rlpy do it."""
_MOST_MEASURED = 10_000
"""Items of held-out episodes that are measured, evenly spaced if there are more."""
_MEASURED_AT_ONCE = 500


class DatasetAlgorithm(Algorithm[DatasetRecipeT]):
    """An algorithm that samples its batches from a replay buffer of a data set.

    Args:
        recipe: the settings.
    """

    buffer: Buffer
    """The replay buffer, once :meth:`prepare` has made it."""
    measures: ClassVar[tuple[str, ...]] = ("action_error",)
    """Names of what :meth:`measure_batch` measures, the error by which weights are chosen first."""

    def __init__(self, recipe: DatasetRecipeT) -> None:
        super().__init__(with_spaces(recipe))
        self._held_out: Episodes | None = None
        if self.recipe.held_out_fraction:
            self.held_out_columns = [f"held_out_{name}" for name in self.measures]

    @abstractmethod
    def measured_items(self, episodes: Episodes) -> EpisodeStorage:
        """Cuts episodes into the items that are measured."""

    @abstractmethod
    def measure_batch(self, samples: TensorDictBase) -> Mapping[str, Tensor]:
        """Measures the networks on items of held-out episodes.

        Args:
            samples: transitions [B], slices [N, T], or windows [B].

        Returns:
            The mean of each of ``measures``, float [].
        """

    def split(self, episodes: Episodes) -> Episodes:
        """Holds some episodes out, and returns the others."""
        fraction = self.recipe.held_out_fraction
        if not fraction:
            return episodes
        rest, self._held_out = split_episodes(episodes, fraction, self.recipe.seed)
        return rest

    def measure(self, step: int, episodes: Episodes | None = None) -> HeldOut | None:
        """Measures the current weights, without dropout and with the most likely actions.

        Args:
            step: number of steps done so far.
            episodes: the episodes to measure them on; those that are held out if None.

        Raises:
            ValueError: if they have fewer transitions than a slice.
        """
        recipe = self.recipe
        if episodes is None and not recipe.held_out_fraction:
            return None
        if episodes is None and self._held_out is None:
            self.split(read_data(recipe))
        episodes = episodes or self._held_out
        assert episodes is not None
        episodes = episodes.to(storage_device(recipe))
        items, length = self.measured_items(episodes), getattr(recipe, "drawn_length", 1)
        arrange = arranging(recipe) or (lambda samples: samples)
        count = len(items) - length + 1
        if count < 1:
            raise ValueError(
                f"{episodes.source} has {len(items)} transitions, but the recipe measures slices "
                f"of {length}: use longer episodes"
            )
        size = getattr(recipe, "slice_length", 1)
        stride = max(size, math.ceil(count * size / _MOST_MEASURED))
        starts = torch.arange(0, count, stride)
        index = starts.unsqueeze(-1) + torch.arange(length) if length > 1 else starts
        parts = [*index.split(max(1, _MEASURED_AT_ONCE // length))]
        after = int(starts[-1]) + stride
        if len(items) - after > length - size:  # the steps that remain are a shorter slice
            parts.append(torch.arange(after, len(items)).unsqueeze(0))
        sums, total = dict.fromkeys(self.measures, 0.0), 0
        with (
            ExitStack() as modes,
            torch.random.fork_rng(used_gpus()),
            torch.no_grad(),
            set_exploration_type(ExplorationType.DETERMINISTIC),
        ):
            # A loss hides the networks of its critics from PyTorch.
            for part in (self.policy, self.model, *vars(self.model).values()):
                if isinstance(part, nn.Module):
                    modes.enter_context(evaluating(part))
            torch.manual_seed(recipe.evaluation_seed)
            for part in parts:
                samples = to_networks(arrange(items.get(part.to(items.device))), self.device)
                means, mask = self.measure_batch(samples), samples.get("mask", None)
                # Padding and the steps before a slice do not count.
                count = part.numel() - len(part) * (length - size)
                count = count if mask is None else int(mask.sum())
                total += count
                for name in sums:
                    sums[name] += means[name].item() * count
        values = {name: value / total for name, value in sums.items()}
        return HeldOut(step, items.num_episodes, values)

    @abstractmethod
    def make_buffer(self) -> Buffer:
        """Reads the data set into a replay buffer.

        Raises:
            FileNotFoundError: if there are no such data.
            DatasetError: if they cannot be used, or belong to another task.
            ValueError: if they do not fit the networks.
        """

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields batches from the replay buffer forever."""
        while True:
            yield to_networks(self.buffer.sample(), self.device)

    def check(self) -> None:
        """Lets the policy act once in the task, and reads the data unless they are remote."""
        super().check()
        dataset = self.recipe.dataset
        if dataset not in D4RL_DATASETS or Path(dataset).exists():
            self.make_buffer()


@dataclass(frozen=True, kw_only=True)
class TransitionRecipe(DatasetRecipe, SamplesRecipe):
    """Settings of every recipe that learns from transitions of a data set."""

    length: ClassVar[str] = "total_updates"

    padding: Padding = "same"
    """What fills a history before the first observation: that observation, or zeros."""
    total_updates: Steps = 500_000
    """Gradient steps to train for."""
    batch_size: Batch = 256
    """Transitions in one gradient step, sampled with replacement."""
    normalize_observations: bool = False
    """Whether to normalize observations by their mean and standard deviation in the data; only for
    arrays of floats."""
    time_limits: Literal["keep", "drop"] = "drop"
    """Whether to keep the last transition of an episode that a time limit truncated. D4RL's own
    function and d3rlpy 1.1.1, which the paper used, drop it."""
    unfinished: Literal["keep", "drop"] = "drop"
    """Whether to keep the last episode if the data stop before it ends."""
    evaluation_interval: Steps = 1000
    """Gradient steps between evaluations."""
    evaluation_episodes: EpisodeCount = 10
    """Number of episodes in an evaluation, played side by side."""
    compile: Compile = "auto"
    """Whether the losses run through torch.compile, which needs a C++ compiler and about a minute
    at the start. "auto" compiles if that works and the run is long enough to be worth it. Slices
    of several transitions are never compiled."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.compile == "on" and self.slice_length > 1:
            raise ValueError(
                f"compile is on, but slices of {self.slice_length} are not compiled, because their "
                "number of frames varies: set compile to off, or slice_length to 1"
            )

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.total_updates

    def evaluation_due(self, before: int, step: int) -> bool:
        """Returns whether to evaluate after a number of gradient steps."""
        return step % self.evaluation_interval == 0 or step == self.total_updates


@dataclass(frozen=True, kw_only=True)
class ActorCriticRecipe(TransitionRecipe):
    """Settings of algorithms with an actor and two critics, IQL and TD3+BC."""

    total_updates: Steps = 1_000_000
    """Gradient steps to train for."""
    gamma: Fraction = 0.99
    """Discount factor."""
    tau: Fraction = 0.005
    """Coefficient of the soft update of the target networks, from 0 to 1."""
    critic: Literal["mlp", "backbone"] = "mlp"
    """Whether value networks read the newest observation, or each has a backbone with the actor's
    settings."""
    critic_hidden: Widths = (256, 256)
    """Widths of the hidden layers of value networks."""
    evaluation_interval: Steps = 5000
    """Gradient steps between evaluations."""


def action_error(chosen: Tensor, action: Tensor) -> Tensor:
    """Mean squared error of continuous actions, or share of discrete ones that differ; float [].

    Example:
        >>> action_error(torch.tensor([0, 1]), torch.tensor([0, 2]))
        tensor(0.5000)
    """
    if action.is_floating_point():
        return (chosen - action).square().mean()
    return (chosen != action).float().mean()


def action_values(critic: TensorDictModuleBase, states: TensorDictBase, action: Tensor) -> Tensor:
    """A critic's values of actions in states [*B], which are left as they are; float [*B].

    The critic writes "state_action_value", one value or one for each discrete action.
    """
    values = critic(states.copy().set("action", action))["state_action_value"]
    if not action.is_floating_point():
        values = values.gather(-1, action.unsqueeze(-1))
    return values.squeeze(-1)


RecipeT = TypeVar("RecipeT", bound=TransitionRecipe)


class TransitionAlgorithm(LearnsFromSamples, DatasetAlgorithm[RecipeT]):
    """An algorithm whose model is a TorchRL loss on all its networks.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task has several observations, or observations that are to be normalized
            are not floats.
    """

    normalized_by = BY_DATA
    measures: ClassVar[tuple[str, ...]] = ("action_error", "q", "advantage")
    clips_actions: ClassVar[bool] = False
    """Whether the task clips actions, because the policy may exceed the bounds."""
    terminal_observations: ClassVar[Literal["keep", "zero"]] = "keep"
    """Whether observations of terminal states are kept, or replaced by zeros."""

    rates: ClassVar[Mapping[str, str]] = {"": "learning_rate"}
    """The fields with Adam's learning rates by the beginning of the names of weights in the model;
    the first that fits counts, and the last, "", fits all names."""

    optimizer: torch.optim.Optimizer
    """The optimizer of all weights, once :meth:`prepare` has made it."""
    target: SoftUpdate
    """The update of the target networks, if the recipe has a ``tau``, once it is made."""

    def __init__(self, recipe: RecipeT) -> None:
        super().__init__(recipe)
        recipe = self.recipe
        with closing(make_task(recipe, clip_actions=False)) as task:  # its spec has the bounds
            self.action_spec = task.action_spec_unbatched.to(self.device)
            observation = observation_specs(task)
            if isinstance(observation, dict):
                raise ValueError(
                    f"data sets hold one observation, but {recipe.env} has several "
                    f"({', '.join(observation)}): choose one with observation_keys"
                )
            if recipe.normalize_observations:
                check_normalizes(recipe.task_name, observation)
            self.model = self.networks(task).to(self.device)

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """Builds the task, with histories, and with the state of a recurrent network."""
        state, clips = state_transforms(self.policy), self.clips_actions
        return make_task(self.recipe, num_envs, seed, state=state, clip_actions=clips, **settings)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizer, target update (if there are targets) and replay buffer.

        Compiles the loss, if that pays.
        """
        recipe: Any = self.recipe
        groups: dict[str, list[nn.Parameter]] = {start: [] for start in self.rates}
        for name, parameter in self.model.named_parameters():
            groups[next(start for start in groups if name.startswith(start))].append(parameter)
        self.optimizer = torch.optim.Adam(
            [{"params": groups[x], "lr": getattr(recipe, rate)} for x, rate in self.rates.items()],
            fused=True,
        )
        if hasattr(recipe, "tau"):
            self.target = SoftUpdate(self.model, tau=recipe.tau)
        self.buffer = self.make_buffer()
        self._loss = self.compiled(self.loss, "the loss")

    def compiled(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        """Compiles a function of a batch if the recipe says so, which ``name`` names."""
        recipe = self.recipe
        if recipe.slice_length == 1 and should_compile(recipe.compile, recipe.total_updates):
            return compile_and_time(function, name, self)
        return function

    def check(self) -> None:
        """As :meth:`DatasetAlgorithm.check`; also checks that there is a compiler if requested."""
        check_compiler(self.recipe.compile)
        super().check()

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer, and the sampling state of the replay buffer."""
        return {"optimizer": self.optimizer, "buffer": self.buffer}

    def load_data(self) -> Episodes:
        """Loads the episodes to learn from; the others are held out.

        Raises:
            ValueError: if the data set's actions are of another kind than those of the task.
            FileNotFoundError: if there are no such data.
        """
        recipe, continuous = self.recipe, self.action_spec.dtype.is_floating_point
        episodes = read_data(recipe)
        if episodes.rows["action"].is_floating_point() != continuous:
            found, expected = ("integers", "floats") if continuous else ("floats", "integers")
            raise ValueError(
                f"the actions in {recipe.dataset} are {found}, but those of {recipe.task_name} are "
                f"{expected}: use other data"
            )
        return self.split(episodes)

    def make_buffer(self) -> ReplayBuffer:
        """Reads the data set into a replay buffer of transitions with histories.

        The networks then normalize observations by its statistics, if they do.
        """
        recipe, episodes = self.recipe, self.load_data()
        if recipe.normalize_observations:
            set_statistics(
                self.policy,
                self.model,
                lambda x: x.set_statistics(
                    *episodes.observation_statistics(x.samples, unfinished=recipe.unfinished)
                ),
            )
        storage = self.measured_items(episodes.to(storage_device(recipe)))
        held_out = [] if self._held_out is None else [self.measured_items(self._held_out)]
        if (count := min(map(len, [storage, *held_out]))) < recipe.drawn_length:
            raise ValueError(
                f"slice_length {recipe.slice_length} and burn_in {recipe.burn_in} are longer than "
                f"the {count} transitions to learn from or to hold out: make them shorter"
            )
        return make_replay_buffer(
            storage,
            recipe.drawn_size,
            seed=recipe.seed,
            slice_length=recipe.drawn_length,
            transform=arranging(recipe),
        )

    def measured_items(self, episodes: Episodes) -> HistoryStorage:
        """Cuts episodes into transitions with histories, as in training."""
        recipe = self.recipe
        return HistoryStorage(
            episodes,
            recipe.backbone.num_frames,
            padding=recipe.padding,
            time_limits=recipe.time_limits,
            unfinished=recipe.unfinished,
            terminal_observations=self.terminal_observations,
            is_init=recipe.slice_length > 1,
        )

    def measure_batch(self, samples: TensorDictBase) -> Mapping[str, Tensor]:
        """Compares the policy's actions with the data's, and what the critics say of both.

        ``q`` is the lower of the critics' values of the data's actions, ``advantage`` how much
        higher they value the policy's.
        """
        chosen, action = self.policy(samples.copy())["action"], samples["action"]
        found = {"action_error": action_error(chosen, action)}
        if "q" in self.measures:
            q = self.q_values(samples)
            found |= {"q": q.mean(), "advantage": (self.q_values(samples, chosen) - q).mean()}
        return found

    def q_values(self, samples: TensorDictBase, action: Tensor | None = None) -> Tensor:
        """The lower value of the critics, float [*B]; of the data's actions if None are given."""
        loss: Any = self.model
        action = samples["action"] if action is None else action
        network, values = loss.qvalue_network, []
        for weights in loss.qvalue_network_params.unbind(0):
            with weights.to_module(network, preserve_module_state=False):
                values.append(action_values(network, samples, action))
        return torch.stack(values).amin(0)

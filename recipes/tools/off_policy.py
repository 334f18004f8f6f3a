"""Runs on data of others: what is measured there, and how well the policy would do."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives.value.functional import td0_return_estimate

from torchrl_tit.datasets import DatasetError, Episodes, HistoryStorage, select_episodes
from torchrl_tit.datasets.hdf5_files import damage_named, find, open_hdf5
from torchrl_tit.envs import observation_specs
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.modules.action_specs import describe
from torchrl_tit.networks.building import evaluating
from torchrl_tit.settings.networks import mlp

from ..core.algorithm import descend, storage_device, to_networks
from ..core.networks import is_continuous, is_discrete, make_critic
from ..core.optional import tqdm
from ..core.recipe import DatasetRecipe, Recipe
from ..core.run import Run
from ..core.runner import load_trained
from ..offline import BY_DATA, DatasetAlgorithm, TransitionAlgorithm, action_values, read_data

UPDATES = {"fqe": 20_000, "wis": 2000}
"""Gradient steps of fitted Q evaluation, and of cloning the behavior."""
LOG_PROBS = "action_log_probs"
"""A field of HDF5 files: the logarithm of the probability with which each action was taken, [N]."""
_TAU = 0.02  # a value reaches back 1 / (1 - gamma) steps, each of which takes 1 / tau updates
_BATCH = 256  # transitions in a gradient step, drawn with replacement
_AT_ONCE = 1000  # states in which the policy acts
_RESAMPLED = 2000  # times that the bootstrap draws episodes


def evaluate_on_data(
    run: Run, recipe: Recipe, dataset: str, *, best: bool = False, ope: str | None = None
) -> dict[str, Any]:
    """Evaluates a run's newest checkpoint on all episodes of a data set.

    Args:
        run: a run of an algorithm that learns from data.
        recipe: its recipe, whose ``evaluation_seed`` seeds what is random.
        dataset: the data set; see ``dataset`` of the recipe.
        best: whether to take the best weights instead of the last ones.
        ope: "fqe" also estimates the policy's discounted return by fitted Q evaluation, "wis" that
            of a discrete policy by weighted importance sampling.

    Returns:
        The entries of :func:`~recipes.core.evaluation.summarize` without an environment, "weights",
        and of an estimate "ope", and the entries of :func:`fitted_q` or :func:`weighted_returns`.

    Raises:
        ValueError: if the run is of another algorithm, or has no such estimate.
        FileNotFoundError: if there are no such data, or no checkpoint.
    """
    step, algorithm, _ = load_trained(run, recipe, best=best)
    if not isinstance(algorithm, DatasetAlgorithm):
        raise ValueError(f"{run.folder} is a run of {recipe.algorithm}, which reads no data sets")
    own: DatasetRecipe = algorithm.recipe
    episodes = read_data(replace(own, dataset=dataset))
    with warnings.catch_warnings():  # nothing is trained, so nothing moves the targets
        warnings.filterwarnings("ignore", "No target network updater")
        found = algorithm.measure(step, episodes)
    assert found is not None
    weights = "best" if best else "last"
    evaluation = {"env": "", "dataset": dataset, **found.entries(), "weights": weights}
    if ope is not None:
        if not isinstance(algorithm, TransitionAlgorithm):
            raise ValueError(
                f"what a policy of {recipe.algorithm} does depends on the return that it is told "
                "to reach, so its value is not estimated: use a bc, iql, td3bc or cql run"
            )
        if recipe.backbone.carries_state:
            raise ValueError(
                f"off-policy evaluation reads single transitions, but "
                f"{recipe.backbone.history.name} carries a state: leave out --ope"
            )
        evaluation["ope"] = ope
        known = recorded_log_probs(dataset, episodes) if ope == "wis" else None
        if not episodes.is_whole.all():
            episodes, known = without_parts(episodes, known)
        if ope == "fqe":
            evaluation |= fitted_q(algorithm, episodes, UPDATES[ope])
        else:
            evaluation |= weighted_returns(algorithm, episodes, known, UPDATES[ope])
    return evaluation


def fitted_q(
    algorithm: TransitionAlgorithm[Any], episodes: Episodes, updates: int
) -> dict[str, float]:
    """Estimates the discounted return of a policy by fitted Q evaluation (arXiv 1911.06854).

    The critic is an MLP on the policy's history; for images, it has the policy's kind of backbone.

    Args:
        algorithm: has the policy, which takes its most likely actions.
        episodes: the data.
        updates: gradient steps of the critic.

    Returns:
        "gamma", "value", the mean over the episodes' first observations, its 95% bootstrap interval
        "low" and "high" over episodes, and "data_value", the mean discounted return of the data,
        which ends at time limits.

    Raises:
        ValueError: if the discount factor is 1, or an action consists of several choices.
    """
    recipe, spec = algorithm.recipe, algorithm.action_spec
    if not (is_discrete(spec) or is_continuous(spec)):
        raise ValueError(
            "fitted Q evaluation values arrays of continuous actions or a few discrete ones, but "
            f"those of {recipe.task_name} are {describe(spec)}: leave out --ope"
        )
    if _gamma(recipe) == 1:
        raise ValueError(
            "fitted Q evaluation of a run with gamma 1 has no scale, and where episodes need not "
            "end no solution: use --ope wis, or train with a gamma below 1"
        )
    critic = _make_critic(algorithm, episodes)
    episodes = episodes.to(storage_device(recipe))
    num_frames = recipe.backbone.num_frames
    items = HistoryStorage(episodes, num_frames, padding=recipe.padding, unfinished="keep")
    gamma = _gamma(recipe)
    value = fit_q(algorithm.policy, critic, items, gamma=gamma, updates=updates)
    number = items[:]["episode"]
    first = torch.cat([number.new_ones(1), number.diff()]).nonzero().squeeze(-1)
    values = value(first).cpu()
    means = values[_resamples(len(values), recipe.evaluation_seed)].mean(1)
    return _entries(values.mean(), means, episodes, gamma)


def weighted_returns(
    algorithm: TransitionAlgorithm[Any],
    episodes: Episodes,
    log_probs: Tensor | None,
    updates: int,
) -> dict[str, Any]:
    """Estimates the discounted return of a discrete policy by weighted importance sampling.

    It is per decision and consistent: a reward has the weight of its episode's actions so far,
    divided by the sum of these weights over all episodes; an episode keeps its last one. The policy
    takes its most likely actions, so an episode has no weight after another action. Resamples of
    the bootstrap in which no episode has one do not count.

    Args:
        algorithm: has the policy.
        episodes: the data.
        log_probs: of the actions of all steps, [N]; if None, behavior is cloned from the data.
        updates: gradient steps of the cloning.

    Returns:
        The entries of :func:`fitted_q`, "behavior", which says where its probabilities come from,
        and "effective_episodes", Kish's effective number of the episodes at their ends.

    Raises:
        ValueError: if actions are continuous, or no episode has a weight at its end.

    Source: "Safe Reinforcement Learning" (Thomas, 2015), section 3.10.
    """
    recipe = algorithm.recipe
    if not is_discrete(algorithm.action_spec):
        raise ValueError(
            "weighted importance sampling needs a few discrete actions: estimate the value of "
            "continuous ones by --ope fqe"
        )
    behavior = _make_critic(algorithm, episodes)
    episodes = episodes.to(storage_device(recipe))
    # Every step counts, also where what follows is unknown.
    steps = replace(episodes, final_known=torch.ones_like(episodes.final_known))
    num_frames = recipe.backbone.num_frames
    items = HistoryStorage(steps, num_frames, padding=recipe.padding, unfinished="keep")
    if log_probs is None:
        clone(behavior, items, updates)
    matches, logs = [], []
    for index in torch.arange(len(items), device=items.device).split(_AT_ONCE):
        batch = to_networks(items.get(index), algorithm.device)
        matches.append((_act(algorithm.policy, batch) == batch["action"]).cpu())
        if log_probs is None:
            with torch.no_grad():
                logs.append(-_surprise(behavior, batch, "none").double().cpu())
    log_ratio = torch.where(torch.cat(matches), 0.0, -torch.inf)
    log_ratio = log_ratio - (torch.cat(logs) if log_probs is None else log_probs)
    gamma, lengths = _gamma(recipe), episodes.lengths.cpu()
    weights = by_episode(log_ratio, lengths).cumsum(1)
    weights = (weights - weights.amax(0).clamp(min=torch.finfo(weights.dtype).min)).exp()
    if not weights[:, -1].any():
        raise ValueError(
            f"none of the {len(lengths)} episodes takes the policy's actions up to its end, so "
            "weighted importance sampling has nothing to weigh: use --ope fqe"
        )
    paid = weights * rewards_by_episode(episodes) * gamma ** torch.arange(weights.shape[1])

    def value(counts: Tensor) -> Tensor:  # [B, E]; NaN where no drawn episode has a weight
        return ((counts @ paid) / (counts @ weights)).sum(1)

    drawn = _resamples(len(lengths), recipe.evaluation_seed)
    counts = torch.stack([row.bincount(minlength=len(lengths)) for row in drawn]).double()
    means = torch.cat([value(part) for part in counts.split(_RESAMPLED // 20)])
    last = weights[:, -1]
    return {
        **_entries(value(torch.ones_like(counts[:1])), means, episodes, gamma),
        "behavior": "cloned from the data" if log_probs is None else f"read from {LOG_PROBS}",
        "effective_episodes": (last.sum().square() / last.square().sum()).item(),
    }


def recorded_log_probs(dataset: str, episodes: Episodes) -> Tensor | None:
    """Reads the log-probabilities of the actions from an HDF5 file, float64 [N], if it has them.

    Raises:
        DatasetError: if they are not the logarithms of a probability for each step.
    """
    if LOG_PROBS not in episodes.left_out or not Path(dataset).is_file():
        return None
    with open_hdf5(dataset) as file:
        field = find(dataset, file, LOG_PROBS)
        with damage_named(dataset, "cannot be read", LOG_PROBS):
            values = np.asarray(field, np.float64).reshape(-1)
    if len(values) != episodes.num_transitions or not (np.isfinite(values) & (values <= 0)).all():
        problem = f"must be {episodes.num_transitions} finite numbers, at most 0."
        raise DatasetError(dataset, problem, LOG_PROBS)
    return torch.from_numpy(values)


def without_parts(episodes: Episodes, log_probs: Tensor | None) -> tuple[Episodes, Tensor | None]:
    """Selects the whole episodes: of parts and unfinished ones, the return is not known.

    Args:
        episodes: the data.
        log_probs: those of their actions, [N], if they are known.
    """
    kept = torch.zeros_like(episodes.cut)
    kept[whole := episodes.whole] = True
    if log_probs is not None:
        log_probs = log_probs[kept.repeat_interleave(episodes.lengths)]
    return select_episodes(episodes, whole), log_probs


def clone(behavior: TensorDictModuleBase, items: HistoryStorage, updates: int) -> None:
    """Fits logits for each discrete action, "state_action_value", to the actions of transitions.

    The weights are kept that fit a tenth of the transitions best which is not trained on; others
    would say that what was done had to be.
    """
    optimizer = torch.optim.Adam(behavior.parameters(), lr=1e-3, fused=True)
    device = next(behavior.parameters()).device
    order, count = torch.randperm(len(items), device=items.device), -(-len(items) // 10)
    rest = order[count:] if count < len(order) else order
    test = to_networks(items.get(order[:count][:_AT_ONCE]), device)
    lowest, best = torch.inf, behavior.state_dict()
    for number in tqdm.trange(updates, unit=" updates", desc="cloning the behavior", leave=False):
        if number % 100 == 0:
            with torch.no_grad():
                error = _surprise(behavior, test, "mean").item()
            if error < lowest:
                lowest, best = error, copy.deepcopy(behavior.state_dict())
        index = rest[torch.randint(len(rest), (_BATCH,), device=items.device)]
        loss = _surprise(behavior, to_networks(items.get(index), device), "mean")
        descend({"loss_behavior": loss}, optimizer)
    behavior.load_state_dict(best)


def _surprise(behavior: TensorDictModuleBase, batch: TensorDictBase, reduction: str) -> Tensor:
    """The negative log-probability of the actions."""
    logits = behavior(batch.copy())["state_action_value"]
    return F.cross_entropy(logits, batch["action"], reduction=reduction)


def by_episode(values: Tensor, lengths: Tensor) -> Tensor:
    """Values of steps [N] as a table [E, T], with zeros after the ends of episodes.

    Example:
        >>> by_episode(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([1, 2]))
        tensor([[1., 0.],
                [2., 3.]])
    """
    return pad_sequence(list(values.split(lengths.tolist())), batch_first=True)


def _make_critic(algorithm: TransitionAlgorithm[Any], episodes: Episodes) -> TensorDictModuleBase:
    """An MLP on the policy's history, or for images the policy's kind of backbone."""
    recipe, spec = algorithm.recipe, algorithm.action_spec
    torch.manual_seed(recipe.evaluation_seed)
    with closing(algorithm.make_env(1)) as env:
        observation = observation_specs(env)
    assert isinstance(observation, TensorSpec)
    small = mlp(recipe.backbone.num_frames, hidden_dim=256, activation="relu")
    critic = make_critic(
        observation,
        None if is_discrete(spec) else spec,
        (256,),
        small if observation.ndim == 1 else recipe.backbone,
        values=spec.space.n if is_discrete(spec) else 1,
        normalization=BY_DATA if observation.dtype.is_floating_point else None,
    )
    for module in critic.modules():
        if isinstance(module, NormalizedFrames):
            module.set_statistics(*episodes.observation_statistics(module.samples))
    return critic.to(algorithm.device)


def _gamma(recipe: Any) -> float:
    return getattr(recipe, "gamma", 0.99)


def _resamples(count: int, seed: int) -> Tensor:
    """Indices of the episodes that each resample of the bootstrap draws, int64 [B, E]."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(count, (_RESAMPLED, count), generator=generator)


def _entries(value: Tensor, means: Tensor, episodes: Episodes, gamma: float) -> dict[str, Any]:
    """The entries of an estimate; means are those of the bootstrap's resamples, [B], or NaN."""
    low, high = means.nanquantile(means.new_tensor([0.025, 0.975])).tolist()
    return {
        "gamma": gamma,
        "value": value.item(),
        "low": low,
        "high": high,
        "data_value": discounted_returns(episodes, gamma).mean().item(),
    }


def fit_q(
    policy: TensorDictModuleBase,
    critic: TensorDictModuleBase,
    items: HistoryStorage,
    *,
    gamma: float,
    updates: int,
    learning_rate: float = 3e-4,
) -> Callable[[Tensor], Tensor]:
    """Fits a critic to the values of a policy, which is called once for each item.

    Args:
        policy: reads an item, or its "next", and writes "action".
        critic: reads the same and the action, and writes "state_action_value", one value or one for
            each discrete action. Its initial weights are trained.
        items: transitions.
        gamma: discount factor.
        updates: gradient steps of Adam.
        learning_rate: learning rate.

    Returns:
        A function from indices of items, int64 [B], to the values of the policy's actions there,
        float64 [B].
    """
    device = next(critic.parameters()).device

    def draw(index: Tensor) -> TensorDictBase:
        return to_networks(items.get(index), device)

    everything = torch.arange(len(items), device=items.device)
    following = torch.cat([_act(policy, draw(i)["next"]) for i in everything.split(_AT_ONCE)])
    rewards = items[:]["next", "reward"]
    size = rewards.abs().mean().clamp(min=1e-8).item()
    scale = (1 - gamma) / size  # values are then of scale 1
    # No value is beyond these; without them, a fit to actions that the data lack can diverge.
    low, high = min(rewards.min().item(), 0.0) / size, max(rewards.max().item(), 0.0) / size
    target = copy.deepcopy(critic).requires_grad_(False).eval()
    pairs = list(zip(target.parameters(), critic.parameters(), strict=True))
    optimizer = torch.optim.Adam(critic.parameters(), lr=learning_rate, fused=True)
    for _ in tqdm.trange(updates, unit=" updates", desc="fitted Q evaluation", leave=False):
        index = torch.randint(len(items), (_BATCH,), device=items.device)
        batch = draw(index)
        outcome = batch["next"]
        goal = td0_return_estimate(
            gamma,
            action_values(target, outcome, following[index.to(device)]).unsqueeze(-1),
            scale * outcome["reward"],
            outcome["terminated"],
        )
        goal = goal.squeeze(-1).clamp(low, high)
        loss = F.mse_loss(action_values(critic, batch, batch["action"]), goal)
        descend({"loss_value": loss}, optimizer)
        for slow, fast in pairs:
            slow.lerp_(fast.detach(), _TAU)

    @torch.no_grad()
    def value(index: Tensor) -> Tensor:
        found = draw(index)
        with evaluating(critic):
            values = action_values(critic, found, _act(policy, found))
            return values.double().clamp(low, high) / scale

    return value


def discounted_returns(episodes: Episodes, gamma: float) -> Tensor:
    """Discounted return of each episode, float64 [E].

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> ends = [False, True, True]
        >>> data = episodes_from_arrays([[0.0]] * 3, [0, 0, 0], [1.0, 1.0, 3.0], ends)
        >>> discounted_returns(data, 0.5)
        tensor([1.5000, 3.0000], dtype=torch.float64)
    """
    rewards = rewards_by_episode(episodes)
    return rewards @ gamma ** torch.arange(rewards.shape[1], dtype=rewards.dtype)


def rewards_by_episode(episodes: Episodes) -> Tensor:
    """The rewards of episodes, float64 [E, T] on the CPU, with zeros after their ends."""
    rewards = episodes.rows["reward"].squeeze(-1)[episodes.step_rows]
    return by_episode(rewards.double().cpu(), episodes.lengths.cpu())


@torch.no_grad()
def _act(policy: TensorDictModuleBase, states: TensorDictBase) -> Tensor:
    """The most likely actions in states [B]."""
    with evaluating(policy), set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(states.copy())["action"]

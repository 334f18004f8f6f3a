"""Runs on data of others: what is measured there, and how well the policy would do."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives.value.functional import td0_return_estimate

from torchrl_tit.analysis.targets import evaluating
from torchrl_tit.datasets import Episodes, HistoryStorage
from torchrl_tit.envs import observation_specs
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.settings.networks import mlp

from ..core.dataset_recipe import DatasetRecipe
from ..core.networks import is_discrete, make_critic
from ..core.optional import tqdm
from ..core.recipe import Recipe
from ..core.run import Run
from ..core.runner import load_trained
from ..offline import DatasetAlgorithm, TransitionAlgorithm, action_values, read_data

UPDATES = 20_000
"""Gradient steps of fitted Q evaluation."""
_TAU = 0.02  # a value reaches back 1 / (1 - gamma) steps, each of which takes 1 / tau updates
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
        ope: "fqe" also estimates the policy's discounted return by fitted Q evaluation.

    Returns:
        The entries of :func:`~recipes.core.evaluation.summarize` without an environment, "weights",
        and of an estimate "ope", "gamma", "value" with its 95% interval "low" and "high" over
        episodes, and "data_value", the mean discounted return of the episodes.

    Raises:
        ValueError: if the run is of another algorithm, or has no such estimate.
        FileNotFoundError: if there are no such data, or no checkpoint.
    """
    step, algorithm, _ = load_trained(run, recipe, best=best)
    if not isinstance(algorithm, DatasetAlgorithm):
        raise ValueError(f"{run.folder} is a run of {recipe.algorithm}, which reads no data sets")
    own: DatasetRecipe = algorithm.recipe
    episodes = read_data(replace(own, dataset=dataset))
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
                f"fitted Q evaluation reads single transitions, but {recipe.backbone.history.name} "
                "carries a state: leave out --ope"
            )
        evaluation |= {"ope": ope, **fitted_q(algorithm, episodes, UPDATES)}
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
    """
    recipe, spec = algorithm.recipe, algorithm.action_spec
    gamma, num_frames = getattr(recipe, "gamma", 0.99), recipe.backbone.num_frames
    torch.manual_seed(recipe.evaluation_seed)
    with closing(algorithm.make_env(1)) as env:
        observation = observation_specs(env)
    assert isinstance(observation, TensorSpec)
    small = mlp(num_frames, hidden_dim=256, activation="relu")
    critic = make_critic(
        observation,
        0 if is_discrete(spec) else spec.shape[0],
        (256,),
        small if observation.ndim == 1 else recipe.backbone,
        values=spec.space.n if is_discrete(spec) else 1,
        eps=1e-3 if observation.dtype.is_floating_point else None,
    )
    for module in critic.modules():
        if isinstance(module, NormalizedFrames):
            module.set_statistics(*episodes.observation_statistics(module.samples))
    episodes = episodes.to(algorithm.device)
    items = HistoryStorage(episodes, num_frames, padding=recipe.padding, unfinished="keep")
    critic = critic.to(algorithm.device)
    value = fit_q(algorithm.policy, critic, items, gamma=gamma, updates=updates)
    number = items[:]["episode"]
    first = torch.cat([number.new_ones(1), number.diff()]).nonzero().squeeze(-1)
    values = value(first).cpu()
    generator = torch.Generator().manual_seed(recipe.evaluation_seed)
    drawn = torch.randint(len(values), (_RESAMPLED, len(values)), generator=generator)
    low, high = values[drawn].mean(1).quantile(values.new_tensor([0.025, 0.975])).tolist()
    return {
        "gamma": gamma,
        "value": values.mean().item(),
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
    batch_size: int = 256,
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
        batch_size: transitions in each, drawn with replacement.
        learning_rate: learning rate.

    Returns:
        A function from indices of items, int64 [B], to the values of the policy's actions there,
        float64 [B].
    """
    everything = torch.arange(len(items), device=items.device)
    following = torch.cat([_act(policy, items.get(i)["next"]) for i in everything.split(_AT_ONCE)])
    # Values are then of scale 1.
    scale = (1 - gamma) / items[:]["next", "reward"].abs().mean().clamp(min=1e-8).item()
    target = copy.deepcopy(critic).requires_grad_(False)
    pairs = list(zip(target.parameters(), critic.parameters(), strict=True))
    optimizer = torch.optim.Adam(critic.parameters(), lr=learning_rate)
    for _ in tqdm.trange(updates, unit=" updates", desc="fitted Q evaluation", leave=False):
        index = torch.randint(len(items), (batch_size,), device=items.device)
        batch = items.get(index)
        outcome = batch["next"]
        goal = td0_return_estimate(
            gamma,
            action_values(target, outcome, following[index]).unsqueeze(-1),
            scale * outcome["reward"],
            outcome["terminated"],
        ).squeeze(-1)
        loss = F.mse_loss(action_values(critic, batch, batch["action"]), goal)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        for slow, fast in pairs:
            slow.lerp_(fast.detach(), _TAU)

    @torch.no_grad()
    def value(index: Tensor) -> Tensor:
        found = items.get(index)
        return action_values(critic, found, _act(policy, found)).double() / scale

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
    lengths = episodes.lengths + 1  # with the final observation, whose reward is 0
    rewards = episodes.rows["reward"].squeeze(-1).double()
    steps = torch.arange(len(rewards), device=rewards.device)
    steps -= episodes.first_rows.repeat_interleave(lengths)
    number = torch.arange(len(lengths), device=rewards.device).repeat_interleave(lengths)
    return rewards.new_zeros(len(lengths)).index_add(0, number, rewards * gamma**steps)


@torch.no_grad()
def _act(policy: TensorDictModuleBase, states: TensorDictBase) -> Tensor:
    """The most likely actions in states [B]."""
    with evaluating(policy), set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(states.copy())["action"]

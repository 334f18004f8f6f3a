"""Whole episodes of a trained policy, in parts that a resumed process does not play again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from gymnasium import Space
from gymnasium.spaces import Box
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm import tqdm

from torchrl_tit.datasets import TransitionParts
from torchrl_tit.evaluation import check_rewards
from torchrl_tit.modules import acting

Transitions = dict[str, NDArray]
"""D4RL's fields by name."""


def play_episodes(
    parts: TransitionParts,
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    transitions: int,
    *,
    action_space: Space,
    seed: int,
    deterministic: bool = False,
) -> None:
    """Plays episodes until the parts hold enough transitions; the last episode is complete.

    Each part holds one episode of every environment, started together. Short episodes are therefore
    not favoured, and a part depends only on its number and the seed, not on earlier parts.

    Args:
        parts: where the episodes are written; existing ones count.
        env: environments [N], which are reset with seeds.
        policy: writes the action into the tensordict that it is given.
        transitions: number of transitions. A single episode that is longer is cut off there.
        action_space: action space of the task; actions are recorded as the task receives them,
            clipped to it.
        seed: seed of all episodes.
        deterministic: whether the policy's most likely action is taken instead of a sampled one.

    Raises:
        FloatingPointError: if a reward of these episodes is NaN or infinite.
    """
    parts.drop_after(max(parts.numbers(), default=-1))  # removes half-written files only
    number, rows = len(parts.numbers()), parts.num_rows()
    kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    with (
        torch.no_grad(),
        set_exploration_type(kind),
        tqdm(
            total=transitions,
            initial=min(rows, transitions),
            unit=" transitions",
            desc=parts.folder.stem,
        ) as progress,
    ):
        while rows < transitions:
            state = np.random.SeedSequence([seed, number]).generate_state(2)
            torch.manual_seed(int(state[0]))
            with acting(policy):  # discards the frames of the previous part
                episodes = _play(env, policy, action_space, int(state[1]) >> 1, transitions)
            chosen = []
            for episode in episodes:
                if rows < transitions:
                    chosen.append(episode)
                    rows += len(episode["rewards"])
            parts.write(
                number,
                {name: np.concatenate([e[name] for e in chosen])[None] for name in chosen[0]},
            )
            number += 1
            progress.update(min(rows, transitions) - progress.n)


def _play(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    action_space: Space,
    seed: int,
    max_steps: int,
) -> list[Transitions]:
    """Plays one episode in each environment, or a whole Atari game, which is several episodes.

    Args:
        env: environments [N].
        policy: writes the action into the tensordict that it is given.
        action_space: action space of the task.
        seed: seed of the first environment; the others' follow one by one.
        max_steps: steps after which an episode is cut off.

    Returns:
        The transitions of each environment.

    Raises:
        FloatingPointError: if a reward in them is NaN or infinite.
    """
    tensordict = env.reset(seed=seed)
    playing = torch.ones(env.batch_size.numel(), dtype=torch.bool)
    lengths = torch.zeros_like(playing, dtype=torch.int64)
    steps: list[dict[str, Tensor]] = []
    while playing.any() and len(steps) < max_steps:
        step, tensordict = env.step_and_maybe_reset(policy(tensordict))
        steps.append(as_fields(step, action_space))
        check_rewards(steps[-1]["rewards"].masked_fill(~playing, 0))
        lengths += playing
        outcome = step["next"]
        over = outcome.get("game_over", None)
        playing &= ~(outcome["done"] if over is None else over).flatten().cpu()
    episodes = []
    for index, length in enumerate(lengths.tolist()):
        episode = {
            name: torch.stack([step[name][index] for step in steps[:length]]).numpy()
            for name in steps[0]
        }
        episode["timeouts"][-1] |= not episode["terminals"][-1]
        episodes.append(episode)
    return episodes


def as_fields(batch: TensorDictBase, action_space: Space) -> dict[str, Tensor]:
    """Converts steps of an environment to D4RL's fields, on the CPU.

    Args:
        batch: steps, of any shape [...].
        action_space: action space of the task; actions that a Gaussian policy sampled beyond its
            bounds are clipped to them.

    Returns:
        Tensors [...]; observations [..., *obs] and actions [..., *action].
    """
    outcome, actions = batch["next"], batch["action"].cpu()
    if isinstance(action_space, Box):
        low, high = (torch.from_numpy(bound) for bound in (action_space.low, action_space.high))
        actions = actions.clamp(low, high)
    fields = {
        "observations": batch["observation"],
        "actions": actions,
        "rewards": outcome["reward"].squeeze(-1),
        "terminals": outcome["terminated"].squeeze(-1),
        "timeouts": outcome["truncated"].squeeze(-1),
        "next_observations": outcome["observation"],
    }
    return {name: tensor.cpu() for name, tensor in fields.items()}

"""Checks that an exported policy acts like the live one."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, set_interaction_type
from tensordict.nn.probabilistic import InteractionType
from torch import Tensor
from torchrl.envs import EnvBase, RenameTransform, TransformedEnv

from torchrl_tit.export.formats import Run
from torchrl_tit.export.program import NOISE, Program, Step
from torchrl_tit.histories.decision_transformer import DecisionTransformer

TOLERANCE = 1e-5
"""Largest difference, relative to the largest entry if that is above 1."""
OBSERVATIONS = 100
"""Number of observations on which policies are compared."""
COPIES = 4
_EPISODE = 10
"""Steps after which all copies are reset, so that the beginning of an episode is seen twice."""


class NotTheSameError(ValueError):
    """An exported policy acts differently from the live one."""


@torch.no_grad()
def compare(
    run: Run,
    program: Program,
    policy: TensorDictModuleBase,
    env: EnvBase,
    *,
    observations: int = OBSERVATIONS,
) -> float:
    """Compares an exported policy with the live one, step by step, in the live one's episodes.

    Compares the action and the outputs from which it was chosen. For discrete actions, the choice
    is compared given the exported logits or values: if two actions are equally good up to rounding,
    both are correct. If actions are sampled, the noise is random.

    Args:
        run: the exported policy.
        program: the program that was exported.
        policy: the live policy.
        env: environment to act in; a transform is added to it.
        observations: number of observations.

    Returns:
        The largest difference, relative to the largest entry if that is above 1.

    Raises:
        NotTheSameError: if a difference is above ``TOLERANCE``.
    """
    keys = _keep_untouched(program, env)
    env.set_seed(0)
    generator = torch.Generator().manual_seed(0)
    longest = _longest_episode(policy)
    steps, largest = -(-observations // max(1, env.batch_size.numel())), 0.0
    tensordict, episode, state = env.reset(), list[Step](), dict[str, Tensor]()
    reward = torch.zeros(tensordict.numel())
    for step in range(steps):
        if step == _EPISODE or len(episode) == longest:
            tensordict, episode = env.reset(), []
        flat = tensordict.reshape(-1)
        with set_interaction_type(InteractionType.DETERMINISTIC):
            acted = policy(tensordict)
        live = acted.reshape(-1)
        observed = [flat[key] for key in keys]
        episode.append(Step(observed, live, reward))
        given = program.feed(episode) | {
            name: live[key] for name, key in program.parts.further.items()
        }
        for name in program.state:
            # The state carried into an episode does not matter.
            entry = program.inputs[name]
            given[name] = state.get(name, torch.ones_like(entry.zeros(len(flat))))
        if program.noise is not None:
            given[NOISE] = torch.randn(len(flat), *program.inputs[NOISE].shape, generator=generator)
        outputs = run(given)
        action, difference = _compare(program, live, outputs, given.get(NOISE))
        largest = max(largest, difference)
        if not largest <= TOLERANCE:
            raise NotTheSameError(
                f"the exported policy differs from the live one by {largest:.1e} on observation "
                f"{step * len(flat) + 1} or soon after; expected at most {TOLERANCE:.0e}, so "
                "nothing was written"
            )
        state = {name: outputs[f"next_{name}"] for name in program.state}
        live["action"] = action
        acted["action"] = action.reshape(acted["action"].shape)
        taken, tensordict = env.step_and_maybe_reset(acted)
        reward = taken["next", "reward"].reshape(-1)
        if taken["next", "done"].any():
            tensordict, episode = env.reset(), []
    return largest


def _longest_episode(policy: TensorDictModuleBase) -> int | None:
    """The number of steps after which a Decision Transformer has no time step left."""
    return next(
        (
            module.max_ep_len
            for module in policy.modules()
            if isinstance(module, DecisionTransformer) and module.timestep_embedding is not None
        ),
        None,
    )


def _keep_untouched(program: Program, env: EnvBase) -> list[NestedKey]:
    """Makes an environment also write each observation from before its transforms."""
    observed = program.parts.observed
    keys = [seen.key for seen in observed]
    # From the outside in, so that places remain valid.
    for index in sorted(range(len(observed)), key=lambda i: -observed[i].place):
        seen = observed[index]
        if len(seen.layers):
            keys[index] = f"untouched_{index}"
            assert isinstance(env, TransformedEnv)
            copied = RenameTransform([seen.key], [keys[index]], create_copy=True)
            env.insert_transform(seen.place, copied)
    return keys


def _compare(
    program: Program, live: TensorDictBase, outputs: Mapping[str, Tensor], noise: Tensor | None
) -> tuple[Tensor, float]:
    """The action that the live policy chooses with this noise, and the largest difference."""
    head = program.head
    pairs = [(outputs[key], live[key]) for key in head.parameter_keys]
    chosen = live.copy()
    if not live["action"].is_floating_point():
        chosen.update({key: outputs[key] for key in head.parameter_keys})
    action = head.choose(chosen, noise)
    pairs.append((outputs["action"], program.to_task(action)))
    return action, max(_distance(mine, other) for mine, other in pairs)


def _distance(mine: Tensor, other: Tensor) -> float:
    if mine.shape != other.shape or mine.dtype != other.dtype:
        return float("inf")
    if not mine.is_floating_point():
        return 0.0 if torch.equal(mine, other) else float("inf")
    # -inf of options that do not exist; TorchRL's values of actions that a mask forbids
    masked = other == torch.finfo(other.dtype).min
    same = (mine == other) | (mine.isnan() & other.isnan()) | masked
    apart = (mine - other).abs().masked_fill(same, 0).nan_to_num(nan=float("inf"))
    scale = other.abs().masked_fill(~other.isfinite() | masked, 0).max().clamp(min=1)
    return (apart.max() / scale).item()

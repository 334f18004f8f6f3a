"""Decision Transformers as functions of plain tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey
from tensordict.utils import unravel_key
from torch import Tensor

from torchrl_tit.export.observed import Entry
from torchrl_tit.export.program import FIRST, Parts, Program, Step, TokenSteps, stack


class SequenceWindows(Program):
    """Reads the last K observations, actions, returns to go and time steps.

        observation [N, K, *obs], actions [N, K, *action], return_to_go [N, K, 1],
        timestep int64 [N, K], mask bool [N, K]  ->  action

    Returns are unscaled, and steps before an episode are masked. As in
    :class:`~torchrl_tit.transforms.SequenceHistory`, the last action is not read.

    Args:
        parts: the policy.
        sample: whether actions are sampled.
    """

    def __init__(self, parts: Parts, *, sample: bool = False) -> None:
        super().__init__(parts, sample=sample)
        assert parts.sequence is not None
        (seen,), steps = parts.observed, parts.sequence.num_frames
        self.num_frames = steps
        self.return_scale = parts.sequence.return_scale
        self.inputs |= {
            "observation": Entry((steps, *seen.entry.shape), seen.entry.dtype),
            "actions": Entry((steps, *parts.action.shape), parts.action.dtype),
            "return_to_go": Entry((steps, 1), torch.float32),
            "timestep": Entry((steps,), torch.int64),
            "mask": Entry((steps,), torch.bool),
        }

    def windows(self, inputs: Mapping[str, Tensor]) -> dict[NestedKey, Tensor]:
        """See :meth:`Program.windows`: the head checks the kind of actions."""
        return {action_key(self.parts): inputs["actions"]}

    def read(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`Program.read`; no state is carried on."""
        (prepare,) = self.preparations
        features = self.trunk(
            prepare(inputs["observation"]),
            inputs["actions"],
            inputs["return_to_go"] / self.return_scale,
            inputs["timestep"],
            inputs["mask"],
        )
        return features, {}

    def feed(self, episode: Sequence[Step]) -> dict[str, Tensor]:
        """See :meth:`Program.feed`."""
        size = len(episode[-1].observations[0])
        *before, last = (step.tensordict["action"] for step in episode)
        times = [torch.full((size,), time) for time in range(len(episode))]
        to_go = [step.tensordict["target_return"] for step in episode]
        entries = {
            "observation": [step.observations[0] for step in episode],
            "actions": [*before, torch.zeros_like(last)],
            "return_to_go": to_go,
            "timestep": times,
            "mask": [torch.ones_like(time, dtype=torch.bool) for time in times],
        }
        return {name: stack(x, self.num_frames, "constant") for name, x in entries.items()}


class SequenceSteps(TokenSteps):
    """Carries the tokens of the last K - 1 frames, their actions and returns, and the time.

        observation [N, *obs], is_init [N], reward [N], target_return [N], state  ->  action, next_

    The return to go is the target, read at the episode's first step, minus the rewards since then.

    Args:
        parts: the policy.
        sample: whether actions are sampled.
    """

    def __init__(self, parts: Parts, *, sample: bool = False) -> None:
        super().__init__(parts, sample=sample)
        assert parts.sequence is not None
        steps = parts.sequence.num_frames
        self.num_frames = steps
        self.return_scale = parts.sequence.return_scale
        scalar = Entry((), torch.float32)
        self.inputs |= {"reward": scalar, "target_return": scalar}
        tokens = self.inputs["tokens"]
        self.carry(
            {
                "tokens": Entry((steps - 1, *tokens.shape[1:]), tokens.dtype),
                "actions": Entry((steps - 1, *parts.action.shape), parts.action.dtype),
                "returns": Entry((steps - 1, 1), torch.float32),
                "return_to_go": scalar,
                "time": Entry((), torch.int64),
            }
        )

    def windows(self, inputs: Mapping[str, Tensor]) -> dict[NestedKey, Tensor]:
        """See :meth:`Program.windows`: the head checks the kind of actions."""
        return {action_key(self.parts): inputs["actions"]}

    def read(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`Program.read`."""
        first, steps = inputs[FIRST], self.num_frames
        tokens = self.window(inputs)  # [N, K, L, D]
        time = torch.where(first, 0, inputs["time"] + 1)
        to_go = inputs["return_to_go"] - inputs["reward"]
        to_go = torch.where(first, inputs["target_return"], to_go)
        returns = torch.cat([inputs["returns"], to_go.reshape(-1, 1, 1)], dim=1)
        actions = inputs["actions"]
        actions = torch.cat([actions, torch.zeros_like(actions[:, :1])], dim=1)
        back = torch.arange(1 - steps, 1, device=time.device)
        timestep = time.unsqueeze(1) + back  # negative before the episode
        features = self.trunk.encode_history(
            tokens, actions, returns / self.return_scale, timestep.clamp(min=0), timestep >= 0
        )
        carried = {
            "tokens": tokens[:, 1:],
            "actions": actions[:, 1:],
            "returns": returns[:, 1:],
            "return_to_go": to_go,
            "time": time,
        }
        return features, carried

    def act(self, carried: dict[str, Tensor], action: Tensor) -> dict[str, Tensor]:
        """Adds the action to the actions that are carried on."""
        actions = torch.cat([carried["actions"][:, :-1], action.unsqueeze(1)], dim=1)
        return {**carried, "actions": actions}

    def feed(self, episode: Sequence[Step]) -> dict[str, Tensor]:
        """See :meth:`Program.feed`."""
        step = episode[-1]
        target = episode[0].tensordict["target_return"].squeeze(-1)
        return {**super().feed(episode), "reward": step.reward, "target_return": target}


def action_key(parts: Parts) -> NestedKey:
    """Returns the key under which a Decision Transformer reads actions."""
    return unravel_key(parts.backbone.history_keys[1])

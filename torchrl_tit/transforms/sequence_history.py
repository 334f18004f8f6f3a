"""The last K returns-to-go, observations and actions, as Decision Transformer reads them."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.numbers import Positive, Size


class SequenceHistory(Transform):
    """Writes the last K steps of the episode as Decision Transformer reads them.

    Under "sequence" it writes the entries of an item of
    :class:`~torchrl_tit.datasets.SequenceStorage`: "observation" [..., K, *obs], "action"
    [..., K, *action], "return_to_go" [..., K, 1], "timestep" int64 [..., K] and "mask" bool
    [..., K]. The newest step comes last, with zeros for its action; steps before an episode's first
    are padding: masked zeros. The transform itself holds no state: it is all in the tensordict, so
    environments can be reset in any way.

    It reads "observation" [..., *obs], "action" and, from TorchRL's `TargetReturn` before it,
    "target_return" [..., 1], the return that is still to be reached.

    TorchRL's `CatFrames` stacks one entry, without time steps or a mask, and would stack the action
    of a step with the observation that follows it.

    Args:
        num_frames: number K of steps, at least 1.
        return_scale: divisor of the returns-to-go.

    Raises:
        ValueError: if ``num_frames`` is less than 1, ``return_scale`` is not positive, or the
            policy writes an action whose shape is not the environment's.
        KeyError: if the environment lacks one of the entries.

    Source: "Decision Transformer" (arXiv 2106.01345), section 3.

    Example:
        >>> from torchrl.envs import Compose, TargetReturn, TransformedEnv
        >>> from torchrl_tit.envs import make_env
        >>> history = SequenceHistory(num_frames=3, return_scale=100.0)
        >>> env = make_env("CartPole-v1", seed=0)
        >>> steps = TransformedEnv(env, Compose(TargetReturn(500.0), history)).rollout(3)
        >>> steps["sequence", "return_to_go"][0, :, :, 0]
        tensor([[0.0000, 0.0000, 5.0000],
                [0.0000, 5.0000, 4.9900],
                [5.0000, 4.9900, 4.9800]])
        >>> steps["sequence", "mask"][0, 1]
        tensor([False,  True,  True])
    """

    @checked_arguments
    def __init__(self, num_frames: Size = 20, *, return_scale: Positive = 1000.0) -> None:
        super().__init__(in_keys=["observation", "target_return"], out_keys=["sequence"])
        self.num_frames = num_frames
        self.return_scale = return_scale

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        sequence = self._first(tensordict_reset)
        reset, before = tensordict.get("_reset", None), tensordict.get("sequence", None)
        if reset is not None and before is not None:  # only some environments are reset
            sequence = sequence.where(reset.reshape(sequence.batch_size), before)
        return tensordict_reset.set("sequence", sequence)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before, action = tensordict["sequence"], tensordict["action"]
        axis = before.ndim
        expected = before["action"].select(axis, 0).shape
        if action.shape != expected:
            raise ValueError(
                f"the policy wrote an action of shape {list(action.shape)}, but the environment "
                f"takes {list(expected)}: discrete actions are integers or one-hot, as its "
                "action_spec says"
            )
        action = action.unsqueeze(axis)
        # The newest step gets the action that was taken in it; then the next step is appended.
        taken = torch.cat([before["action"].narrow(axis, 0, self.num_frames - 1), action], axis)
        newest = {
            **self._newest(next_tensordict, axis),
            "timestep": before["timestep"].narrow(axis, -1, 1) + 1,
            "action": torch.zeros_like(action),
        }
        sequence = TensorDict(
            {
                name: _push(taken if name == "action" else before[name], step, axis)
                for name, step in newest.items()
            },
            before.batch_size,
            device=before.device,
        )
        return next_tensordict.set("sequence", sequence)

    def _newest(self, tensordict: TensorDictBase, axis: int) -> dict[str, Tensor]:
        """The entries of the environment's newest step; [..., 1, ...] each."""
        to_go = tensordict["target_return"].unsqueeze(axis) / self.return_scale
        return {
            "observation": tensordict["observation"].unsqueeze(axis),
            "return_to_go": to_go,
            "mask": torch.ones_like(to_go.squeeze(-1), dtype=torch.bool),
        }

    def _first(self, tensordict: TensorDictBase) -> TensorDict:
        """The sequence at an episode's first step: padding, then this step."""
        self._check_keys(tensordict)
        axis = tensordict.ndim
        step = self._newest(tensordict, axis)
        step["timestep"] = torch.zeros_like(step["mask"], dtype=torch.int64)
        step["action"] = self.parent.full_action_spec["action"].zero().unsqueeze(axis)
        padded = {}
        for name, value in step.items():
            shape = list(value.shape)
            shape[axis] = self.num_frames
            padded[name] = _push(value.new_zeros(shape), value, axis)
        return TensorDict(padded, tensordict.batch_size, device=tensordict.device)

    def _check_keys(self, entries: TensorDictBase | Composite) -> None:
        for key in self.in_keys:
            if key not in entries.keys(True, True):
                raise KeyError(
                    f"the environment has no {key!r}, only "
                    f"{sorted(map(str, entries.keys(True, True)))}: put TorchRL's TargetReturn "
                    "before SequenceHistory"
                )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the sequence to the environment's observations."""
        self._check_keys(observation_spec)
        axis = observation_spec.ndim
        specs = {
            "observation": observation_spec["observation"],
            "action": self.parent.full_action_spec["action"],
            "return_to_go": observation_spec["target_return"],
        }
        steps = {
            name: Unbounded(
                (*spec.shape[:axis], self.num_frames, *spec.shape[axis:]),
                dtype=spec.dtype,
                device=spec.device,
            )
            for name, spec in specs.items()
        }
        leading = (*observation_spec.shape, self.num_frames)
        device = observation_spec.device
        steps["timestep"] = Unbounded(leading, dtype=torch.int64, device=device)
        steps["mask"] = Unbounded(leading, dtype=torch.bool, device=device)
        observation_spec["sequence"] = Composite(steps, shape=observation_spec.shape, device=device)
        return observation_spec


def _push(window: Tensor, step: Tensor, axis: int) -> Tensor:
    """Drops the first step of a window [..., K, ...] and appends a step [..., 1, ...]."""
    return torch.cat([window.narrow(axis, 1, window.shape[axis] - 1), step], axis)

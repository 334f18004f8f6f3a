"""TorchRL's TransformedEnv with less overhead in each step."""

from tensordict import TensorDictBase
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.transforms import Transform


class TransformedVectorEnv(TransformedEnv):
    """A `TransformedEnv` around :class:`~torchrl_tit.envs.GymVectorEnv` with faster steps.

    It behaves like TorchRL's. Most of the time of TorchRL's step goes into copying the
    tensordict for inverse transforms and into checking what the environment wrote. Where no
    transform has an inverse, neither is needed: the environment reads only the action and writes
    every entry in the shape of its spec. A step of eight CartPoles then takes about a fifth less
    time. Everything else takes TorchRL's code path: a transform with an inverse (of actions, say),
    or a tensordict with entries under "next" or on another device.

    Add transforms with ``append_transform``; a second `TransformedEnv` around this one works, but
    takes TorchRL's code path.

    Args:
        base_env: The environment.
        transform: As in `TransformedEnv`.

    Example:
        >>> from torchrl.envs import StepCounter
        >>> from torchrl_tit.envs import make_env
        >>> env = make_env("CartPole-v1", num_envs=8, num_frames=4)
        >>> env = env.append_transform(StepCounter())
        >>> env.rollout(max_steps=2)["next", "step_count"].shape
        torch.Size([8, 2, 1])
    """

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Steps all environments and resets those whose episode ended.

        Args:
            tensordict: Holds the action; [N].

        Returns:
            The tensordict with its "next", and the one to act on next.
        """
        transform, keys = self.transform, tensordict.keys()
        if (
            "next" in keys
            or "_step" in keys
            or tensordict.device != self.base_env.device
            or not _only_writes(transform)
        ):
            return super().step_and_maybe_reset(tensordict)
        outcome = transform._step(tensordict, self.base_env._step(tensordict))
        tensordict.set("next", outcome)
        return tensordict, self.maybe_reset(self._step_mdp(tensordict))


def _only_writes(transform: Transform) -> bool:
    """Returns whether transforms only add to what the environment wrote."""
    # Checked in every step, since transforms can be added at any time; it takes microseconds.
    return type(transform) is Compose and all(
        not part.in_keys_inv
        and all(getattr(type(part), hook) is getattr(Transform, hook) for hook in _HOOKS)
        for part in transform.transforms
    )


_HOOKS = ("_inv_call", "inv", "_post_step_mdp_hooks", "transform_env_device")
"""What a transform can do in a step besides `_step` and `_call`."""

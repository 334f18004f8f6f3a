"""Network, normalisation and environment of Decision Transformer's recipes."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical
from torchrl.envs import Compose, EnvBase, ObservationNorm, TargetReturn, TransformedEnv

from torchrl_tit.datasets import Episodes
from torchrl_tit.envs import make_env, time_limit
from torchrl_tit.evaluation import evaluate
from torchrl_tit.modules import make_dt_actor
from torchrl_tit.networks import DecisionTransformer, DecisionTransformerConfig
from torchrl_tit.transforms import SequenceHistory


class DTAgent(nn.Module):
    """Decision Transformer with the statistics that normalise its observations.

    Args:
        env: name of the task.
        config: the network's settings.
        context: steps that the network sees when it acts.
        return_scale: returns-to-go are divided by it.

    Raises:
        ValueError: if the task does not fit the network.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self, env: str, config: DecisionTransformerConfig, context: int, return_scale: float
    ) -> None:
        super().__init__()
        self.env = env
        self.context = context
        self._max_ep_len = config.max_ep_len
        self.return_scale = return_scale
        task = make_env(env, clip_actions=False)
        spec = task.observation_spec["observation"]
        shape = spec.shape[1:]
        self.normalizes = spec.dtype.is_floating_point
        action_dim = _check_task(env, task.action_spec_unbatched, config)
        task.close()
        self.network = DecisionTransformer(shape, action_dim, config)
        # In a tuple it is no submodule: its weights are the network's, and saved once.
        self._actor = (make_dt_actor(self.network),)
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("std", torch.ones(shape))

    @property
    def actor(self) -> TensorDictModuleBase:
        """The policy, whose weights are the network's."""
        return self._actor[0]

    def fit_statistics(self, episodes: Episodes) -> None:
        """Takes the statistics of a data set; uint8 images, which networks divide by 255, stay."""
        if self.normalizes:
            for buffer, value in zip(
                (self.mean, self.std), episodes.observation_statistics(), strict=True
            ):
                buffer.copy_(value)

    def make_env(
        self, num_envs: int, target_return: float, seed: int | None = None, **settings: Any
    ) -> EnvBase:
        """Builds the task with all that the policy reads; actions go to it as they are.

        Where the task itself has no time limit, its episodes are cut off after ``max_ep_len``
        steps.

        Args:
            num_envs: environments that are stepped side by side.
            target_return: the return that is to be reached.
            seed: of the first environment.
            **settings: of the task.
        """
        device = self.mean.device
        if time_limit(self.env) is None:
            settings = {"max_episode_steps": self._max_ep_len, **settings}
        env = make_env(
            self.env,
            num_envs,
            seed=seed,
            clip_actions=False,
            device=None if device.type == "cpu" else device,
            **settings,
        )
        key = "observation"
        transforms = [TargetReturn(target_return)]
        if self.normalizes:
            key = "normalized_observation"  # beside the observation, which new data need as it is
            transforms.append(
                ObservationNorm(
                    self.mean,
                    self.std,
                    in_keys=["observation"],
                    out_keys=[key],
                    standard_normal=True,
                )
            )
        history = SequenceHistory(self.context, return_scale=self.return_scale, observation_key=key)
        return TransformedEnv(env, Compose(*transforms, history))

    def play(self, target_return: float, episodes: int, seed: int) -> Tensor:
        """Plays episodes side by side and returns what each returned; float64 [episodes]."""
        return evaluate(
            lambda num_envs: self.make_env(num_envs, target_return),
            self.actor,
            episodes,
            seed=seed,
            shrink=True,
        )


def _check_task(env: str, action_spec: Any, config: DecisionTransformerConfig) -> int:
    """Entries of a continuous action, or the number of discrete ones, if the network can act."""
    limit = time_limit(env)
    if config.timestep_embedding and limit is not None and limit > config.max_ep_len:
        raise ValueError(
            f"episodes of {env} have up to {limit} steps, but max_ep_len is "
            f"{config.max_ep_len}: raise backbone.max_ep_len to {limit} or more"
        )
    discrete = isinstance(action_spec, Categorical)
    if discrete != (config.action_space == "discrete"):
        kind = "discrete" if discrete else "continuous"
        raise ValueError(
            f"{env} has {kind} actions, but the head's are {config.action_space}: set "
            f"backbone.action_space to {kind!r}, or take another task"
        )
    if isinstance(action_spec, Bounded):
        bounds = [x.flatten().tolist() for x in (action_spec.low, action_spec.high)]
        for low, high in zip(*bounds, strict=True):
            if (low, high) != (-1, 1):
                raise ValueError(
                    f"actions of {env} reach from {low:g} to {high:g}, but the head's from -1 to "
                    "1: take a task whose actions are all scaled to that"
                )
    return action_spec.space.n if discrete else action_spec.shape[0]

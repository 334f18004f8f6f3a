"""PPO that explores smoothly: the noise of continuous actions depends on the state.

Generalized state-dependent exploration (gSDE, arXiv 2005.05719) adds to the mean action a linear
function of the features whose random weights stay the same for several steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.modules.models.exploration import gSDEModule

from torchrl_tit.layers import init_orthogonal_
from torchrl_tit.modules.action_specs import describe, initial_scale
from torchrl_tit.modules.tensor_module import TensorModule
from torchrl_tit.settings.numbers import Steps

from .core.networks import is_continuous
from .ppo import PPO, ActorCritic, PPOAlgorithm


@dataclass(frozen=True, kw_only=True)
class SmoothPPO(PPO, algorithm="ppo-gsde"):
    """PPO with generalized state-dependent exploration, for continuous actions."""

    noise_steps: Steps = 4
    """Steps for which an environment's noise keeps its weights; 4 in arXiv 2005.05719 for PPO."""

    def build(self) -> SmoothPPOAlgorithm:
        """Builds the algorithm."""
        return SmoothPPOAlgorithm(self)


class StateDependentNoise(nn.Module):
    """TorchRL's `gSDEModule`, whose noise keeps its weights for a number of steps.

    TorchRL's `gSDENoise` draws them at the start of each episode alone. Here each collector draws
    those of its environments, as Stable-Baselines3 does. While training, and where the most likely
    action is asked for, there is no noise: log-probabilities and entropies are those of a Gaussian,
    over all weights that could have been drawn.

    Args:
        features_dim: size of the features.
        action_dim: number A of entries of an action.
        steps: steps for which the weights stay the same.
        scale: standard deviation of each entry for features of scale 1, float [A].

    Example:
        >>> from torchrl.envs import set_exploration_type
        >>> noise = StateDependentNoise(64, 2, steps=4, scale=torch.ones(2)).eval()
        >>> with set_exploration_type(ExplorationType.RANDOM):
        ...     loc, scale, drawn = noise(torch.zeros(8, 2), torch.randn(8, 64))
        >>> scale.shape, drawn.shape
        (torch.Size([8, 2]), torch.Size([8, 2]))
    """

    def __init__(self, features_dim: int, action_dim: int, steps: int, scale: Tensor) -> None:
        super().__init__()
        # Where gSDEModule clamps, deviations would be others than asked for, and have no gradient.
        self.gsde = gSDEModule(action_dim, features_dim, scale_min=0.0, scale_max=math.inf)
        # gSDEModule means to do the same, but its argument sigma_init has no effect.
        sigma = scale.unsqueeze(-1) * features_dim**-0.5
        with torch.no_grad():
            self.gsde.log_sigma.copy_(sigma + (-sigma).expm1().neg().log())
        self.steps = steps
        self._weights: Tensor | None = None
        self._left = 0

    def forward(self, mean: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns mean, standard deviation and noise of an action.

        Args:
            mean: the mean action, float [..., A].
            features: float [..., F]; no gradient flows back from the noise, as in
                Stable-Baselines3.

        Returns:
            float [..., A] each.
        """
        features = features.detach()
        if self.training or exploration_type() is not ExplorationType.RANDOM:
            # As in gSDEModule, whose checks of its numbers could not be exported.
            variance = (self.gsde.sigma * features.unsqueeze(-2)).square().sum(-1)
            return mean, variance.clamp_min(1e-5).sqrt(), torch.zeros_like(mean)
        mean, scale, action, _ = self.gsde(mean, features, self._draw(features))
        return mean, scale, action - mean

    @contextmanager
    def acting(self) -> Iterator[None]:
        """Begins and ends without weights; see :func:`~torchrl_tit.modules.acting`."""
        self._weights = None
        try:
            yield
        finally:
            self._weights = None

    @torch.compiler.disable
    def _draw(self, features: Tensor) -> Tensor:
        """The weights of the noise, float [..., A, F]."""
        size = self.gsde.log_sigma.shape
        shape = (*features.shape[:-1], *size)
        if self._weights is None or self._weights.shape != shape or self._left == 0:
            self._weights, self._left = torch.randn(shape).to(features), self.steps
        self._left -= 1
        return self._weights


class NoisyNormal(IndependentNormal):
    """A diagonal Gaussian whose samples are its mean and a noise that was drawn already.

    Args:
        loc: mean, float [..., A].
        scale: standard deviation, of the same shape.
        noise: what a sample adds to the mean, of the same shape.

    Example:
        >>> zeros = torch.zeros(2)
        >>> NoisyNormal(zeros, zeros + 1, noise=torch.tensor([0.5, -0.5])).sample()
        tensor([ 0.5000, -0.5000])
    """

    def __init__(self, loc: Tensor, scale: Tensor, noise: Tensor) -> None:
        super().__init__(loc, scale, validate_args=False)
        self.noise = noise

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Returns mean and noise, [*sample_shape, ..., A]."""
        sample = self.base_dist.loc + self.noise
        return sample.expand(*sample_shape, *sample.shape)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Returns the same without gradients."""
        return self.rsample(sample_shape).detach()


class SmoothPPOAlgorithm(PPOAlgorithm):
    """PPO with generalized state-dependent exploration.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if actions are not arrays of floats.
    """

    recipe: SmoothPPO

    def networks(self, env: EnvBase) -> ActorCritic:
        """Builds the networks of PPO, with an actor whose noise depends on the state."""
        model, spec = super().networks(env), env.action_spec_unbatched
        if not is_continuous(spec):
            raise ValueError(
                f"state-dependent noise is for continuous actions, not for {describe(spec)}: use a "
                "ppo recipe"
            )
        key, features_dim = model.backbone.features_keys[0], model.backbone.features_dim
        mean = nn.Linear(features_dim, spec.shape[0])
        init_orthogonal_(mean, gain=0.01)
        scale = initial_scale(spec, spec.shape, self.recipe.initial_std)
        noise = StateDependentNoise(features_dim, spec.shape[0], self.recipe.noise_steps, scale)
        model.actor = ProbabilisticActor(
            TensorDictSequential(
                TensorModule(mean, [key], ["mean"]),
                TensorModule(noise, ["mean", key], ["loc", "scale", "noise"]),
            ),
            in_keys=["loc", "scale", "noise"],
            distribution_class=NoisyNormal,
            return_log_prob=True,
            log_prob_key="action_log_prob",
        )
        return model

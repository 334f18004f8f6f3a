"""Settings of TD3+BC; the algorithm is in algorithm.py."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_tit.settings.checks import check_at_least

from ..transition_recipe import ActorCriticRecipe


@dataclass(frozen=True, kw_only=True)
class TD3BC(ActorCriticRecipe, algorithm="td3bc", builds=f"{__package__}.algorithm:TD3BCAlgorithm"):
    """TD3 with a behaviour cloning term (arXiv 2106.06860), with the paper's defaults."""

    normalize_observations: bool = True
    """Whether networks read observations minus their mean in the data, divided by their standard
    deviation there; only for arrays of floats."""
    actor_learning_rate: float = 3e-4
    """Learning rate of Adam for the actor."""
    critic_learning_rate: float = 3e-4
    """Learning rate of Adam for the critics."""
    alpha: float = 2.5
    """Weight of the value in the actor's loss, beside that of the data's actions."""
    policy_delay: int = 2
    """Gradient steps of the critics between two of the actor and of the targets."""
    policy_noise: float = 0.2
    """Standard deviation of the noise on the target's actions; 1 is half the range of actions."""
    noise_clip: float = 0.5
    """Largest absolute value of that noise; 1 is half the range of actions."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(
            self,
            actor_learning_rate=0,
            critic_learning_rate=0,
            alpha=0,
            policy_delay=1,
            policy_noise=0,
            noise_clip=0,
        )

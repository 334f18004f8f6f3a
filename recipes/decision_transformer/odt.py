"""Online Decision Transformer: pre-trained on a data set, then fine-tuned on its own episodes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from pytorch_optimizer import Lamb
from torch import Tensor, nn
from torchrl.objectives import OnlineDTLoss

from torchrl_tit.datasets import Episodes, SequenceStorage
from torchrl_tit.modules import make_dt_actor
from torchrl_tit.networks import DecisionTransformerConfig

from ..finite import check_finite
from ..offline.state import TrainingState
from ..offline.training import Training, run_updates
from ..recipe import check_at_least
from ..run import Run
from .data import load_data, warn_of_targets
from .odt_data import OnlineData
from .odt_exploration import explore
from .recipe import SequenceRecipe

LOSSES = ["loss_log_likelihood", "loss_entropy", "entropy", "alpha", "gradient_norm"]
TERMS = [*LOSSES, "online_return"]
"""What a row of metrics has the means of; online_return is the newest episodes'."""

NETWORK = DecisionTransformerConfig(
    action_space="gaussian", embed_dim=512, num_blocks=4, num_heads=4, timestep_embedding=False
)
"""The network of the paper."""


@dataclass(frozen=True, kw_only=True)
class ODT(SequenceRecipe):
    """Online Decision Transformer (arXiv 2202.05607).

    The defaults are those of its authors' release.
    """

    algorithm: ClassVar[str] = "odt"

    backbone: DecisionTransformerConfig = field(default_factory=lambda: NETWORK)
    """The network and its hyperparameters."""
    acting_context: int | None = 5
    """Steps that the network sees when it acts; those of a training window where not given, which
    are the most."""
    batch_size: int = 256
    """Subsequences in one gradient step."""
    learning_rate: float = 1e-4
    """Learning rate of LAMB after warm-up."""
    weight_decay: float = 5e-4
    """Weight decay, on every parameter."""
    alpha_init: float = 0.1
    """Weight of the entropy at the start (the temperature)."""
    alpha_learning_rate: float = 1e-4
    """Learning rate of Adam for the temperature."""
    pretraining_updates: int = 5000
    """Gradient steps on the data set."""
    rounds: int = 1500
    """Rounds of new episodes and some gradient steps after that."""
    episodes_per_round: int = 1
    """Episodes that a round begins with, played side by side."""
    updates_per_round: int = 300
    """Gradient steps in each round."""
    online_return: float
    """Return that the network is asked for in the episodes that it trains on."""
    exploration_scale: float = 1.0
    """What the standard deviation of actions is multiplied by in those episodes: below 1 where the
    data's policies are noisy, whose noise is learnt with their actions."""
    capacity: int = 1000
    """Episodes that are kept to train on."""
    evaluation_interval: int = 10
    """Rounds between evaluations; there is one before the first, too, and one after the last."""
    evaluation_episodes: int = 10
    """Episodes for each target return, in every evaluation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(
            self,
            alpha_learning_rate=0,
            pretraining_updates=1,
            rounds=0,
            episodes_per_round=1,
            updates_per_round=1,
            capacity=1,
            evaluation_interval=1,
        )
        if not self.alpha_init > 0:
            raise ValueError(f"alpha_init must be positive, not {self.alpha_init}")
        if not self.exploration_scale > 0:
            raise ValueError(f"exploration_scale must be positive, not {self.exploration_scale}")
        if not math.isfinite(self.online_return):
            raise ValueError(f"online_return must be finite, not {self.online_return}")
        if self.backbone.action_space != "gaussian":
            raise ValueError(
                f"backbone.action_space is {self.backbone.action_space!r}, but exploration takes a "
                "distribution of continuous actions: set it to 'gaussian'"
            )

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.pretraining_updates + self.rounds * self.updates_per_round

    def evaluation_due(self, step: int) -> bool:
        """Whether pre-training, or enough rounds, end after so many gradient steps."""
        rounds, within = divmod(step - self.pretraining_updates, self.updates_per_round)
        due = rounds % self.evaluation_interval == 0 or rounds == self.rounds
        return rounds >= 0 and within == 0 and due

    def round_begins(self, step: int) -> bool:
        """Whether a round begins with so many gradient steps done."""
        online = step - self.pretraining_updates
        return online >= 0 and online % self.updates_per_round == 0

    def train(self, run: Run) -> None:
        """Trains in a run folder; see :func:`train`."""
        train(self, run)


def train(recipe: ODT, run: Run) -> None:
    """Trains a network, from the newest checkpoint of the run where there is one.

    Args:
        recipe: the settings.
        run: an open run folder.

    Raises:
        FloatingPointError: if a loss or the gradient is not finite.
    """
    torch.set_num_threads(recipe.threads)
    torch.manual_seed(recipe.seed)
    episodes = load_data(recipe.dataset, recipe.backbone, **recipe.reading())
    warn_of_targets(recipe.target_returns, episodes)
    agent = recipe.make_agent()
    agent.fit_statistics(episodes)

    def make_storage(episodes: Episodes) -> SequenceStorage:
        return SequenceStorage(
            episodes,
            recipe.backbone.context,
            mean=agent.mean if agent.normalizes else None,
            std=agent.std if agent.normalizes else None,
            return_scale=recipe.return_scale,
            action_padding=0.0,
        )

    data = OnlineData(
        episodes.to(recipe.torch_device()),
        make_storage,
        batch_size=recipe.batch_size,
        capacity=recipe.capacity,
        seed=recipe.seed,
    )
    loss = OnlineDTLoss(
        make_dt_actor(agent.network, group=None, newest=False),
        alpha_init=recipe.alpha_init,
        target_entropy=-float(agent.network.action_dim),
    )
    loss.loss_mask_key = "mask"  # or padding counts
    parameters = list(agent.parameters())
    optimizer = make_lamb(parameters, recipe.learning_rate, recipe.weight_decay)
    alpha_optimizer = torch.optim.Adam([loss.log_alpha], lr=recipe.alpha_learning_rate)
    state = TrainingState(
        {
            "agent": agent,
            "optimizer": optimizer,
            "alpha": _Scalar(loss.log_alpha),
            "alpha_optimizer": alpha_optimizer,
            "data": data,
        },
        recipe.evaluation_seed,
    )

    def update(step: int) -> Tensor:
        if recipe.round_begins(step):
            data.add(explore(agent, recipe, data.rounds))
        for group in optimizer.param_groups:
            group["lr"] = recipe.learning_rate_at(step)
        terms = loss(data.sample())
        optimizer.zero_grad()
        (terms["loss_log_likelihood"] + terms["loss_entropy"]).backward()
        terms["gradient_norm"] = nn.utils.clip_grad_norm_(parameters, recipe.max_grad_norm)
        values = torch.stack([terms[name].detach() for name in LOSSES])
        check_finite(LOSSES, values, step, state.saved_step)
        optimizer.step()
        alpha_optimizer.zero_grad()
        terms["loss_alpha"].backward()
        alpha_optimizer.step()
        return torch.cat([values, values.new_tensor([data.newest_return])])

    # There is no online return before the first round.
    training = Training(recipe, run, agent, state)
    run_updates([training], TERMS, update, finite=len(LOSSES))


def make_lamb(parameters: list[nn.Parameter], learning_rate: float, weight_decay: float) -> Lamb:
    """Builds LAMB (arXiv 1904.00962) as the release of Online Decision Transformer has it.

    Weight decay is part of the update whose norm is compared with the weights'. The latter is not
    cut off at 10, which wide layers reach, and the step is not divided by a bias correction, which
    the norms cancel.
    """
    optimizer = Lamb(
        parameters,
        lr=learning_rate,
        weight_decay=weight_decay,
        weight_decouple=False,
        eps=1e-8,
        adam_debias=True,
    )
    optimizer.clamp = math.inf
    return optimizer


class _Scalar:
    """A parameter that belongs to no module, as a part of a checkpoint."""

    def __init__(self, parameter: Tensor) -> None:
        self._parameter = parameter

    def state_dict(self) -> dict[str, Tensor]:
        return {"value": self._parameter.detach().clone()}

    def load_state_dict(self, state_dict: dict[str, Tensor]) -> None:
        with torch.no_grad():
            self._parameter.copy_(state_dict["value"])

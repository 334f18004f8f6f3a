"""Online Decision Transformer: pre-trained on a data set, then fine-tuned on its own episodes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import OnlineDTLoss

from torchrl_tit.datasets import Episodes
from torchrl_tit.extras import Missing
from torchrl_tit.modules import acting, make_dt_actor

from ..algorithm import Stateful, check_finite
from ..task import seed_copies
from .odt_data import OnlineData
from .odt_exploration import play_episodes, scale_noise
from .sequence_algorithm import SequenceAlgorithm
from .settings import ODT

try:
    import pytorch_optimizer
except ModuleNotFoundError:
    pytorch_optimizer = Missing("pytorch_optimizer")  # type: ignore[assignment]

_TERMS = ("loss_log_likelihood", "loss_entropy", "entropy", "alpha")


class ODTAlgorithm(SequenceAlgorithm[ODT]):
    """Online Decision Transformer: LAMB on the likelihood of actions and their entropy.

    Args:
        recipe: the settings.
    """

    columns = (*_TERMS, "gradient_norm", "online_return", "learning_rate")
    optional_columns = ("online_return",)  # of the newest episodes; pre-training plays none
    action_padding = 0.0

    buffer: OnlineData
    """The data set, and after the first round the newest episodes."""

    def prepare(self, step: int, folder: Path) -> None:
        """Builds data, loss and optimizers."""
        recipe, agent = self.recipe, self.agent.train()
        self.step = step
        self.buffer = self.make_buffer()
        self.loss = OnlineDTLoss(
            make_dt_actor(agent.network, agent.head, group=None, every_frame=True),
            alpha_init=recipe.alpha_init,
            target_entropy=-float(self.action_dim),
        )
        self.loss.loss_mask_key = "mask"  # otherwise padding counts
        self.optimizer = make_lamb(
            list(agent.parameters()), recipe.learning_rate, recipe.weight_decay
        )
        self.alpha_optimizer = torch.optim.Adam(
            [self.loss.log_alpha], lr=recipe.alpha_learning_rate
        )

    def make_buffer(self) -> OnlineData:
        """Reads the data set; new episodes are added to it in :meth:`batches`."""
        recipe = self.recipe
        return OnlineData(
            self.load_data(),
            self.make_storage,
            batch_size=recipe.batch_size,
            capacity=recipe.capacity,
            seed=recipe.seed,
        )

    def state(self) -> Mapping[str, Stateful]:
        """Optimizers, temperature, and the episodes to train on."""
        return {
            "optimizer": self.optimizer,
            "alpha": _Scalar(self.loss.log_alpha),
            "alpha_optimizer": self.alpha_optimizer,
            "data": self.buffer,
        }

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields windows [B]; plays new episodes when a round begins."""
        while True:
            if self.recipe.round_begins(self.step):
                self.buffer.add(self.explore(self.buffer.rounds))
            yield self.buffer.sample()

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor | float]:
        """Takes a gradient step on windows [B], first of the network, then of the temperature."""
        learning_rate = self.recipe.learning_rate_at(step)
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        terms = self.loss(batch)
        self.optimizer.zero_grad()
        (terms["loss_log_likelihood"] + terms["loss_entropy"]).backward()
        norm = nn.utils.clip_grad_norm_(self.agent.parameters(), self.recipe.max_grad_norm)
        values = torch.stack([*(terms[name].detach() for name in _TERMS), norm])
        check_finite(self.columns[: len(values)], values)
        self.optimizer.step()
        self.alpha_optimizer.zero_grad()
        terms["loss_alpha"].backward()
        self.alpha_optimizer.step()
        self.step = step + 1
        others = [self.buffer.newest_return, learning_rate]
        return dict(zip(self.columns, [*values, *others], strict=True))

    def explore(self, number: int) -> Episodes:
        """Plays a round's episodes side by side, with sampled actions, without dropout.

        Args:
            number: number of the round, which determines its seeds together with the recipe's seed.
        """
        recipe = self.recipe
        env = self.make_env(recipe.episodes_per_round, target_return=recipe.online_return)
        seed_copies(env, recipe.seed, number)
        actor = scale_noise(self.policy, recipe.exploration_scale)
        self.agent.eval()
        with torch.no_grad(), acting(actor), set_exploration_type(ExplorationType.RANDOM):
            episodes = play_episodes(env, actor)
        self.agent.train()
        env.close()
        return episodes


def make_lamb(parameters: list[nn.Parameter], learning_rate: float, weight_decay: float) -> Any:
    """Builds LAMB (arXiv 1904.00962) as in the release of Online Decision Transformer.

    Weight decay is part of the update whose norm is compared with the norm of the weights. The
    latter is not clipped at 10, which wide layers reach. The step is not divided by a bias
    correction, because the norms would cancel it.
    """
    optimizer = pytorch_optimizer.Lamb(
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

    def load_state_dict(self, state_dict: dict[str, Tensor], /) -> None:
        with torch.no_grad():
            self._parameter.copy_(state_dict["value"])

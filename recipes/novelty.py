"""PPO with a bonus for what is new: a way to the first reward on tasks that give it seldom.

The bonus is NovelD's (Zhang et al., "NovelD: A simple yet effective exploration criterion", NeurIPS
2021): how much newer the next observation is than this one, at its first visit in an episode. How
new an observation is, is measured by random network distillation (RND, arXiv 1810.12894).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_tit.envs import observation_specs
from torchrl_tit.frames.normalized import NormalizedFrames
from torchrl_tit.frames.observation import Observations
from torchrl_tit.layers import init_orthogonal_
from torchrl_tit.modules.backbone import trunks_of
from torchrl_tit.networks import build_network
from torchrl_tit.settings import MLP, Head, Network
from torchrl_tit.settings.numbers import Fraction, Weight

from .core.adaptive import ReturnScale
from .core.algorithm import Stateful
from .core.networks import normalize_frames
from .ppo import PPO, ActorCritic, Minibatch, PPOAlgorithm


@dataclass(frozen=True, kw_only=True)
class NovelPPO(PPO, algorithm="ppo-noveld"):
    """PPO whose rewards include NovelD's exploration bonus; reported returns do not.

    Besides the networks of PPO, there is a fixed random one, with a frame encoder like that of the
    policy, and one that learns to predict its output from the same tokens.
    """

    novelty_coeff: Weight = 0.5
    """Weight of the bonus, which is divided by the running standard deviation of its discounted
    return, as normalize_rewards divides the task's rewards."""
    novelty_alpha: Fraction = 0.5
    """How much of this observation's novelty is subtracted from the next one's: 0.5 in the paper; 0
    makes the bonus that of random network distillation, gated to first visits."""
    novelty_cell: Weight = 0.5
    """Width of the cells, in standard deviations of each entry, within which observations of floats
    count as the same in an episode; 0 counts equal ones only. The deviations are running ones, so a
    batch later the same observation may be in another cell, ever more rarely as the run goes on.
    Bytes and categories must be equal, as in the paper."""

    def build(self) -> NovelPPOAlgorithm:
        """Builds the algorithm."""
        return NovelPPOAlgorithm(self)


class Novelty(nn.Module):
    """A fixed random network, and layers that predict its output where observations are known.

    The random network is a frame encoder with the settings of the policy's, and two layers. The
    predictor is two other layers on the same tokens, as in NovelD, whose encoder is fixed too. Both
    read observations normalized to a running mean of 0 and standard deviation of 1 and clipped to
    +-5 (arXiv 1810.12894, section 2.4), whatever the policy reads.

    Args:
        network: settings of the policy's network, whose frame encoder is used.
        observation: spec of the observation, or of each by name.

    Example:
        >>> from torchrl_tit.settings.networks import enhanced_tit
        >>> novelty = Novelty(enhanced_tit(4), (3,))
        >>> novelty([torch.randn(8, 16, 3)]).shape
        torch.Size([8, 16])
    """

    def __init__(self, network: Network, observation: Observations) -> None:
        super().__init__()
        # Units of relu that are 0 wherever the agent has been never learn: on TIT's tokens, a sixth
        # of the squared error remained forever, and with it the bonus.
        layers = MLP(hidden_dim=128, num_layers=2, activation="tanh")
        one_frame = replace(network, history=layers, head=Head(features_dim=None), num_frames=1)
        self.target = trunks_of(build_network(one_frame, observation, trunks="shared"))[""]
        self.predictor = copy.deepcopy(self.target.history_encoder)
        init_orthogonal_(self)
        normalize_frames(self.target, limit=5.0)
        self.target.requires_grad_(False)

    def train(self, mode: bool = True) -> Novelty:
        """Stays in evaluation mode: with dropout, the target would not be a fixed function."""
        return super().train(False)

    def update(self, observations: Sequence[Tensor]) -> None:
        """Adds observations to the statistics, [..., *observation_shape] each."""
        for frames, seen in zip(self.target.frames, observations, strict=True):
            if isinstance(frames, NormalizedFrames):
                frames.update(seen.reshape(-1, *frames.observation_shape))

    def errors(self, observations: Sequence[Tensor]) -> Tensor:
        """Squared errors of the prediction, [..., *observation_shape] each -> float [..., F]."""
        target, histories = self.target, []
        for encoder, seen in zip(target.frames, observations, strict=True):
            histories.append(seen.unsqueeze(-1 - len(encoder.observation_shape)))
        tokens = target.as_floats(target.encode_frames(*histories))
        return (self.predictor(tokens) - target.encode_history(tokens)).square()

    def forward(self, observations: Sequence[Tensor]) -> Tensor:
        """How new observations are, [..., *observation_shape] each -> float [...]."""
        return self.errors(observations).sum(-1).sqrt()

    def cells(self, observations: Sequence[Tensor], width: float) -> Tensor:
        """Numbers that are equal where observations count as the same, float64 [..., entries].

        Args:
            observations: [..., *observation_shape] each.
            width: of a cell of normalized floats; 0 tells apart all that are not equal.
        """
        entries = []
        for frames, seen in zip(self.target.frames, observations, strict=True):
            seen = frames.clean(seen)
            if width and seen.is_floating_point() and isinstance(frames, NormalizedFrames):
                seen = (frames.normalize(seen) / width).floor()
            entries.append(seen.flatten(-len(frames.observation_shape)))
        return torch.cat(entries, -1)


class FirstVisits:
    """Which observations are seen for the first time in an episode.

    The episodes of each environment go on from batch to batch. A resumed run begins new ones, so
    there is nothing to save.

    Example:
        >>> visits = FirstVisits()
        >>> this, following = torch.tensor([[[1], [2], [3]]]), torch.tensor([[[2], [1], [2]]])
        >>> visits.add(this, following, done=torch.tensor([[[False], [True], [False]]]))
        tensor([[[ True],
                 [False],
                 [ True]]])
    """

    def __init__(self) -> None:
        self._seen: list[set[int]] = []

    def add(self, this: Tensor, following: Tensor, done: Tensor) -> Tensor:
        """Adds a batch.

        Args:
            this: the cells of the observations, [envs, time, entries].
            following: those of the observations after the steps.
            done: whether an episode ends with the step, bool [envs, time, 1].

        Returns:
            Whether each step leads to an observation that is new in its episode, bool [envs, time,
            1].
        """
        self._seen = self._seen or [set() for _ in done]
        first = torch.zeros(done.shape, dtype=torch.bool)
        batch = zip(self._seen, _hashes(this), _hashes(following), done.tolist(), strict=True)
        for env, (seen, *steps) in enumerate(batch):
            for step, (before, after, [ended]) in enumerate(zip(*steps, strict=True)):
                seen.add(before)
                first[env, step] = after not in seen
                seen.add(after)
                if ended:
                    seen.clear()
        return first.to(done.device)


def _hashes(cells: Tensor) -> list[list[int]]:
    """Hashes of cells, [envs, time, entries] -> [envs][time]; -0.0 becomes 0.0."""
    return [[hash(cell.tobytes()) for cell in env] for env in (cells + 0).cpu().numpy()]


class NovelActorCritic(ActorCritic):
    """The networks of PPO, and those that measure novelty."""

    novelty: Novelty


class NovelPPOAlgorithm(PPOAlgorithm):
    """PPO with NovelD's bonus.

    Args:
        recipe: the settings.
    """

    recipe: NovelPPO
    model: NovelActorCritic
    terms = (*PPOAlgorithm.terms, "loss_novelty", "bonus")
    step_keys = (*PPOAlgorithm.step_keys, "bonus", "following")

    def __init__(self, recipe: NovelPPO) -> None:
        super().__init__(recipe)
        self.bonus_scale = ReturnScale(recipe.gamma)
        self.visits = FirstVisits()

    def networks(self, env: EnvBase) -> ActorCritic:
        """Builds the networks of PPO, and those that measure novelty."""
        model = super().networks(env)
        model.novelty = Novelty(self.recipe.backbone, observation_specs(env))
        return model

    def state(self) -> Mapping[str, Stateful]:
        """That of PPO, and the scale of the bonus."""
        return {**super().state(), "bonus_scale": self.bonus_scale}

    def collected(self, batch: TensorDictBase) -> TensorDictBase:
        """Adds the bonus, float [envs, time, 1], to the rewards to train on."""
        recipe, novelty = self.recipe, self.model.novelty
        batch = super().collected(batch)
        done, following = batch["next", "done"], batch["next"].select("observation")
        batch["following"] = following
        this, after = self._observations(batch), self._observations(following)
        novelty.update(after)
        begins = done.squeeze(-1).roll(1, 1)
        begins[:, 0] = True  # elsewhere, the step before led here
        new = novelty(after)
        before = new.roll(1, 1)
        before[begins] = novelty([seen[begins] for seen in this])
        risen = (new - recipe.novelty_alpha * before).clamp(min=0)
        width = recipe.novelty_cell
        first = self.visits.add(novelty.cells(this, width), novelty.cells(after, width), done)
        bonus = risen.unsqueeze(-1) * first
        bonus = bonus / (self.bonus_scale.update(bonus, done) + 1e-8)
        batch["bonus"] = recipe.novelty_coeff * bonus
        batch["next", "reward"] = batch["next", "reward"] + batch["bonus"]
        return batch

    def loss(self, minibatch: Minibatch) -> TensorDictBase:
        """Adds the error of the prediction on the observations that the steps led to."""
        terms, steps = super().loss(minibatch), minibatch.steps
        errors = self.model.novelty.errors(self._observations(steps["following"]))
        terms["loss_novelty"] = errors.mean()
        terms["bonus"] = steps["bonus"].mean()
        return terms

    def _observations(self, steps: TensorDictBase) -> list[Tensor]:
        """The observations of steps, in the order of the networks, [..., *observation_shape]."""
        return [steps[key] for key in self.model.backbone.sequence_keys.observations]

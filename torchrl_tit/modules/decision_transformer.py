"""Decision Transformer's head, its policy, and the module that its losses train."""

from __future__ import annotations

from typing import Literal

from tensordict import NestedKey
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictSequential,
)
from tensordict.utils import unravel_key
from torch import Tensor, distributions, nn
from torchrl.modules import OneHotCategorical, TanhNormal

from torchrl_tit.modules.backbone import Backbone
from torchrl_tit.modules.tensor_module import TensorModule
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.numbers import Size

ActionSpace = Literal["continuous", "gaussian", "discrete"]

_LOG_STD_MIN, _LOG_STD_MAX = -5.0, 2.0


class GaussianHead(nn.Module):
    """Mean and standard deviation of each entry of an action, before a tanh squashes it.

    Zheng et al., "Online Decision Transformer", arXiv 2202.05607, and its authors' code: two linear
    layers with orthogonal initialization; a tanh keeps the logarithm of the standard deviation
    between -5 and 2.

    Args:
        in_features: size F of the features.
        action_dim: entries A of an action.

    Example:
        >>> import torch
        >>> mean, std = GaussianHead(64, 3)(torch.randn(8, 20, 64))
        >>> mean.shape, bool(((std > 0.006) & (std < 7.4)).all())
        (torch.Size([8, 20, 3]), True)
    """

    def __init__(self, in_features: int, action_dim: int) -> None:
        super().__init__()
        self.mean = nn.Linear(in_features, action_dim)
        self.log_std = nn.Linear(in_features, action_dim)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes the weights orthogonally and the biases with zeros."""
        for layer in (self.mean, self.log_std):
            nn.init.orthogonal_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Float [..., F] -> mean and standard deviation, float [..., A] each."""
        middle, half = (_LOG_STD_MAX + _LOG_STD_MIN) / 2, (_LOG_STD_MAX - _LOG_STD_MIN) / 2
        log_std = middle + half * self.log_std(features).tanh()
        return self.mean(features), log_std.exp()


class DTHead(nn.Module):
    """Maps Decision Transformer's features to actions, or to the parameters of a distribution.

    Args:
        features_dim: size F of the features.
        action_dim: entries A of a continuous action, or number A of discrete actions.
        action_space: "continuous" predicts actions in -1..1 with a tanh; "gaussian" predicts a
            tanh-squashed Gaussian, as in Online DT; "discrete" predicts logits.

    Raises:
        ValueError: if there is no such ``action_space``.
        TypeError: in ``forward``, if the network read actions of another kind.

    Example:
        >>> import torch
        >>> DTHead(128, 3)(torch.randn(8, 20, 128)).shape
        torch.Size([8, 20, 3])
    """

    @checked_arguments
    def __init__(
        self, features_dim: Size, action_dim: Size, action_space: ActionSpace = "continuous"
    ) -> None:
        super().__init__()
        self.action_space = action_space
        self.layers: nn.Module
        if action_space == "gaussian":
            self.layers = GaussianHead(features_dim, action_dim)
        else:
            squash = nn.Tanh() if action_space == "continuous" else nn.Identity()
            self.layers = nn.Sequential(nn.Linear(features_dim, action_dim), squash)

    def forward(
        self, features: Tensor, action: Tensor | None = None
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Maps features to actions.

        Args:
            features: float [..., F].
            action: the actions that the network read, to check that they suit this head; not
                checked if None.

        Returns:
            float [..., A]: actions or logits; for a Gaussian, its mean and standard deviation.
        """
        if action is not None:
            discrete = not action.is_floating_point()
            if discrete != (self.action_space == "discrete"):
                given = "discrete" if discrete else "continuous"
                raise TypeError(
                    f"actions of {action.dtype} are {given}, but this head's are "
                    f"{self.action_space}: set action_space={given!r}, or use other data"
                )
        return self.layers(features)


class ActionPredictor(nn.Module):
    """Decision Transformer and its head, with the interface of the authors' network.

    Args:
        network: computes features.
        head: maps features to actions.
    """

    def __init__(self, network: HistoryNetwork, head: DTHead) -> None:
        super().__init__()
        self.network = network
        self.head = head

    def forward(
        self,
        states: Tensor,
        actions: Tensor,
        returns_to_go: Tensor,
        timesteps: Tensor,
        attention_mask: Tensor | None = None,
    ) -> Tensor:
        """Predicts the action of every step from the past.

        Args:
            states: float [..., K, S].
            actions: float [..., K, A].
            returns_to_go: float [..., K, 1].
            timesteps: int64 [..., K].
            attention_mask: [..., K], 0 or False at padding.

        Returns:
            float [..., K, A].
        """
        inputs = [states, actions, returns_to_go, timesteps]
        if attention_mask is not None:
            inputs.append(attention_mask)
        features = self.network.every_frame(*inputs)
        return self.head(features)


def make_dt_backbone(
    network: HistoryNetwork, *, group: NestedKey | None = None, every_frame: bool = False
) -> Backbone:
    """Builds the backbone that reads the entries of a window and writes "features".

    Args:
        network: a Decision Transformer of one observation.
        group: the key under which "observation", "action", "return_to_go", "timestep" and "mask"
            are stored, as in :class:`~torchrl_tit.transforms.SequenceHistory`; None for the top
            level, as in batches of :class:`~torchrl_tit.datasets.SequenceStorage`.
        every_frame: write the features of all steps, [..., K, F], instead of the newest one's,
            [..., F].

    Example:
        >>> from torchrl_tit.networks import DecisionTransformer
        >>> make_dt_backbone(DecisionTransformer((11,), action_dim=3), group="sequence").in_keys[:2]
        [('sequence', 'observation'), ('sequence', 'action')]
    """
    names = ["observation", *network.history_encoder.context]
    in_keys = [name if group is None else unravel_key((group, name)) for name in names]
    return Backbone(network, in_keys, every_frame=every_frame)


def make_dt_predictor(network: HistoryNetwork, head: DTHead) -> TensorDictSequential:
    """Builds the module that Decision Transformer's loss trains: it predicts every step's action.

    Args:
        network: a Decision Transformer.
        head: its head.

    Returns:
        A module that reads a batch of :class:`~torchrl_tit.datasets.SequenceStorage` and replaces
        its "action" with the predicted ones, float [..., K, A]: actions within -1..1, or logits of
        discrete ones. For TorchRL's `DTLoss` and
        :class:`~torchrl_tit.objectives.MaskedDTLoss`.

    Raises:
        ValueError: if the head predicts distributions (``action_space="gaussian"``).

    Example:
        >>> from torchrl.objectives import DTLoss
        >>> from torchrl_tit.networks import DecisionTransformer
        >>> network = DecisionTransformer((11,), action_dim=3)
        >>> loss = DTLoss(make_dt_predictor(network, DTHead(network.features_dim, 3)))
        >>> loss.loss_mask_key = "mask"  # otherwise padding counts
    """
    if head.action_space == "gaussian":
        raise ValueError(
            "this head's actions are gaussian: they have a likelihood, not an error. Train "
            "make_dt_actor(network, head, group=None, every_frame=True) with TorchRL's "
            "OnlineDTLoss, or set action_space='continuous'"
        )
    backbone = make_dt_backbone(network, every_frame=True)
    return TensorDictSequential(backbone, TensorModule(head, ["features", "action"], ["action"]))


def make_dt_actor(
    network: HistoryNetwork,
    head: DTHead,
    *,
    group: NestedKey | None = "sequence",
    action_key: NestedKey = "action",
    one_hot: bool = False,
    every_frame: bool = False,
) -> TensorDictSequential:
    """Builds Decision Transformer's policy: it reads a window and writes the newest step's action.

    Args:
        network: a Decision Transformer; its weights are shared with other modules, not copied.
        head: its head.
        group: the key under which :class:`~torchrl_tit.transforms.SequenceHistory` writes.
        action_key: key under which the action is written.
        one_hot: whether the environment's discrete actions are one-hot.
        every_frame: write the actions of all steps, for losses on distributions such as TorchRL's
            `OnlineDTLoss`; usually with ``group=None``.

    Returns:
        A policy for any TorchRL collector. A continuous head's actions, float [..., A], are written
        as predicted; gaussian ones and discrete ones, int64 [...] or one-hot [..., A], are the most
        likely actions or samples, according to TorchRL's exploration type. With ``every_frame``,
        shapes are [..., K, A] or [..., K].

    Example:
        >>> from torchrl.collectors import Collector
        >>> from torchrl.envs import Compose, TargetReturn, TransformedEnv
        >>> from torchrl_tit.envs import make_env
        >>> from torchrl_tit.networks import DecisionTransformer
        >>> from torchrl_tit.transforms import SequenceHistory
        >>> network = DecisionTransformer((4,), action_dim=2, num_frames=5)
        >>> policy = make_dt_actor(network, DTHead(network.features_dim, 2, "discrete"))
        >>> transforms = Compose(TargetReturn(500.0), SequenceHistory(num_frames=5))
        >>> env = TransformedEnv(make_env("CartPole-v1", 8), transforms)
        >>> collector = Collector(
        ...     env,
        ...     policy,
        ...     frames_per_batch=80,
        ...     total_frames=80,
        ...     auto_register_policy_transforms=False,
        ... )
        >>> [batch["action"].shape for batch in collector]
        [torch.Size([8, 10])]
        >>> collector.shutdown()
    """
    backbone = make_dt_backbone(network, group=group, every_frame=every_frame)
    head_keys = ["features", backbone.in_keys[1]]  # the latter to check the kind of actions
    if head.action_space == "continuous":
        return TensorDictSequential(backbone, TensorModule(head, head_keys, [action_key]))
    distribution: type[distributions.Distribution]
    if head.action_space == "gaussian":
        parameters, distribution = ["loc", "scale"], TanhNormal
    else:
        parameters = ["logits"]
        distribution = OneHotCategorical if one_hot else distributions.Categorical
    return ProbabilisticTensorDictSequential(
        backbone,
        TensorModule(head, head_keys, parameters),
        ProbabilisticTensorDictModule(
            in_keys=parameters, out_keys=[action_key], distribution_class=distribution
        ),
    )

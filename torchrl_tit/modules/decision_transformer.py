"""Decision Transformer's policy, and what its losses train."""

from __future__ import annotations

from tensordict import NestedKey
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import distributions
from torchrl.modules import OneHotCategorical, TanhNormal

from torchrl_tit.modules.sequence_backbone import SequenceBackbone
from torchrl_tit.networks import DecisionTransformer


def make_dt_predictor(network: DecisionTransformer) -> TensorDictSequential:
    """Builds what Decision Transformer's loss trains: the prediction of every step's action.

    Args:
        network: the network.

    Returns:
        A module that reads a batch of :class:`~torchrl_tit.datasets.SequenceStorage` and writes
        over its "action" the predicted ones, float [..., K, A]: actions within -1..1, or logits of
        discrete ones. TorchRL's `DTLoss` takes it, and
        :class:`~torchrl_tit.objectives.MaskedDTLoss`.

    Raises:
        ValueError: if the network predicts distributions (``action_space="gaussian"``).

    Example:
        >>> import torch
        >>> from torchrl.objectives import DTLoss
        >>> loss = DTLoss(make_dt_predictor(DecisionTransformer((11,), 3)))
        >>> loss.loss_mask_key = "mask"  # or padding counts
    """
    if network.config.action_space == "gaussian":
        raise ValueError(
            "this network's actions are gaussian, which have no error, but a likelihood: train "
            "make_dt_actor(network, group=None, newest=False) on TorchRL's OnlineDTLoss, or set "
            "action_space='continuous'"
        )
    return TensorDictSequential(
        SequenceBackbone(network), TensorDictModule(network.action_head, ["features"], ["action"])
    )


def make_dt_actor(
    network: DecisionTransformer,
    *,
    group: NestedKey | None = "sequence",
    action_key: NestedKey = "action",
    one_hot: bool = False,
    newest: bool = True,
) -> TensorDictSequential:
    """Builds Decision Transformer's policy: histories in, the newest step's action out.

    Args:
        network: the network, as it is trained: weights are shared, not copied.
        group: the key under which :class:`~torchrl_tit.transforms.SequenceHistory` writes.
        action_key: where the action goes.
        one_hot: whether discrete actions are one-hot, as the environment's spec says.
        newest: whether only the newest step's action is asked for; for losses on distributions,
            such as TorchRL's `OnlineDTLoss`, that of every step is, with ``group=None``.

    Returns:
        A policy for any TorchRL collector. It writes continuous actions, float [..., A], as they
        are predicted; those of a network with ``action_space="gaussian"`` and discrete ones, int64
        [...] or one-hot [..., A], are the most likely ones, or drawn, as TorchRL's exploration type
        says. With ``newest=False``, all shapes are [..., K, A] or [..., K].

    Example:
        >>> from torchrl.collectors import Collector
        >>> from torchrl.envs import Compose, TargetReturn, TransformedEnv
        >>> from torchrl_tit.envs import make_env
        >>> from torchrl_tit.transforms import SequenceHistory
        >>> network = DecisionTransformer((4,), 2, action_space="discrete", context=5)
        >>> transforms = Compose(TargetReturn(500.0), SequenceHistory(context=5))
        >>> env = TransformedEnv(make_env("CartPole-v1", 8), transforms)
        >>> policy = make_dt_actor(network)
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
    backbone = SequenceBackbone(network, group=group, newest=newest)
    if network.config.action_space == "continuous":
        return TensorDictSequential(
            backbone, TensorDictModule(network.action_head, ["features"], [action_key])
        )
    distribution: type[distributions.Distribution]
    if network.config.action_space == "gaussian":
        parameters, distribution = ["loc", "scale"], TanhNormal
    else:
        parameters = ["logits"]
        distribution = OneHotCategorical if one_hot else distributions.Categorical
    return ProbabilisticTensorDictSequential(
        backbone,
        TensorDictModule(network.action_head, ["features"], parameters),
        ProbabilisticTensorDictModule(
            in_keys=parameters, out_keys=[action_key], distribution_class=distribution
        ),
    )

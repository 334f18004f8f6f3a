"""The networks of the paper and further baselines by name.

:mod:`torchrl_tit.settings.networks` describes each: its source, its pair of encoders, and its
hyperparameters. A name here builds the network that such a description says.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from torchrl_tit.frames.observation import Observations
from torchrl_tit.networks.history_network import HistoryNetwork, TwoTrunks, arguments_of
from torchrl_tit.settings import Network, networks

__all__ = [
    "D2RL",
    "DTTIT",
    "MLP",
    "Catformer",
    "CoBERL",
    "DecisionTransformer",
    "EnhancedTIT",
    "GTrXL",
    "NatureCNN",
    "OFENet",
    "ResNet",
    "VanillaTIT",
]


class _Named:
    describe: ClassVar[Callable[..., Network]]
    """The function that describes the network."""

    def __init_subclass__(cls, *, describe: Callable[..., Network] | None = None) -> None:
        super().__init_subclass__()
        if describe is not None:
            cls.describe = staticmethod(describe)


class NamedNetwork(_Named, HistoryNetwork):
    """A network that a function of :mod:`torchrl_tit.settings.networks` describes.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images, the spec of an
            observation, or a mapping from names to these.
        num_frames: number K of observations; by default that of the function.
        action_dim: entries of an action, for history encoders that read actions.
        **hyperparameters: further arguments of the function.

    Raises:
        ValueError: if a hyperparameter is invalid; the message names it.
        TypeError: if there is no such hyperparameter.
    """

    def __init__(
        self,
        observation_shape: Observations,
        num_frames: int | None = None,
        *,
        action_dim: int | None = None,
        **hyperparameters: Any,
    ) -> None:
        given = {} if num_frames is None else {"num_frames": num_frames}
        settings = self.describe(**given, **hyperparameters)
        super().__init__(**arguments_of(settings, observation_shape, action_dim))


class VanillaTIT(NamedNetwork, describe=networks.vanilla_tit):
    """Vanilla_TIT: L inner blocks on each observation, then L outer blocks on the history.

    arXiv 2212.14538, section "Vanilla_TIT", figure 1. The weights start as in the authors' code.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        num_frames: number K >= 1 of observations, by default 1.
        **hyperparameters: those of :func:`~torchrl_tit.settings.networks.vanilla_tit`.

    Raises:
        ValueError: if a hyperparameter is invalid; the message names it.
        TypeError: if there is no such hyperparameter.

    Example:
        >>> import torch
        >>> tit = VanillaTIT(observation_shape=(4,), num_frames=8, embed_dim=64, num_heads_outer=4)
        >>> tit(torch.randn(16, 8, 4)).shape
        torch.Size([16, 64])
    """


class EnhancedTIT(NamedNetwork, describe=networks.enhanced_tit):
    """Enhanced_TIT: an outer block beside every inner block, all outer outputs concatenated.

    arXiv 2212.14538, section "Enhanced_TIT", figure 2. The weights start as in the authors' code.
    The paper's ablations are the hyperparameters ``dense``, ``inner`` and ``outer``.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        num_frames: number K >= 1 of observations, by default 1.
        **hyperparameters: those of :func:`~torchrl_tit.settings.networks.enhanced_tit`.

    Raises:
        ValueError: if a hyperparameter is invalid; the message names it.
        TypeError: if there is no such hyperparameter.

    Example:
        >>> import torch
        >>> tit = EnhancedTIT(observation_shape=(84, 84), num_frames=4, patch_size=12, embed_dim=64)
        >>> tit(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 64])
    """


class NatureCNN(NamedNetwork, describe=networks.nature_cnn):
    """NatureCNN: see :func:`~torchrl_tit.settings.networks.nature_cnn`.

    Example:
        >>> import torch
        >>> network = NatureCNN(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """


class ResNet(NamedNetwork, describe=networks.resnet):
    """ResNet: see :func:`~torchrl_tit.settings.networks.resnet`.

    Example:
        >>> import torch
        >>> network = ResNet(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """


class Catformer(NamedNetwork, describe=networks.catformer):
    """Catformer: see :func:`~torchrl_tit.settings.networks.catformer`.

    Example:
        >>> import torch
        >>> network = Catformer(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """


class CoBERL(NamedNetwork, describe=networks.coberl):
    """CoBERL: see :func:`~torchrl_tit.settings.networks.coberl`.

    Its contrastive loss reads :func:`~torchrl_tit.networks.masked_predictions`.

    Example:
        >>> import torch
        >>> network = CoBERL(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """


class GTrXL(NamedNetwork, describe=networks.gtrxl):
    """GTrXL: see :func:`~torchrl_tit.settings.networks.gtrxl`.

    Example:
        >>> import torch
        >>> network = GTrXL(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """


class DecisionTransformer(NamedNetwork, describe=networks.decision_transformer):
    """Decision Transformer: see :func:`~torchrl_tit.settings.networks.decision_transformer`.

    Example:
        >>> import torch
        >>> network = DecisionTransformer(observation_shape=(11,), action_dim=3, num_frames=20)
        >>> history, action, return_to_go = (torch.randn(2, 20, size) for size in (11, 3, 1))
        >>> network(history, action, return_to_go, torch.arange(20).expand(2, 20)).shape
        torch.Size([2, 128])
    """


class DTTIT(NamedNetwork, describe=networks.dt_tit):
    """DT_TIT: see :func:`~torchrl_tit.settings.networks.dt_tit`.

    Example:
        >>> import torch
        >>> network = DTTIT(observation_shape=(11,), action_dim=3, num_frames=20)
        >>> history, action, return_to_go = (torch.randn(2, 20, size) for size in (11, 3, 1))
        >>> network(history, action, return_to_go, torch.arange(20).expand(2, 20)).shape
        torch.Size([2, 128])
    """


class NamedTrunks(_Named, TwoTrunks):
    """Two networks by name, one for the policy and one for values: see :class:`NamedNetwork`."""

    def __init__(
        self, observation_shape: Observations, num_frames: int = 1, **hyperparameters: Any
    ) -> None:
        settings = self.describe(num_frames=num_frames, **hyperparameters)
        arguments = arguments_of(settings, observation_shape)
        super().__init__(HistoryNetwork(**arguments), HistoryNetwork(**arguments))


class MLP(NamedTrunks, describe=networks.mlp):
    """MLP: see :func:`~torchrl_tit.settings.networks.mlp`.

    Example:
        >>> import torch
        >>> policy, value = MLP(observation_shape=(4,), num_frames=8)(torch.randn(16, 8, 4))
        >>> policy.shape, value.shape
        (torch.Size([16, 64]), torch.Size([16, 64]))
    """


class OFENet(NamedTrunks, describe=networks.ofenet):
    """OFENet: see :func:`~torchrl_tit.settings.networks.ofenet`.

    Example:
        >>> import torch
        >>> policy, value = OFENet(observation_shape=(11,))(torch.randn(16, 1, 11))
        >>> policy.shape, value.shape
        (torch.Size([16, 139]), torch.Size([16, 139]))
    """


class D2RL(NamedTrunks, describe=networks.d2rl):
    """D2RL: see :func:`~torchrl_tit.settings.networks.d2rl`.

    Example:
        >>> import torch
        >>> policy, value = D2RL(observation_shape=(11,))(torch.randn(16, 1, 11))
        >>> policy.shape, value.shape
        (torch.Size([16, 75]), torch.Size([16, 75]))
    """

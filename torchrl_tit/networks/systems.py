"""The systems of the paper by name: each is a pair of encoders.

:mod:`torchrl_tit.settings.networks` documents the source and the hyperparameters of each.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, ClassVar

from torchrl_tit import settings
from torchrl_tit.frames.observation import Observations
from torchrl_tit.networks.by_kind import frames_by_kind
from torchrl_tit.networks.history_network import HistoryNetwork, TwoTrunks, build_trunk
from torchrl_tit.settings import networks as systems


class System(HistoryNetwork):
    """A named network, described by a function of :mod:`torchrl_tit.settings.networks`.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images, the spec of an
            observation, or a mapping from names to these.
        num_frames: number K of observations; if not given, the default of the function.
        action_dim: entries of an action, for history encoders that read actions.
        **hyperparameters: further arguments of the function.

    Raises:
        ValueError: if a hyperparameter is invalid; the message names it.
        TypeError: if there is no such hyperparameter.
    """

    system: ClassVar[Callable[..., settings.Network]]
    """The function that describes the network."""

    def __init__(
        self,
        observation_shape: Observations,
        num_frames: int | None = None,
        *,
        action_dim: int | None = None,
        **hyperparameters: Any,
    ) -> None:
        if num_frames is not None:
            hyperparameters["num_frames"] = num_frames
        network = _describe(self, **hyperparameters)
        super().__init__(
            frames_by_kind(network, observation_shape),
            network.history,
            observation_shape=observation_shape,
            num_frames=network.num_frames,
            head=network.head,
            initialization=network.initialization,
            action_dim=action_dim,
        )


def _describe(system: System | TwoTrunkSystem, **hyperparameters: Any) -> settings.Network:
    """Returns the settings of a system; a TypeError names its class, as that of a call does."""
    try:
        return system.system(**hyperparameters)
    except TypeError as error:  # raised by the function that takes the hyperparameters in the end
        message = re.sub(r"^[\w.]+\(\)", f"{type(system).__name__}()", str(error))
        raise TypeError(message) from None


class VanillaTIT(System):
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

    system = staticmethod(systems.vanilla_tit)


class EnhancedTIT(System):
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
        >>> [weights.shape[-1] for weights in tit.attention_maps(torch.rand(2, 4, 84, 84)).inner]
        [50, 50]
    """

    system = staticmethod(systems.enhanced_tit)


class NatureCNN(System):
    """NatureCNN: see :func:`~torchrl_tit.settings.networks.nature_cnn`.

    Example:
        >>> import torch
        >>> network = NatureCNN(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """

    system = staticmethod(systems.nature_cnn)


class ResNet(System):
    """ResNet: see :func:`~torchrl_tit.settings.networks.resnet`.

    Example:
        >>> import torch
        >>> network = ResNet(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """

    system = staticmethod(systems.resnet)


class Catformer(System):
    """Catformer: see :func:`~torchrl_tit.settings.networks.catformer`.

    Example:
        >>> import torch
        >>> network = Catformer(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """

    system = staticmethod(systems.catformer)


class CoBERL(System):
    """CoBERL: see :func:`~torchrl_tit.settings.networks.coberl`.

    Its contrastive loss reads :func:`~torchrl_tit.networks.masked_predictions`.

    Example:
        >>> import torch
        >>> network = CoBERL(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """

    system = staticmethod(systems.coberl)


class GTrXL(System):
    """GTrXL: see :func:`~torchrl_tit.settings.networks.gtrxl`.

    Example:
        >>> import torch
        >>> network = GTrXL(observation_shape=(84, 84), num_frames=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """

    system = staticmethod(systems.gtrxl)


class DecisionTransformer(System):
    """Decision Transformer: see :func:`~torchrl_tit.settings.networks.decision_transformer`.

    Example:
        >>> import torch
        >>> network = DecisionTransformer(observation_shape=(11,), action_dim=3, num_frames=20)
        >>> history, action, return_to_go = (torch.randn(2, 20, size) for size in (11, 3, 1))
        >>> network(history, action, return_to_go, torch.arange(20).expand(2, 20)).shape
        torch.Size([2, 128])
    """

    system = staticmethod(systems.decision_transformer)

    def __init__(
        self,
        observation_shape: Observations,
        action_dim: int,
        num_frames: int | None = None,
        **hyperparameters: Any,
    ) -> None:
        super().__init__(observation_shape, num_frames, action_dim=action_dim, **hyperparameters)


class DTTIT(DecisionTransformer):
    """DT_TIT: see :func:`~torchrl_tit.settings.networks.dt_tit`.

    Example:
        >>> import torch
        >>> network = DTTIT(observation_shape=(11,), action_dim=3, num_frames=20)
        >>> history, action, return_to_go = (torch.randn(2, 20, size) for size in (11, 3, 1))
        >>> network(history, action, return_to_go, torch.arange(20).expand(2, 20)).shape
        torch.Size([2, 128])
    """

    system = staticmethod(systems.dt_tit)


class TwoTrunkSystem(TwoTrunks):
    """Two networks by name, one for the policy and one for values: see :class:`System`."""

    system: ClassVar[Callable[..., settings.Network]]

    def __init__(
        self, observation_shape: Observations, num_frames: int = 1, **hyperparameters: Any
    ) -> None:
        network = _describe(self, num_frames=num_frames, **hyperparameters)
        super().__init__(*(build_trunk(network, observation_shape) for _ in range(2)))


class MLP(TwoTrunkSystem):
    """MLP: see :func:`~torchrl_tit.settings.networks.mlp`.

    Example:
        >>> import torch
        >>> policy, value = MLP(observation_shape=(4,), num_frames=8)(torch.randn(16, 8, 4))
        >>> policy.shape, value.shape
        (torch.Size([16, 64]), torch.Size([16, 64]))
    """

    system = staticmethod(systems.mlp)


class OFENet(TwoTrunkSystem):
    """OFENet: see :func:`~torchrl_tit.settings.networks.ofenet`.

    Example:
        >>> import torch
        >>> policy, value = OFENet(observation_shape=(11,))(torch.randn(16, 1, 11))
        >>> policy.shape, value.shape
        (torch.Size([16, 139]), torch.Size([16, 139]))
    """

    system = staticmethod(systems.ofenet)


class D2RL(TwoTrunkSystem):
    """D2RL: see :func:`~torchrl_tit.settings.networks.d2rl`.

    Example:
        >>> import torch
        >>> policy, value = D2RL(observation_shape=(11,))(torch.randn(16, 1, 11))
        >>> policy.shape, value.shape
        (torch.Size([16, 75]), torch.Size([16, 75]))
    """

    system = staticmethod(systems.d2rl)

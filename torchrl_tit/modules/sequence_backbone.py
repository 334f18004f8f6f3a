"""Decision Transformer as TensorDictModules: its features, and the heads that act on them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_tit.modules.frame_cache import FrameCache
from torchrl_tit.networks import DecisionTransformer

ENTRIES = ("observation", "action", "return_to_go", "timestep", "mask")
"""What a sequence holds, in a batch of :class:`~torchrl_tit.datasets.SequenceStorage` and in
:class:`~torchrl_tit.transforms.SequenceHistory`."""


class SequenceBackbone(TensorDictModuleBase):
    """Reads returns-to-go, observations and actions of K steps, and writes features.

    Decision Transformer as a TensorDictModule, for the heads after it. For training it writes the
    features of every step, for acting (``newest``) those of the last step only, which is cheaper.

    Within :meth:`acting` the tokens of the observations that it saw a step ago are kept, so that
    each observation is encoded once. The rest is computed anew: once a window is full, the step
    that leaves it was seen by all others.

    Args:
        network: the network; two backbones, to train and to act, can share it.
        group: the key that the sequence stands under; the tensordict itself where None.
        newest: whether only the last step's features are written.
        out_key: where the features go.

    Raises:
        TypeError: in ``forward``, if discrete actions are given to a network with continuous
            actions, or the other way round.
        KeyError: in ``forward``, if an entry is missing.

    Source: "Decision Transformer" (arXiv 2106.01345), section 3.

    Example:
        >>> from tensordict import TensorDict
        >>> network = DecisionTransformer((11,), 3)
        >>> batch = TensorDict(
        ...     {
        ...         "observation": torch.randn(8, 20, 11),
        ...         "action": torch.randn(8, 20, 3),
        ...         "return_to_go": torch.ones(8, 20, 1),
        ...         "timestep": torch.arange(20).expand(8, 20),
        ...         "mask": torch.ones(8, 20, dtype=torch.bool),
        ...     },
        ...     [8],
        ... )
        >>> SequenceBackbone(network)(batch)["features"].shape
        torch.Size([8, 20, 128])
        >>> SequenceBackbone(network, newest=True)(batch)["features"].shape
        torch.Size([8, 128])
    """

    def __init__(
        self,
        network: DecisionTransformer,
        *,
        group: NestedKey | None = None,
        newest: bool = False,
        out_key: NestedKey = "features",
    ) -> None:
        super().__init__()
        self.network = network
        self.newest = newest
        self.in_keys = [name if group is None else unravel_key((group, name)) for name in ENTRIES]
        self.out_keys = [out_key]
        self._cache: FrameCache | None = None  # while acting

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the features, float [..., K, D] or [..., D] of the newest step, and returns it."""
        entries = [tensordict.get(key, None) for key in self.in_keys]
        if any(entry is None for entry in entries):
            raise KeyError(
                f"there is no sequence under {self.in_keys}, only "
                f"{sorted(map(str, tensordict.keys(True, True)))}: draw it from a SequenceStorage, "
                "or add SequenceHistory to the environment"
            )
        states, actions, returns_to_go, timesteps, mask = entries
        features = self.network.encode(
            self._encode_states(states),
            as_vectors(actions, self.network, timesteps.ndim),
            returns_to_go,
            timesteps,
            mask,
            newest=self.newest,
        )
        return tensordict.set(self.out_keys[0], features.squeeze(-2) if self.newest else features)

    @contextmanager
    def acting(self) -> Iterator[None]:
        """Keeps the tokens of the observations just seen, to encode only the newest of each step.

        As :meth:`torchrl_tit.modules.Backbone.acting`; :func:`~torchrl_tit.modules.acting` enters
        it for a whole policy.
        """
        encoder, ndim = self.network.state_encoder, len(self.network.observation_shape)
        outer, self._cache = self._cache, FrameCache(encoder, ndim)
        try:
            yield
        finally:
            self._cache = outer

    def clear_cache(self) -> None:
        """Forgets what was kept while acting."""
        if self._cache is not None:
            self._cache.clear()

    def state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """As of any module. Forgets what was kept while acting, which is no part of it."""
        self.clear_cache()
        return super().state_dict(*args, **kwargs)

    def _encode_states(self, states: Tensor) -> Tensor:
        """[..., K, *observation_shape] -> tokens [..., K, D]."""
        if self._cache is None or torch.compiler.is_compiling():
            return self.network.encode_states(states)
        self.network.check_states(states)
        return self._cache(states).squeeze(-2)


def as_vectors(actions: Tensor, network: DecisionTransformer, steps_ndim: int) -> Tensor:
    """Turns actions into what the network reads: discrete ones into one-hot vectors.

    Args:
        actions: float [..., K, A] if they are continuous; if they are discrete integers [..., K],
            negative at padding, or one-hot [..., K, A].
        network: the network that is to read them.
        steps_ndim: number of axes of [..., K].

    Returns:
        float [..., K, A].

    Raises:
        TypeError: if discrete actions are given to a network with continuous actions, or the other
            way round.

    Example:
        >>> network = DecisionTransformer((4,), 2, action_space="discrete")
        >>> as_vectors(torch.tensor([-10, 0, 1]), network, steps_ndim=1).tolist()
        [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    """
    discrete = not actions.is_floating_point()
    if discrete != (network.config.action_space == "discrete"):
        given = "discrete" if discrete else "continuous"
        raise TypeError(
            f"actions of {actions.dtype} are {given}, but this network's are "
            f"{network.config.action_space}: set action_space={given!r}, or take other data"
        )
    if actions.ndim == steps_ndim:
        classes = torch.arange(network.action_dim, device=actions.device)
        actions = actions.unsqueeze(-1) == classes  # zeros at padding, which is negative
    return actions.to(network.norm.weight.dtype)

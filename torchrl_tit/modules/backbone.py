"""The backbone: a network of this library as a TensorDictModule."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, skip_existing
from torch import Tensor, nn

from torchrl_tit.modules.frame_cache import Encode, FrameCache
from torchrl_tit.networks import HistoryNetwork


class Backbone(TensorDictModule):
    """Reads a history and writes features, for any TorchRL head, loss or collector.

    Put it in front of the heads, once: heads read the features, so the network runs once a step
    while collecting and once a minibatch in the update, however many heads and losses there are.

    While acting, each step's history holds K - 1 frames of the step before. Within :meth:`acting`
    only the newest is encoded, where the network has a frame encoder; the features are the same.

    Args:
        network: maps a history [..., K, *observation_shape] to features [..., F], or to as many
            tensors as there are ``out_keys`` (policy and value features, say).
        in_keys: a list with one key, nested or not, under which the history stands (see
            :class:`~torchrl_tit.transforms.History`), or its name.
        out_keys: a list with one key for each tensor that the network puts out, or a single name.
        autocast: the type that matrix products are computed in, such as ``torch.bfloat16``; weights
            and features keep theirs. None computes all in the type of the weights.

    Raises:
        ValueError: if there is not exactly one ``in_key``, or no ``out_key``.
        KeyError: in ``forward``, if there is no history under the key.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_tit import Backbone, EnhancedTIT
        >>> tit = EnhancedTIT(observation_shape=(4,), history=8, features_dim=32)
        >>> backbone = Backbone(tit, in_keys=["history"], out_keys=["features"])
        >>> backbone(TensorDict({"history": torch.randn(5, 8, 4)}, [5]))["features"].shape
        torch.Size([5, 32])
    """

    def __init__(
        self,
        network: nn.Module,
        in_keys: Sequence[NestedKey] | str = ("history",),
        out_keys: Sequence[NestedKey] | str = ("features",),
        autocast: torch.dtype | None = None,
    ) -> None:
        in_keys, out_keys = (
            [keys] if isinstance(keys, str) else list(keys) for keys in (in_keys, out_keys)
        )
        if len(in_keys) != 1 or not out_keys:
            raise ValueError(
                "a backbone reads one history and writes at least one entry of features, not "
                f"in_keys={in_keys} and out_keys={out_keys}"
            )
        super().__init__(network, in_keys=in_keys, out_keys=out_keys)
        self.autocast = autocast
        self._cache: FrameCache | None = None  # while acting
        # What runs while acting in place of frame encoder and history encoder, if compiled.
        self._compiled: tuple[Encode, Encode] | None = None

    def forward(
        self, tensordict: TensorDictBase, *args: object, **kwargs: object
    ) -> TensorDictBase:
        """Writes the features of the history into the tensordict and returns it."""
        (key,) = self.in_keys
        if isinstance(tensordict, TensorDictBase) and tensordict.get(key, None) is None:
            raise KeyError(
                f"there is no history under {key!r}, only {sorted(map(str, tensordict.keys(True)))}"
                ": add torchrl_tit.History to the environment, or name the key in in_keys"
            )
        special = args or kwargs or skip_existing() or not isinstance(tensordict, TensorDictBase)
        if self._cache is None or special or torch.compiler.is_compiling():
            return super().forward(tensordict, *args, **kwargs)
        # The same without the 0.1 ms that TensorDictModule takes, which count in a step of acting.
        (out_key,) = self.out_keys_source
        return tensordict.set(out_key, self._call_module([tensordict.get(key)]))

    @contextmanager
    def acting(self) -> Iterator[None]:
        """Keeps the tokens of the frames just seen, to encode only the newest of each step.

        For collection and evaluation (see :func:`~torchrl_tit.modules.acting`), not for losses.
        Whatever it is given, the features are those of the network (see
        :class:`~torchrl_tit.modules.FrameCache`): another batch, a reset or changed weights cost
        time only. Does nothing for networks that have no frame encoder or see one frame.

        What is kept (copies of one batch of histories, of its tokens, and of the frame encoder's
        weights) goes at the end, and when a state dict is taken: a run then goes on as one that is
        resumed from there does. Within another ``acting``, it starts with nothing, and the outer
        one goes on with what it kept. A copy made within, a collector's in another process say,
        acts for good, and starts with nothing.

        Example:
            >>> from tensordict import TensorDict
            >>> from torchrl_tit import EnhancedTIT
            >>> backbone = Backbone(EnhancedTIT(observation_shape=(4,), history=8))
            >>> frames = torch.randn(5, 20, 4)
            >>> with backbone.acting(), torch.no_grad():
            ...     for step in range(12):
            ...         td = backbone(TensorDict({"history": frames[:, step : step + 8]}, [5]))
        """
        outer, self._cache = self._cache, self._make_cache()
        try:
            yield
        finally:
            self._cache = outer

    def compile_parts(self, **options: Any) -> None:
        """Compiles what runs while acting: encoding the newest frames, and all that follows it.

        What is kept and compared is decided between the two, so compile no policy around them: a
        compiled one keeps nothing. Copies of the backbone are not compiled.

        Args:
            **options: of ``torch.compile``.
        """
        network = self.module
        if self.keeps_frames:
            self._compiled = (
                torch.compile(network.frame_encoder, **options),
                torch.compile(network.encode_history, **options),
            )

    def clear_cache(self) -> None:
        """Forgets what was kept while acting."""
        if self._cache is not None:
            self._cache.clear()

    def state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """As of any module. Forgets what was kept while acting, which is no part of it."""
        self.clear_cache()
        return super().state_dict(*args, **kwargs)

    @property
    def keeps_frames(self) -> bool:
        """Whether acting mode spares anything: there are a frame encoder and earlier frames."""
        network = self.module
        return (
            isinstance(network, HistoryNetwork)
            and network.frame_encoder is not None
            and network.history > 1
        )

    def _make_cache(self) -> FrameCache | None:
        network = self.module
        if not self.keeps_frames:
            return None
        encode_newest = self._compiled[0] if self._compiled else None
        return FrameCache(network.frame_encoder, len(network.observation_shape), encode_newest)

    def _call_module(self, tensors: Sequence[Tensor], **kwargs: Any) -> Any:
        """Where TensorDictModule calls the network."""
        if self.autocast is None:
            return self._encode(tensors, **kwargs)
        with self.computing(tensors[0].device):
            features = self._encode(tensors, **kwargs)
        # Heads and losses need all digits.
        if isinstance(features, Tensor):
            return features.float()
        return tuple(feature.float() for feature in features)

    def computing(self, device: torch.device) -> AbstractContextManager[object]:
        """The context in which matrix products are computed in the type of ``autocast``."""
        if self.autocast is None:
            return nullcontext()
        return torch.autocast(device.type, self.autocast)

    def _encode(self, tensors: Sequence[Tensor], **kwargs: Any) -> Any:
        if torch.compiler.is_compiling() or self._cache is None:
            return super()._call_module(tensors, **kwargs)
        (history,) = tensors
        self.module.check(history)
        encode_history = self._compiled[1] if self._compiled else self.module.encode_history
        return encode_history(self._cache(history))

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_compiled": None}  # they are the original's

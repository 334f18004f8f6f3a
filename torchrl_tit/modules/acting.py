"""Acting mode, in which only the newest frames are encoded, and a collector that uses it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector

from torchrl_tit.modules.frame_cache import ActingNetwork
from torchrl_tit.modules.tensor_module import TensorModule
from torchrl_tit.networks import HistoryNetwork, TwoTrunks


class ActingModule(TensorModule):
    """A network as a TensorDictModule that keeps, while it acts, the tokens of the last frames.

    :class:`Backbone` adds to it how tensordicts are read.
    """

    _acting: list[ActingNetwork] | None = None  # one per trunk, in acting mode
    _compiled: list[ActingNetwork] | None = None  # what acting mode runs, if compiled

    @property
    def keeps_frames(self) -> bool:
        """Whether acting mode saves work: frames are encoded, and histories have several."""
        return any(trunk.keeps_frames for trunk in trunks_of(self.module).values())

    @contextmanager
    def acting(self) -> Iterator[None]:
        """Keeps the tokens of the last frames, so that only the newest is encoded at each step.

        For collection and evaluation (see :func:`~torchrl_tit.modules.acting`), not for losses. Any
        histories are allowed: after a reset, or with another batch, all new frames are encoded (see
        :class:`~torchrl_tit.modules.FrameCache`). Has no effect while gradients are enabled, or on
        networks that encode no frames or read a single one.

        **Weights that change within the context** are noticed if PyTorch counts the write: when a
        state dict is loaded into any module, within ``to_module``, and after most optimizers' step.
        Nothing shows that a fused optimizer stepped, or that weights were written through ``.data``
        or shared memory: call :meth:`mark_weight_update` afterwards; otherwise, for the next K - 1
        steps, frames seen before the change keep the tokens of the old weights. There is no need
        for it between two collections, each of which enters a new context, as those of
        :class:`~torchrl_tit.modules.ActingCollector` do.

        The cache (copies of one batch of histories and of its tokens) starts empty. It is discarded
        at the end, when weights change, and whenever the backbone or a module that contains it is
        moved or cast, or its state dict is taken. So a run continues exactly like one that is
        resumed from its state dict. Copies and pickles are not in acting mode.

        Example:
            >>> from tensordict import TensorDict
            >>> from torchrl_tit import Backbone, EnhancedTIT
            >>> backbone = Backbone(EnhancedTIT(observation_shape=(4,), num_frames=8))
            >>> frames = torch.randn(5, 20, 4)
            >>> with backbone.acting(), torch.no_grad():
            ...     for step in range(12):
            ...         td = backbone(TensorDict({"history": frames[:, step : step + 8]}, [5]))
        """
        outer = self._acting
        if self.keeps_frames:
            trunks = trunks_of(self.module).values()
            self._acting = self._compiled or list(map(ActingNetwork, trunks))
        self.reset_cache()
        try:
            yield
        finally:
            self.reset_cache()
            self._acting = outer

    def compile_parts(self, **options: Any) -> None:
        """Compiles what acting mode runs: the encoding of the newest frames, and all later layers.

        Between the two, plain Python decides which tokens can be reused. Do not compile the whole
        policy instead: a compiled backbone keeps no tokens. Copies of the backbone are not
        compiled.

        Args:
            **options: passed to ``torch.compile``.
        """
        if self.keeps_frames:
            self._compiled = list(map(ActingNetwork, trunks_of(self.module).values()))
            for network in self._compiled:
                network.compile(**options)

    def reset_cache(self) -> None:
        """Discards the tokens that acting mode keeps."""
        for network in self._acting or ():
            network.clear()

    def mark_weight_update(self) -> None:
        """Discards them because the weights have changed; the names are TorchRL's from 0.15 on."""
        self.reset_cache()

    def state_dict(self, *args: Any, **kwargs: Any) -> Any:
        """Returns the network's state dict, and discards the tokens that acting mode keeps."""
        self.reset_cache()
        return super().state_dict(*args, **kwargs)

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        self.reset_cache()  # moved or cast
        return super()._apply(*args, **kwargs)

    def _call_network(self, inputs: Sequence[Tensor]) -> Any:
        """Calls the network; in acting mode, it encodes the newest frames only."""
        if torch.compiler.is_compiling() or self._acting is None:
            return self.module(*inputs)
        return self._call_trunks(inputs, self._acting)

    def _call_trunks(self, inputs: Sequence[Tensor], compute: Sequence[Callable[..., Any]]) -> Any:
        """Calls the network, each of whose trunks computes its output in another way."""
        if len(compute) == 1:
            return self.module(*inputs, compute=compute[0])
        return self.module(*inputs, compute=compute)

    def __getstate__(self) -> dict[str, Any]:
        # Compiled code cannot be copied, and nothing would clear a copy's cache.
        return {**super().__getstate__(), "_compiled": None, "_acting": None}


def trunks_of(network: nn.Module) -> dict[str, HistoryNetwork]:
    """Returns the trunks of a network by the key prefix of their state; empty for other modules.

    Example:
        >>> from torchrl_tit.networks import MLP
        >>> list(trunks_of(MLP((4,))))
        ['policy_', 'value_']
    """
    if isinstance(network, TwoTrunks):
        return {"policy_": network.policy, "value_": network.value}
    return {"": network} if isinstance(network, HistoryNetwork) else {}


def modules_in_order(policy: nn.Module) -> Iterator[TensorDictModuleBase]:
    """Yields the modules of a policy in the order in which it calls them.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> double = TensorDictModule(lambda x: 2 * x, in_keys=["x"], out_keys=["x"])
        >>> nested = TensorDictSequential(double, TensorDictSequential(double, double))
        >>> len(list(modules_in_order(nested)))
        3
    """
    if isinstance(policy, TensorDictSequential):
        for module in policy.module:
            yield from modules_in_order(module)
    else:
        assert isinstance(policy, TensorDictModuleBase)
        yield policy


@contextmanager
def acting(policy: Callable[..., Any]) -> Iterator[None]:
    """Puts every backbone of a policy into acting mode: only the newest frames are encoded.

    Enters the context ``acting()`` of each module that has one.

    Args:
        policy: a module that contains any number of backbones (see :meth:`Backbone.acting`, also
            for weights that change within the context). Other functions are left unchanged.

    Example:
        >>> from tensordict.nn import TensorDictSequential
        >>> from torchrl.data import Categorical
        >>> from torchrl_tit import Backbone, EnhancedTIT
        >>> from torchrl_tit.envs import make_env
        >>> from torchrl_tit.modules import make_actor
        >>> backbone = Backbone(EnhancedTIT(observation_shape=(4,), num_frames=8))
        >>> policy = TensorDictSequential(backbone, make_actor(64, Categorical(2)))
        >>> with acting(policy):
        ...     steps = make_env("CartPole-v1", 2, num_frames=8).rollout(10, policy)
    """
    with ExitStack() as stack:
        for act in _methods(policy, "acting"):
            stack.enter_context(act())
        yield


def _methods(policy: Callable[..., Any], name: str) -> list[Callable[[], Any]]:
    modules = policy.modules() if isinstance(policy, nn.Module) else ()
    return [getattr(module, name) for module in modules if hasattr(module, name)]


class ActingCollector(Collector):
    """TorchRL's collector, with its policy in acting mode while it collects a batch.

    Between two batches, when the policy is trained and saved, no tokens are kept. New weights apply
    to all frames: each batch starts with an empty cache, and :meth:`update_policy_weights_` clears
    it during a batch. The worker of a ``MultiAsyncCollector`` shares its weights' memory, so a few
    of its steps can read new weights with older tokens before it is told.

    The arguments are those of ``torchrl.collectors.Collector``. Collectors of several processes
    take it as their ``collector_class``.

    Example:
        >>> from functools import partial
        >>> from torchrl.collectors import MultiSyncCollector
        >>> from torchrl.modules import RandomPolicy
        >>> from torchrl_tit.envs import make_env
        >>> env = partial(make_env, "CartPole-v1", 2, num_frames=8)
        >>> collector = ActingCollector(env, None, frames_per_batch=16, total_frames=64)
        >>> len([batch.shape for batch in collector])
        4
        >>> collector.shutdown()
        >>> in_processes = partial(MultiSyncCollector, [env], collector_class=ActingCollector)
    """

    def __bool__(self) -> bool:
        """Returns True. Ray asks for it when a method fails.

        TorchRL's collectors have no length and would raise, which would hide the original error.
        """
        return True

    def rollout(self) -> TensorDictBase:
        """Collects a batch."""
        with acting(self.policy):
            return super().rollout()

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Updates the policy's weights; in a worker process, called in another thread."""
        super().update_policy_weights_(*args, **kwargs)
        for mark in _methods(self.policy, "mark_weight_update"):
            mark()

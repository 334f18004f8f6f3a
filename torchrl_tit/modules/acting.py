"""Acting mode of whole policies, and a collector that uses it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any, Protocol, TypeVar, runtime_checkable

from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import Collector

T = TypeVar("T")


@runtime_checkable
class HasActingMode(Protocol):
    """A module that can reuse what it computed a step ago, such as a backbone."""

    def acting(self) -> AbstractContextManager[None]:
        """Returns the context in which it does so."""

    def clear_cache(self) -> None:
        """Discards what it has kept."""


@contextmanager
def acting(policy: Callable[..., Any]) -> Iterator[None]:
    """Puts every backbone of a policy into acting mode: only the newest frames are encoded.

    Args:
        policy: a module that contains any number of backbones, or of other modules with a method
            ``acting`` (see :meth:`Backbone.acting`, also for weights that change within the
            context). Other functions are left unchanged.

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
        for module in _within(policy):
            stack.enter_context(module.acting())
        yield


def clear_caches(policy: Callable[..., Any]) -> None:
    """Clears the caches of a policy's backbones, after its weights change within ``acting``.

    Args:
        policy: see :func:`acting`.
    """
    for module in _within(policy):
        module.clear_cache()


def _within(policy: Callable[..., Any]) -> list[HasActingMode]:
    modules = policy.modules() if isinstance(policy, nn.Module) else ()
    return [module for module in modules if isinstance(module, HasActingMode)]


def while_acting(policy: Callable[..., Any], batches: Iterable[T]) -> Iterator[T]:
    """Iterates over a collector, with its policy in acting mode only while it collects.

    Between two batches, when the policy is trained and saved, no tokens are kept. This does not
    reach policies in other processes: for those, pass ``collector_class=ActingCollector`` to the
    collector.

    Args:
        policy: the collector's policy, or a module that contains its backbones.
        batches: the collector, or any other iterable that acts when its next item is requested.

    Yields:
        The batches.

    Example:
        >>> from torchrl.collectors import Collector
        >>> from torchrl.modules import RandomPolicy
        >>> from torchrl_tit.envs import make_env
        >>> env = make_env("CartPole-v1", 2)
        >>> policy = RandomPolicy(env.action_spec)
        >>> collector = Collector(env, policy, frames_per_batch=16, total_frames=64)
        >>> len([batch.shape for batch in while_acting(policy, collector)])
        4
        >>> collector.shutdown()
    """
    iterator = iter(batches)
    while True:
        with acting(policy):
            try:
                batch = next(iterator)
            except StopIteration:
                return
        yield batch


class ActingCollector(Collector):
    """TorchRL's collector, with its policy in acting mode while it collects a batch.

    For collectors in other processes, whose policies :func:`~torchrl_tit.modules.while_acting` does
    not reach. New weights apply to all frames: each batch starts with an empty cache, and weights
    that arrive during a batch, in a ``MultiAsyncCollector`` for example, clear it.

    The arguments are those of ``torchrl.collectors.Collector``.

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
        clear_caches(self.policy)

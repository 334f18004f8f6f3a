"""Acting mode of whole policies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

from torch import nn

from torchrl_tit.modules.backbone import Backbone
from torchrl_tit.modules.sequence_backbone import SequenceBackbone

T = TypeVar("T")


@contextmanager
def acting(policy: Callable[..., Any]) -> Iterator[None]:
    """Puts every backbone of a policy into acting mode: only the newest frames are encoded.

    Args:
        policy: a module with any number of backbones in it; other functions are left as they are.

    Example:
        >>> from tensordict.nn import TensorDictSequential
        >>> from torchrl.data import Categorical
        >>> from torchrl_tit import EnhancedTIT
        >>> from torchrl_tit.envs import make_env
        >>> from torchrl_tit.modules import make_actor
        >>> backbone = Backbone(EnhancedTIT(observation_shape=(4,), history=8))
        >>> policy = TensorDictSequential(backbone, make_actor(64, Categorical(2)))
        >>> with acting(policy):
        ...     steps = make_env("CartPole-v1", 2, history=8).rollout(10, policy)
    """
    with ExitStack() as stack:
        for module in policy.modules() if isinstance(policy, nn.Module) else ():
            if isinstance(module, Backbone | SequenceBackbone):
                stack.enter_context(module.acting())
        yield


def while_acting(policy: Callable[..., Any], batches: Iterable[T]) -> Iterator[T]:
    """Iterates over a collector with its policy in acting mode only while a batch is made.

    Between two batches, where the policy is trained and saved, nothing is kept.

    Args:
        policy: the collector's policy, or a module that holds its backbones.
        batches: the collector, or anything else that acts when it is asked for its next item.

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

"""A collector whose policy is in acting mode while it collects."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.collectors import Collector

from torchrl_tit.modules.acting import acting, clear_caches


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

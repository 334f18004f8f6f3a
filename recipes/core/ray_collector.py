"""Collectors on the machines of a Ray cluster."""

from __future__ import annotations

import copy
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase

from .ray_cluster import check_room, connect, import_variables

_RESUME = "A resumed run goes on from its last checkpoint, with new collectors"


class ClusterCollector(RayCollector):
    """TorchRL's Ray collector, for one run's environments: batches [envs, time] in a fixed order.

    Each collector is an actor on a machine of the cluster, with its share of the environments and a
    copy of the policy, on CPUs. All collect at the same time, with the weights that this process
    sent last. Weights are sent by TorchRL's scheme for Ray. It does not support actors that Ray
    restarts, so if one dies, with its process or its machine, the iteration raises an error.

    Args:
        make_shares: builds the environments of each collector, in that collector's process.
        policy: the policy, whose weights :meth:`update_policy_weights_` sends.
        address: the cluster's address.
        threads: CPUs that each collector takes.
        collector_class: class of the collector in each actor.
        settings: settings of each of these collectors.
        device: device of the batches that this collector yields.
        **kwargs: further arguments of ``RayCollector``.

    Raises:
        ValueError: if Ray is missing, no cluster answers, or it has too few CPUs.
    """

    def __init__(
        self,
        make_shares: Sequence[Callable[[], EnvBase]],
        policy: TensorDictModuleBase,
        *,
        address: str,
        threads: int,
        collector_class: type[Collector],
        settings: dict[str, Any],
        device: torch.device,
        **kwargs: Any,
    ) -> None:
        connect(address)
        import ray

        machines = [node for node in ray.nodes() if node["Alive"]]
        check_room([node["Resources"] for node in machines], address, len(make_shares), threads)
        _check_own_name({node["NodeManagerAddress"] for node in machines})
        self._trained = policy
        self._batch_device = device
        with _one_line():
            super().__init__(
                list(make_shares),
                copy.deepcopy(policy).to("cpu"),
                sync=True,
                device=torch.device("cpu"),
                collector_class=collector_class,
                collector_kwargs=[dict(settings) for _ in make_shares],
                remote_configs={
                    "num_cpus": threads,
                    "num_gpus": 0,
                    "scheduling_strategy": "SPREAD",
                    "runtime_env": {"env_vars": import_variables()},
                },
                **kwargs,
            )

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yields batches [envs, time], those of the first collector's environments first."""
        self.update_policy_weights_()  # a checkpoint may have been loaded since the copy
        with _one_line():
            for batch in super().iterator():
                yield batch.flatten(0, 1).to(self._batch_device)

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Sends the policy's weights to all collectors."""
        with _one_line():
            super().update_policy_weights_(*(args or (self._trained,)), **kwargs)


def _check_own_name(addresses: set[str]) -> None:
    """Checks that collectors on other machines can reach this process by its name."""
    name = socket.gethostname()
    try:
        own = socket.gethostbyname(name)
    except OSError:
        own = "127.0.0.1"  # which TorchRL uses, too
    if own.startswith("127.") and len(addresses) > 1:
        raise ValueError(
            f"this machine's name {name} stands for {own}, where collectors on other machines "
            "cannot reach it to get weights: give the name the machine's own address in /etc/hosts"
        )


@contextmanager
def _one_line() -> Iterator[None]:
    """Raises errors that say in one line what happened to a collector.

    Raises:
        RuntimeError: if one died or failed.
    """
    from ray.exceptions import RayActorError, RayError, RayTaskError

    try:
        yield
    except RayTaskError as error:
        cause = error.cause
        reason = f"{type(cause).__name__}: {cause}".splitlines()[0]
        raise RuntimeError(f"a collector on Ray failed: {reason}") from error
    except RayActorError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        if "creation task" in lines[0]:  # whose traceback follows
            raise RuntimeError(f"a collector on Ray failed: {lines[-1]}") from error
        raise RuntimeError(f"a collector on Ray died: {lines[0]} {_RESUME}") from error
    except RayError as error:
        raise RuntimeError(f"Ray failed: {str(error).splitlines()[0]}") from error
    except RuntimeError as error:
        if "gloo" not in str(error):  # which sends the weights
            raise
        raise RuntimeError(
            f"a collector on Ray died: its connection for weights broke. {_RESUME}"
        ) from error

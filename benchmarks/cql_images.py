"""An update of CQL_TIT on images: frames shared by s and s', compared with encoding each window.

Actor and both critics read the last four 84 x 84 images with an Enhanced_TIT each (patch 12, width
64, 2 blocks); 10 action samples, so 31 actions in each state; 64 transitions. The same program runs
at the present commit and at the last one that encoded every window, eager and with its policy
compiled; the present one also on slices of eight consecutive transitions.
"""

from __future__ import annotations

import os
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

from .earlier import CLONE, COMMIT, Worker, earlier_tree
from .report import publish, spread, table

ROUNDS, SECONDS = 12, 1.0

PROGRAM = """
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictSequential
from torchrl.data import Bounded
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SoftUpdate
from torchrl_tit import Backbone, EnhancedTIT
from torchrl_tit.modules import make_squashed_actor
from torchrl_tit.objectives import ContinuousCQLLoss

compiled, length = {compiled}, {length}
torch.set_num_threads(1)
torch.manual_seed(0)
states, frames, actions, samples = 64, 4, 3, 10


def make_backbone(key):
    tit = EnhancedTIT((84, 84), frames, patch_size=12, embed_dim=64)
    # In slices, a frame is encoded once for all steps that read it.
    options = dict(observation_keys="observation") if length > 1 else dict()
    return Backbone(tit, ["history"], [key], **options), tit.features_dim


def make_critic():
    backbone, size = make_backbone("critic_features")
    relu = dict(activation_class=torch.nn.ReLU, activation_kwargs=dict(inplace=True))
    mlp = MLP(size + actions, 1, num_cells=[256] * 3, **relu)
    keys = ["critic_features", "action"]
    return TensorDictSequential(backbone, ValueOperator(mlp, in_keys=keys))


def make_batch():
    images = torch.randint(0, 256, (states // length, frames + length, 84, 84), dtype=torch.uint8)
    windows = images.unfold(1, frames, 1).movedim(-1, 2)
    here, there = windows[:, :-1].contiguous(), windows[:, 1:].contiguous()
    flag = torch.zeros(*here.shape[:2], 1, dtype=torch.bool)
    batch = TensorDict(
        dict(
            history=here,
            observation=here[:, :, -1],
            action=torch.rand(*here.shape[:2], actions) * 2 - 1,
            is_init=flag,
            next=dict(
                history=there,
                observation=there[:, :, -1],
                reward=flag.float(),
                terminated=flag,
                done=flag,
                is_init=flag,
            ),
        ),
        here.shape[:2],
    )
    return batch if length > 1 else batch.exclude("is_init", ("next", "is_init")).reshape(-1)


def optimizer_of(params):
    weights = [p for p in params.values(True, True) if isinstance(p, torch.nn.Parameter)]
    return torch.optim.Adam(weights, fused=True)


def descend(value, optimizer):
    optimizer.zero_grad()
    value.backward()
    optimizer.step()


spec = Bounded(-torch.ones(actions), torch.ones(actions))
backbone, size = make_backbone("features")
actor = ProbabilisticTensorDictSequential(backbone, *make_squashed_actor(size, spec))
loss = ContinuousCQLLoss(
    actor,
    [make_critic(), make_critic()],
    action_spec=spec,
    min_q_weight=5.0,
    num_random=samples,
    deactivate_vmap=True,
)
loss.make_value_estimator(gamma=0.99)
temperature = torch.optim.Adam([loss.log_alpha], fused=True)
critics = optimizer_of(loss.qvalue_network_params)
policy = optimizer_of(loss.actor_network_params)
target = SoftUpdate(loss, tau=0.005)
sample_policy = loss.sample_policy
if compiled:
    sample_policy = torch.compile(sample_policy, dynamic=False)
batch = make_batch()


def update():
    drawn = sample_policy(batch)
    descend(loss.alpha_loss(drawn), temperature)
    critics.zero_grad()
    loss.critic_gradients(batch, drawn, states)
    critics.step()
    descend(loss.actor_loss(batch, drawn)[0], policy)
    target.step()
"""

CASES = {  # compiled, slice length, and the earlier commit's case that it is compared with
    "eager": (False, 1, "earlier, eager"),
    "policy compiled": (True, 1, "earlier, policy compiled"),
    "eager, slices of 8": (False, 8, "earlier, eager"),
}
EARLIER = {"earlier, eager": False, "earlier, policy compiled": True}


def measure(rounds: int, seconds: float) -> dict[str, list[float]]:
    """Returns milliseconds of an update in each round, alternating."""
    with ExitStack() as stack:
        tree = stack.enter_context(earlier_tree())
        workers = {}
        for name, compiled in EARLIER.items():
            workers[name] = Worker(tree, PROGRAM.format(compiled=compiled, length=1))
        for name, (compiled, length, _) in CASES.items():
            workers[name] = Worker(CLONE, PROGRAM.format(compiled=compiled, length=length))
        for worker in workers.values():
            stack.callback(worker.close)
            worker.milliseconds(0)
        times: dict[str, list[float]] = {name: [] for name in workers}
        for _ in range(rounds):
            for name, worker in workers.items():
                times[name].append(worker.milliseconds(seconds))
    return times


def main(out: Path | None) -> None:
    """Measures on one thread, with an empty compile cache, and reports."""
    with (
        tempfile.TemporaryDirectory() as cache,
        patch.dict(os.environ, TORCHINDUCTOR_CACHE_DIR=cache),
    ):
        times = measure(ROUNDS, SECONDS)
    ratios: dict[str, Any] = {
        name: [a / b for a, b in zip(times[peer], times[name], strict=True)]
        for name, (_, _, peer) in CASES.items()
    }
    rows = [
        [name, spread(times[peer]), spread(times[name]), spread(ratios[name], 2)]
        for name, (_, _, peer) in CASES.items()
    ]
    markdown = (
        "# CQL_TIT on images\n\nAn update on 64 transitions of 84 x 84 images, K = 4, actor and "
        "critics with an Enhanced_TIT each, one\nthread, processor time. "
        f"{ROUNDS} rounds of at least {SECONDS} seconds, alternating: median (range), ratios\n"
        "round by round.\n\n"
        + table(["", f"ms at commit {COMMIT}", "ms now", "times as fast"], rows)
    )
    publish("cql_images", markdown, {"ms": times, "ratios": ratios}, out)

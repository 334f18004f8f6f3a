"""Decision Transformer: a training step compared with TorchRL's, and evaluation side by side.

The training step is that of the protocol (batch 64, 20 steps of Hopper, width 128, 3 layers), with
the same batches, masks, optimizer and clipping for all, alternating. TorchRL's DTActor is GPT-2
from the transformers library; it has no time step embedding, which ours computes in addition. The
floor is the time that our step's matrix products take at the rate of one large product.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.utils.flop_counter import FlopCounterMode
from torchrl.data import ReplayBuffer
from torchrl.envs import Compose, TargetReturn, TransformedEnv
from torchrl.modules import DTActor, ProbabilisticActor, TanhDelta
from torchrl.objectives import DTLoss

from torchrl_tit.datasets import SequenceStorage, episodes_from_arrays, make_replay_buffer
from torchrl_tit.envs import make_env
from torchrl_tit.evaluation import evaluate
from torchrl_tit.modules import DTHead, acting, make_dt_actor, make_dt_predictor
from torchrl_tit.networks import DTTIT, DecisionTransformer, HistoryNetwork
from torchrl_tit.objectives import MaskedDTLoss
from torchrl_tit.transforms import SequenceHistory

from .report import publish, spread, table

ROUNDS, STEPS, EPISODES = 10, 4, 100
NETWORKS = {"DT": DecisionTransformer, "DT_TIT": DTTIT}
TASKS = {"HalfCheetah-v5": 30, "Hopper-v5": 200}  # with the longest episode


def make_buffer() -> ReplayBuffer:
    """Random transitions of Hopper's sizes in episodes of 100 to 500 steps."""
    steps = 20_000
    ends = torch.zeros(steps, dtype=torch.bool)
    ends[torch.randint(100, 500, (steps,)).cumsum(0).clamp(max=steps) - 1] = True
    episodes = episodes_from_arrays(
        torch.randn(steps, 11), torch.rand(steps, 3) * 2 - 1, torch.rand(steps), ends
    )
    return make_replay_buffer(SequenceStorage(episodes, 20), 64)


def make_network(name: str, size: int = 11, action_dim: int = 3) -> tuple[HistoryNetwork, DTHead]:
    """The protocol's network and its head."""
    network = NETWORKS[name]((size,), action_dim=action_dim)
    return network, DTHead(network.features_dim, action_dim)


def make_peer() -> DTLoss:
    """TorchRL's Decision Transformer of the same sizes, in its own loss, without padding."""
    settings = {
        "n_embd": 128,
        "n_layer": 3,
        "n_head": 1,
        "n_inner": 512,
        "activation": "relu",
        "n_positions": 1024,
        "resid_pdrop": 0.1,
        "attn_pdrop": 0.1,
    }
    network = TensorDictModule(
        DTActor(11, 3, transformer_config=settings),
        in_keys=["observation", "action", "return_to_go"],
        out_keys=["param"],
    )
    actor = ProbabilisticActor(
        network, in_keys=["param"], out_keys=["action"], distribution_class=TanhDelta
    )
    loss = DTLoss(actor)
    loss.loss_mask_key = "mask"
    return loss


def make_step(loss: nn.Module, buffer: ReplayBuffer) -> Callable[[], None]:
    """One gradient step."""
    parameters = list(loss.parameters())
    optimizer = torch.optim.AdamW(parameters, lr=1e-4, weight_decay=1e-4, fused=True)

    def step() -> None:
        total = loss(buffer.sample())["loss"]
        optimizer.zero_grad()
        total.backward()
        nn.utils.clip_grad_norm_(parameters, 0.25)
        optimizer.step()

    return step


def seconds(function: Callable[[], Any], repeats: int = 1) -> float:
    """Seconds of processor time of one call, which other processes do not affect."""
    start = time.process_time()
    for _ in range(repeats):
        function()
    return (time.process_time() - start) / repeats


def matrix_rate() -> float:
    """Floating-point operations per second of a product of the step's largest sizes."""
    a, b = torch.randn(64 * 59, 128), torch.randn(128, 512)
    return 2 * a.shape[0] * b.numel() / min(seconds(lambda: a @ b, 20) for _ in range(3))


def count_operations(buffer: ReplayBuffer) -> int:
    """Floating-point operations in the matrix products of DT's gradient step."""
    predictor, batch = make_dt_predictor(*make_network("DT")), buffer.sample()
    with FlopCounterMode(display=False) as counter:
        predictor(batch)["action"].sum().backward()
    return counter.get_total_flops()


def measure_training() -> tuple[list[list[object]], dict[str, Any]]:
    """A row for each network, and the numbers."""
    buffer = make_buffer()
    losses = {name: MaskedDTLoss(make_dt_predictor(*make_network(name))) for name in NETWORKS}
    steps = {"TorchRL": make_step(make_peer(), buffer)}
    steps |= {name: make_step(loss, buffer) for name, loss in losses.items()}
    operations = count_operations(buffer)
    times: dict[str, list[float]] = {name: [] for name in (*steps, "floor")}
    rates = []
    for _ in range(ROUNDS):
        rates.append(matrix_rate())
        for name, step in steps.items():
            times[name].append(seconds(step, STEPS))
        times["floor"].append(operations / rates[-1])
    rows: list[list[object]] = []
    for name, taken in times.items():
        ratios = [peer / own for peer, own in zip(times["TorchRL"], taken, strict=True)]
        ratio = "" if name == "TorchRL" else spread(ratios, 2)
        rows.append([TITLES[name], spread([1000 * t for t in taken]), ratio])
    return rows, {"seconds": times, "floor_operations": operations, "operations_per_second": rates}


TITLES = {
    "TorchRL": "`DTActor` in `DTLoss`",
    "DT": "DT of this library",
    "DT_TIT": "DT_TIT of this library",
    "floor": "matrix products of DT's step alone",
}


def measure_evaluation() -> tuple[list[list[object]], dict[str, Any]]:
    """A row for each task and network, and the numbers."""
    rows: list[list[object]] = []
    numbers: dict[str, Any] = {}
    for task, longest in TASKS.items():
        for name in NETWORKS:
            torch.manual_seed(0)
            single = make_evaluation_env(task, longest, 1)
            (size,) = single.observation_spec["observation"].shape[1:]
            action_dim = single.action_spec_unbatched.shape[0]
            actor = make_dt_actor(*make_network(name, size, action_dim))
            many = make_evaluation_env(task, longest, EPISODES)
            with acting(actor):
                apart = seconds(partial(evaluate, single, actor, EPISODES))
                beside = seconds(partial(evaluate, many, actor, EPISODES, shrink=True))
            rows.append([task, name, f"{apart:.1f}", f"{beside:.1f}", f"{apart / beside:.1f}"])
            numbers[f"{task} {name}"] = {"one_after_another": apart, "side_by_side": beside}
    return rows, numbers


def make_evaluation_env(task: str, longest: int, num_envs: int) -> TransformedEnv:
    """The task as the recipes evaluate in it."""
    env = make_env(task, num_envs, clip_actions=False, max_episode_steps=longest)
    return TransformedEnv(env, Compose(TargetReturn(3600.0), SequenceHistory(20)))


def main(out: Path | None) -> None:
    """Measures on one thread and reports."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    training, training_numbers = measure_training()
    evaluation, evaluation_numbers = measure_evaluation()
    peer = statistics.median(training_numbers["seconds"]["TorchRL"])
    ours = statistics.median(training_numbers["seconds"]["DT"])
    markdown = (
        "# Decision Transformer\n\n"
        "## A training step\n\n"
        "Batch 64, 20 steps, width 128, 3 layers, 1 head, dropout 0.1, Hopper's sizes; forward, "
        "backward,\nclipping and fused AdamW, one thread, processor time. "
        f"{ROUNDS} rounds of {STEPS} steps each,\nalternating: median (range), ratios round by "
        f"round; {peer / ours:.2f} times by the medians.\n\n"
        + table(["", "ms a step", "times as fast as `DTActor`"], training)
        + "\nOurs computes an embedding of time steps and a mask of padding in addition, and of "
        "the last\nblock only the state tokens, which are all that is read.\n\n"
        f"## {EPISODES} episodes of evaluation\n\n"
        "Untrained networks, one thread, processor time: the same episodes in one environment, "
        "one after\nanother, and in as many environments side by side. HalfCheetah's episodes have "
        f"{TASKS['HalfCheetah-v5']} steps each,\nHopper's differ in length.\n\n"
        + table(["task", "network", "one by one, s", "side by side, s", "ratio"], evaluation)
    )
    numbers = {"training": training_numbers, "evaluation_seconds": evaluation_numbers}
    publish("decision_transformer", markdown, numbers, out)

"""Decision Transformer: a training step compared with TorchRL's, and evaluation side by side.

The training step is that of the protocol (batch 64, 20 steps of Hopper, width 128, 3 layers), with
the same batches, masks, optimizer and clipping for all, alternating. TorchRL's DTActor is GPT-2
from the transformers library; it has no time step embedding, which ours computes in addition. The
floor is the time that our step's matrix products take at the rate of one large product.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn
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

from .measuring import count_flops, milliseconds, peak_flops, take_turns

ROUNDS, SECONDS, EPISODES = 10, 1.0, 100
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


def measure_training() -> dict[str, list[float]]:
    """Milliseconds of a gradient step of each program in each round, and of the floor."""
    buffer = make_buffer()
    losses = {name: MaskedDTLoss(make_dt_predictor(*make_network(name))) for name in NETWORKS}
    steps = {"TorchRL": make_step(make_peer(), buffer)}
    steps |= {name: make_step(loss, buffer) for name, loss in losses.items()}
    predictor, batch = make_dt_predictor(*make_network("DT")), buffer.sample()
    flops = count_flops(lambda: predictor(batch)["action"].sum().backward())
    floor = 1000 * flops / peak_flops(64 * 59, 128, 512)  # the step's largest sizes
    return {**take_turns(steps, ROUNDS, SECONDS), "floor": [floor] * ROUNDS}


def measure_evaluation(task: str, longest: int, name: str) -> dict[str, float]:
    """Seconds of a hundred episodes of an untrained network, one after another or side by side."""
    torch.manual_seed(0)
    single = make_evaluation_env(task, longest, 1)
    (size,) = single.observation_spec["observation"].shape[1:]
    actor = make_dt_actor(*make_network(name, size, single.action_spec_unbatched.shape[0]))
    many = make_evaluation_env(task, longest, EPISODES)
    with acting(actor):
        apart = milliseconds(partial(evaluate, single, actor, EPISODES), 0) / 1000
        beside = milliseconds(partial(evaluate, many, actor, EPISODES, shrink=True), 0) / 1000
    return {"one_after_another": apart, "side_by_side": beside}


def make_evaluation_env(task: str, longest: int, num_envs: int) -> TransformedEnv:
    """The task as the recipes evaluate in it."""
    env = make_env(task, num_envs, clip_actions=False, max_episode_steps=longest)
    return TransformedEnv(env, Compose(TargetReturn(3600.0), SequenceHistory(20)))


def main() -> dict[str, Any]:
    """Measures training and evaluation."""
    times = measure_training()
    evaluation = {
        f"{task} {name}": measure_evaluation(task, longest, name)
        for task, longest in TASKS.items()
        for name in NETWORKS
    }
    return {
        "training": {"seconds": {n: [one / 1000 for one in taken] for n, taken in times.items()}},
        "evaluation_seconds": evaluation,
    }

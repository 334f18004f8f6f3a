"""Decision Transformer: a training step compared with TorchRL's.

The training step is that of the protocol (batch 64, 20 steps of Hopper, width 128, 3 layers), with
the same batches, masks, optimizer and clipping for all, alternating. TorchRL's DTActor is GPT-2
from the transformers library; it has no time step embedding, which ours computes in addition.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import ReplayBuffer
from torchrl.modules import DTActor, ProbabilisticActor, TanhDelta
from torchrl.objectives import DTLoss

from torchrl_tit.datasets import SequenceStorage, episodes_from_arrays, make_replay_buffer
from torchrl_tit.modules import DTHead, make_dt_predictor
from torchrl_tit.networks import DTTIT, DecisionTransformer
from torchrl_tit.objectives import MaskedDTLoss

from .measuring import take_turns

ROUNDS, SECONDS = 10, 1.0
NETWORKS = {"DT": DecisionTransformer, "DT_TIT": DTTIT}


def make_buffer() -> ReplayBuffer:
    """Random transitions of Hopper's sizes in episodes of 100 to 500 steps."""
    steps = 20_000
    ends = torch.zeros(steps, dtype=torch.bool)
    ends[torch.randint(100, 500, (steps,)).cumsum(0).clamp(max=steps) - 1] = True
    episodes = episodes_from_arrays(
        torch.randn(steps, 11), torch.rand(steps, 3) * 2 - 1, torch.rand(steps), ends
    )
    return make_replay_buffer(SequenceStorage(episodes, 20), 64)


def make_ours(name: str) -> MaskedDTLoss:
    """The loss of the protocol's network and its head."""
    network = NETWORKS[name]((11,), action_dim=3)
    return MaskedDTLoss(make_dt_predictor(network, DTHead(network.features_dim, 3)))


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


def main() -> dict[str, Any]:
    """Measures the seconds of a gradient step of each program in each round."""
    buffer = make_buffer()
    steps = {"TorchRL": make_step(make_peer(), buffer)}
    steps |= {name: make_step(make_ours(name), buffer) for name in NETWORKS}
    times = take_turns(steps, ROUNDS, SECONDS)
    return {
        "training": {"seconds": {n: [one / 1000 for one in taken] for n, taken in times.items()}}
    }

"""A TIT backbone inside TorchRL's DQN loss, on CartPole."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.modules import EGreedyModule, QValueModule
from torchrl.objectives import DQNLoss, SoftUpdate

from torchrl_tit import Backbone, EnhancedTIT, History


def main(steps: int = 2_000, dropout: float = 0.0) -> DQNLoss:
    """Trains for some environment steps and returns the loss with its networks."""
    torch.manual_seed(0)
    env = TransformedEnv(
        GymEnv("CartPole-v1", categorical_action_encoding=True), History(num_frames=4)
    )
    tit = EnhancedTIT((4,), num_frames=4, ffn_dropout_inner=dropout)
    q_network = TensorDictSequential(
        Backbone(tit),
        TensorDictModule(nn.Linear(tit.features_dim, 2), ["features"], ["action_value"]),
        QValueModule(spec=env.action_spec),
    )
    explore = EGreedyModule(env.action_spec, eps_init=1.0, eps_end=0.05, annealing_num_steps=steps)
    collector = Collector(
        env,
        TensorDictSequential(q_network, explore),
        frames_per_batch=50,
        total_frames=steps,
        auto_register_policy_transforms=False,
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=64)
    loss = DQNLoss(q_network, action_space=env.action_spec, delay_value=True)
    loss.make_value_estimator(gamma=0.99)
    target = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4)
    for batch in collector:
        explore.step(batch.numel())
        buffer.extend(batch)
        for _ in range(5):
            optimizer.zero_grad()
            loss(buffer.sample())["loss"].backward()
            optimizer.step()
            target.step()
    collector.shutdown()
    return loss


if __name__ == "__main__":
    main()

"""TIT backbones inside TorchRL's SAC loss, on Pendulum."""

from __future__ import annotations

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_tit import Backbone, EnhancedTIT, History


def main(steps: int = 1_000, dropout: float = 0.0) -> SACLoss:
    """Trains for some environment steps and returns the loss with its networks."""
    torch.manual_seed(0)
    env = TransformedEnv(GymEnv("Pendulum-v1"), History(num_frames=2))
    actor_tit = EnhancedTIT((3,), num_frames=2, ffn_dropout_inner=dropout)
    actor = ProbabilisticActor(
        TensorDictSequential(
            Backbone(actor_tit),
            TensorDictModule(
                nn.Sequential(nn.Linear(actor_tit.features_dim, 2), NormalParamExtractor()),
                ["features"],
                ["loc", "scale"],
            ),
        ),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": env.action_spec.space.low, "high": env.action_spec.space.high},
    )
    # Critics have backbones of their own: SAC stacks the parameters of its critics and runs them in
    # one vmap, and the actor's update must not change the critics' features. Two critics are given
    # because TorchRL would initialize copies of a single one differently from a TIT.
    critics = []
    for _ in range(2):
        critic_tit = EnhancedTIT((3,), num_frames=2, ffn_dropout_inner=dropout)
        head = ValueOperator(
            MLP(critic_tit.features_dim + 1, 1, num_cells=[64], activation_class=nn.ReLU),
            in_keys=["critic_features", "action"],
            out_keys=["state_action_value"],
        )
        critics.append(
            TensorDictSequential(Backbone(critic_tit, out_keys=["critic_features"]), head)
        )
    collector = Collector(
        env,
        actor,
        frames_per_batch=50,
        total_frames=steps,
        auto_register_policy_transforms=False,
    )
    buffer = ReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=64)
    loss = SACLoss(actor, critics, action_spec=env.action_spec)
    loss.make_value_estimator(gamma=0.99)
    target = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    for batch in collector:
        buffer.extend(batch)
        for _ in range(5):
            terms = loss(buffer.sample())
            optimizer.zero_grad()
            (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]).backward()
            optimizer.step()
            target.step()
    collector.shutdown()
    return loss


if __name__ == "__main__":
    main()

"""TIT backbones inside TorchRL's IQL loss, offline, on transitions of a random Pendulum policy."""

from __future__ import annotations

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import IQLLoss, SoftUpdate

from torchrl_tit import Backbone, EnhancedTIT, History


def main(updates: int = 200, dropout: float = 0.0) -> IQLLoss:
    """Trains for some updates and returns the loss with its networks."""
    torch.manual_seed(0)
    env = TransformedEnv(GymEnv("Pendulum-v1"), History(num_frames=2))
    buffer = ReplayBuffer(storage=LazyTensorStorage(400), batch_size=64)
    buffer.extend(env.rollout(400, break_when_any_done=False))

    def backbone(out_key: str) -> tuple[Backbone, int]:
        tit = EnhancedTIT((3,), num_frames=2, ffn_dropout_inner=dropout)
        return Backbone(tit, out_keys=[out_key]), tit.features_dim

    actor_backbone, width = backbone("actor_features")
    actor_head = nn.Sequential(nn.Linear(width, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictSequential(
            actor_backbone, TensorDictModule(actor_head, ["actor_features"], ["loc", "scale"])
        ),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
    )
    q_networks = []
    for _ in range(2):
        q_backbone, width = backbone("q_features")
        q_head = ValueOperator(
            MLP(width + 1, 1, num_cells=[64], activation_class=nn.ReLU),
            in_keys=["q_features", "action"],
            out_keys=["state_action_value"],
        )
        q_networks.append(TensorDictSequential(q_backbone, q_head))
    v_backbone, width = backbone("v_features")
    value = TensorDictSequential(
        v_backbone, ValueOperator(nn.Linear(width, 1), in_keys=["v_features"])
    )
    loss = IQLLoss(actor, q_networks, value)
    loss.make_value_estimator(gamma=0.99)
    target = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-4)
    for _ in range(updates):
        terms = loss(buffer.sample())
        optimizer.zero_grad()
        (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_value"]).backward()
        optimizer.step()
        target.step()
    return loss


if __name__ == "__main__":
    main()

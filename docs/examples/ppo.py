"""A TIT backbone before TorchRL's PPO loss, on CartPole: it runs once for policy and value."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_tit import Backbone, EnhancedTIT, History
from torchrl_tit.modules import add_rollout_features, make_actor, make_value


def main(steps: int = 8_192, dropout: float = 0.0) -> tuple[Backbone, ClipPPOLoss]:
    """Trains for some environment steps and returns the backbone, and the loss with its heads."""
    torch.manual_seed(0)
    env = TransformedEnv(GymEnv("CartPole-v1"), History(num_frames=4))
    tit = EnhancedTIT((4,), num_frames=4, ffn_dropout_inner=dropout)
    backbone = Backbone(tit)
    actor, critic = make_actor(tit.features_dim, env.action_spec), make_value(tit.features_dim)
    policy = TensorDictSequential(backbone, actor)
    collector = Collector(
        env,
        policy,
        frames_per_batch=512,
        total_frames=steps,
        auto_register_policy_transforms=False,
    )
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=None)  # reads the values written below
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, critic_coeff=0.5)
    parameters = [*backbone.parameters(), *loss.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=3e-4)
    policy.eval()  # no dropout while acting
    for batch in collector:
        with torch.no_grad():
            add_rollout_features(batch, backbone)
            critic(batch), critic(batch["next"])
            gae(batch)
        policy.train()
        for _ in range(4):
            for index in torch.randperm(len(batch)).split(64):
                minibatch = batch[index]
                terms = loss(backbone(minibatch))
                optimizer.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]).backward()
                torch.nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()
        policy.eval()
    collector.shutdown()
    return backbone, loss


if __name__ == "__main__":
    main()

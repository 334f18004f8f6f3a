"""A TIT backbone before TorchRL's PPO loss, on CartPole: it runs once for policy and value.

It trains on segments of 16 consecutive steps, in TorchRL's recurrent mode, as an LSTM would. So
each frame of a segment is encoded once, whatever the length of the history.
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import Compose, GymEnv, InitTracker, TransformedEnv
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_tit import Backbone, EnhancedTIT, History
from torchrl_tit.modules import make_actor, make_value


def main(steps: int = 8_192, dropout: float = 0.0) -> tuple[Backbone, ClipPPOLoss]:
    """Trains for some environment steps and returns the backbone, and the loss with its heads."""
    torch.manual_seed(0)
    env = TransformedEnv(GymEnv("CartPole-v1"), Compose(InitTracker(), History(num_frames=4)))
    tit = EnhancedTIT((4,), num_frames=4, ffn_dropout_inner=dropout)
    backbone = Backbone(tit, observation_keys="observation")
    actor, critic = make_actor(tit.features_dim, env.action_spec), make_value(tit.features_dim)
    policy = TensorDictSequential(backbone, actor)
    collector = Collector(
        env,
        policy,
        frames_per_batch=512,
        total_frames=steps,
        auto_register_policy_transforms=False,
    )
    value = TensorDictSequential(backbone, critic)
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=value, deactivate_vmap=True)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, critic_coeff=0.5)
    parameters = [*backbone.parameters(), *loss.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=3e-4)
    policy.eval()  # no dropout while acting
    for batch in collector:
        with set_recurrent_mode(True):
            gae(batch)  # reads the batch as one sequence
        segments = batch.exclude("features", "state_value").reshape(-1, 16)
        policy.train()
        for _ in range(4):
            for index in torch.randperm(len(segments)).split(4):
                minibatch = segments[index]
                with set_recurrent_mode(True):
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

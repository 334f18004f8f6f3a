"""Three agents that share a TIT backbone and TorchRL's PPO loss, in an environment like VMAS's.

All that belongs to the agents is in the group "agents": observations [N, agents, D], in a batch
[N, T, agents, D]. An environment of VMAS or PettingZoo takes the place of `Meet` as it is.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, TransformedEnv
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_tit import Backbone, EnhancedTIT, History
from torchrl_tit.envs import observation_specs
from torchrl_tit.modules import make_actor, make_value


class Meet(EnvBase):
    """Agents on a line meet: a step costs each its distance to the mean of the others."""

    def __init__(self, num_envs: int = 8, agents: int = 3) -> None:
        super().__init__(batch_size=[num_envs])
        group = (num_envs, agents)

        def of_agents(**specs: object) -> Composite:
            return Composite(agents=Composite(specs, shape=group), shape=[num_envs])

        self.observation_spec = of_agents(observation=Unbounded((*group, 2)))
        self.action_spec = of_agents(action=Categorical(3, shape=group))
        self.reward_spec = of_agents(reward=Unbounded((*group, 1)))
        self.done_spec = Categorical(2, shape=(num_envs, 1), dtype=torch.bool)
        self.generator = torch.Generator()
        self.places = torch.zeros(*group)
        self.time = torch.zeros(num_envs, 1)

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDict:
        begins = torch.ones_like(self.time, dtype=torch.bool)
        if tensordict is not None:
            begins = tensordict.get("_reset", begins)
        places = 2 * torch.rand(self.places.shape, generator=self.generator) - 1
        self.places = torch.where(begins, places, self.places)
        self.time = torch.where(begins, 0, self.time)
        return self._observe()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.places = self.places + 0.2 * (tensordict["agents", "action"] - 1)
        self.time = self.time + 1
        following = self._observe()
        own, others = following["agents", "observation"].split(1, -1)
        following["agents", "reward"] = -(own - others).abs()
        done = self.time >= 20
        return following.update({"done": done, "terminated": torch.zeros_like(done)})

    def _observe(self) -> TensorDict:
        """Each agent sees its own place and the mean place of the others."""
        others = (self.places.sum(-1, keepdim=True) - self.places) / (self.places.shape[-1] - 1)
        agents = TensorDict(
            {"observation": torch.stack([self.places, others], -1)}, self.places.shape
        )
        return TensorDict({"agents": agents}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)


def main(steps: int = 8_192) -> tuple[Backbone, list[float]]:
    """Trains for some environment steps; returns the backbone and the mean reward of each batch."""
    torch.manual_seed(0)
    histories = History(num_frames=4, in_keys=[("agents", "observation")])
    env = TransformedEnv(Meet(), Compose(InitTracker(), histories))
    env.set_seed(0)
    tit = EnhancedTIT(observation_specs(env), num_frames=4, patch_size="auto", embed_dim=16)
    backbone = Backbone(
        tit, [("agents", "history")], observation_keys=[("agents", "observation")]
    )  # writes ("agents", "features"), which the heads read
    features = ("agents", "features")
    actor = make_actor(
        tit.features_dim, env.full_action_spec_unbatched["agents", "action"], in_key=features
    )
    critic = make_value(tit.features_dim, in_key=features)
    collector = Collector(
        env,
        TensorDictSequential(backbone, actor),
        frames_per_batch=512,
        total_frames=steps,
        auto_register_policy_transforms=False,
    )
    value = TensorDictSequential(backbone, critic)
    gae = GAE(gamma=0.95, lmbda=0.9, value_network=value, deactivate_vmap=True)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, critic_coeff=0.5)
    keys = {
        "advantage": ("agents", "advantage"),
        "value_target": ("agents", "value_target"),
        "value": ("agents", "state_value"),
        "reward": ("agents", "reward"),
        "done": ("agents", "done"),
        "terminated": ("agents", "terminated"),
    }
    gae.set_keys(**keys)
    sample_log_prob = ("agents", "action_log_prob")
    loss.set_keys(**keys, action=("agents", "action"), sample_log_prob=sample_log_prob)
    parameters = [*backbone.parameters(), *loss.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=1e-3)
    rewards = []
    for batch in collector:  # [N, T]
        reward = batch["next", "agents", "reward"]  # [N, T, agents, 1]
        rewards.append(reward.mean().item())
        for key in ("done", "terminated"):  # the losses want them for each agent
            batch["next", "agents", key] = batch["next", key].unsqueeze(-2).expand(reward.shape)
        with set_recurrent_mode(True):
            gae(batch)
        batch = batch.exclude(features, ("agents", "state_value"))
        for _ in range(4):
            for index in torch.randperm(len(batch)).split(2):
                with set_recurrent_mode(True):
                    terms = loss(backbone(batch[index]))  # sequences of 64 steps
                optimizer.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]).backward()
                torch.nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()
    collector.shutdown()
    return backbone, rewards


if __name__ == "__main__":
    print(main()[1])

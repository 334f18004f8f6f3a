"""Histories of several agents, in single steps and in sequences."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.modules import set_recurrent_mode

from docs.examples.several_agents import Meet
from tests.networks.reference import randomize
from torchrl_tit import Backbone, EnhancedTIT, History
from torchrl_tit.envs import observation_keys, observation_specs
from torchrl_tit.modules import history_keys, make_actor, make_squashed_actor, make_value
from torchrl_tit.networks import build_network
from torchrl_tit.settings.networks import lstm

KEY, HISTORY = ("agents", "observation"), ("agents", "history")


class Ends(Meet):
    """PettingZoo's environments also have flags for each agent."""

    def __init__(self) -> None:
        super().__init__(num_envs=2)
        flag = Categorical(2, shape=(2, 3, 1), dtype=torch.bool)
        agents = Composite(done=flag, terminated=flag.clone(), shape=(2, 3))
        own = Categorical(2, shape=(2, 1), dtype=torch.bool)
        self.done_spec = Composite(done=own, terminated=own.clone(), agents=agents, shape=[2])

    def _step(self, tensordict: Any) -> Any:
        following = super()._step(tensordict)
        for key in ("done", "terminated"):
            flags = following[key].unsqueeze(-2).expand(2, 3, 1)
            following["agents", key] = flags.clone()
        return following


@pytest.mark.parametrize("make", [lambda: Meet(num_envs=2), Ends])
def test_agents_are_read_as_if_alone(make: Any) -> None:
    env = TransformedEnv(make(), Compose(InitTracker(), History(4, in_keys=[KEY])))
    spec: Any = observation_specs(env)
    assert (spec.shape, observation_keys(env)) == ((2,), [KEY])
    tit = EnhancedTIT((2,), num_frames=4, temporal_positions="learned").double()
    randomize(tit)
    rollout = env.rollout(27, break_when_any_done=False)  # episodes end after 20
    batch: Any = rollout.apply(lambda x: x.double() if x.is_floating_point() else x)
    batch = torch.stack([batch[0, :22], batch[1, 5:]])  # where episodes begin at another step
    assert batch[HISTORY].shape == (2, 22, 3, 4, 2)
    together, alone = Backbone(tit, [HISTORY]), Backbone(tit)
    expected = []
    for agent in range(3):
        one = batch.select("is_init", "done", ("next", "done"))
        one["observation"], one["history"] = batch[KEY][:, :, agent], batch[HISTORY][:, :, agent]
        expected.append(alone(one)["features"])
    features = torch.stack(expected, 2)
    assert not torch.allclose(features[:, :, 0], features[:, :, 1])
    torch.testing.assert_close(together(batch.clone())["agents", "features"], features)
    with set_recurrent_mode(True):
        for padding in (None, "same"):
            read = Backbone(tit, [HISTORY], padding=padding)(batch.clone())
            torch.testing.assert_close(read["agents", "features"], features)
        within = together(batch[:, 5:].exclude(HISTORY))  # begins inside an episode
    valid = within["agents", "features_valid"]
    assert valid.shape == (2, 17, 3, 1)
    assert valid[0, :, 1, 0].tolist() == [step >= 3 for step in range(17)]
    chosen = valid.expand_as(features[:, 5:])
    torch.testing.assert_close(within["agents", "features"][chosen], features[:, 5:][chosen])


def test_heads_write_beside_the_features() -> None:
    env = TransformedEnv(Meet(num_envs=2), History(2, in_keys=[KEY]))
    tit, features = EnhancedTIT((2,), num_frames=2), ("agents", "features")
    spec = env.full_action_spec_unbatched["agents", "action"]
    actor = make_actor(tit.features_dim, spec, in_key=features)
    critic = make_value(tit.features_dim, in_key=features)
    steps = env.rollout(3, TensorDictSequential(Backbone(tit, [HISTORY]), actor, critic))
    assert set(steps.keys()) == {"agents", "done", "terminated", "next"}
    for name, shape in {"action": (), "action_log_prob": (), "state_value": (1,)}.items():
        assert steps["agents", name].shape == (2, 3, 3, *shape)
    squashed = make_squashed_actor(tit.features_dim, Bounded(-1, 1, (2,)), in_key=features)
    assert squashed.out_keys == [("agents", "loc"), ("agents", "scale"), ("agents", "action")]


def test_a_state_is_that_of_one_agent() -> None:
    with pytest.raises(ValueError, match=r"state for one agent, .* num_frames of 2 or more"):
        Backbone(build_network(lstm(), Unbounded(2)), [HISTORY])
    Backbone(build_network(lstm(2), Unbounded(2)), [HISTORY])
    # One of several observations is no group of agents, whatever its name.
    several = {"price_history": Unbounded(2), "state": Unbounded(3)}
    assert Backbone(build_network(lstm(), several), history_keys(several)).out_keys[0] == "features"

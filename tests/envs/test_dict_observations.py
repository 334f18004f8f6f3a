"""Pixels and state of one environment reach backbones by their keys."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import Compose, GymWrapper, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.transforms.streams import assert_histories
from torchrl_tit import Backbone, EnhancedTIT, History
from torchrl_tit.modules import make_actor


class Robot(gymnasium.Env):
    """A camera and joints, all by chance."""

    observation_space = Dict(
        sensors=Dict(camera=Box(0, 255, (6, 8), np.uint8), joints=Box(-1, 1, (3,), np.float32))
    )
    action_space = Discrete(2)

    def _observe(self):
        camera = self.np_random.integers(0, 256, (6, 8), np.uint8)
        return {"sensors": {"camera": camera, "joints": self.np_random.random(3, np.float32)}}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observe(), {}

    def step(self, action):
        return self._observe(), float(action), bool(self.np_random.random() < 0.2), False, {}


CAMERA, JOINTS = ("sensors", "camera"), ("sensors", "joints")
SEEN, FELT = ("histories", "camera"), ("histories", "joints")


@pytest.fixture
def env():
    tasks = SyncVectorEnv([Robot] * 3, autoreset_mode=AutoresetMode.DISABLED)
    return TransformedEnv(
        GymWrapper(tasks, categorical_action_encoding=True),
        Compose(
            History(4, [CAMERA], [SEEN], observation_ndim=2),
            History(2, [JOINTS], [FELT]),
        ),
    )


def test_histories_of_each_key(env):
    check_env_specs(env)
    assert env.observation_spec[SEEN].shape == (3, 4, 6, 8)
    assert env.reset()[SEEN].dtype is torch.uint8
    assert_histories(env, 4, "same", observation=CAMERA, history=SEEN)
    assert_histories(env, 2, "same", observation=JOINTS, history=FELT)


def test_backbones_read_their_own_key(env):
    camera = EnhancedTIT(
        observation_shape=(6, 8),
        num_frames=4,
        patch_size=2,
        embed_dim=8,
        num_blocks=1,
        features_dim=5,
    )
    joints = EnhancedTIT(observation_shape=(3,), num_frames=2, embed_dim=8, features_dim=7)
    policy = TensorDictSequential(
        Backbone(camera, in_keys=[SEEN], out_keys=["seen"]),
        Backbone(joints, in_keys=[FELT], out_keys=["felt"]),
        TensorDictModule(
            lambda seen, felt: torch.cat([seen, felt], -1), ["seen", "felt"], ["features"]
        ),
        make_actor(12, env.action_spec_unbatched, in_key="features"),
    )
    rollout = env.rollout(5, policy, break_when_any_done=False)
    assert rollout["features"].shape == (3, 5, 12)
    root = rollout[:, 0].exclude("features", "seen", "felt")
    before = policy(root.clone())
    root[CAMERA] = root[CAMERA] * 0
    assert torch.equal(policy(root.clone())["features"], before["features"])
    root[SEEN] = 255 - root[SEEN]
    after = policy(root.clone())
    assert torch.equal(after["felt"], before["felt"])
    assert not torch.equal(after["seen"], before["seen"])

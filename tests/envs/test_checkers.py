"""TorchRL's checker finds nothing to say about any kind of task."""

from typing import Any

import pytest
from torchrl.envs import StepCounter
from torchrl.envs.utils import check_env_specs

import torchrl_tit.tasks  # noqa: F401 (registers TMaze-v0)
from tests.envs.tasks import Corridor, Robot
from torchrl_tit.envs import make_env

ROBOT, CORRIDOR = f"{Robot.__module__}:Robot-v0", f"{Corridor.__module__}:Corridor"
SHORT = {"max_episode_steps": 2}

TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "discrete actions": ("CartPole-v1", SHORT),
    "actions that are clipped": ("Pendulum-v1", SHORT),
    "actions within bounds": ("Pendulum-v1", {"clip_actions": False, **SHORT}),
    "MuJoCo": ("Hopper-v5", SHORT),
    "hidden velocities": ("Hopper-v5", {"hide_velocities": True, **SHORT}),
    "categories": ("FrozenLake-v1", SHORT),
    "a tuple": ("Blackjack-v1", {}),
    "a mask": ("Taxi-v4", {"mask_actions": True, **SHORT}),
    "a dictionary": (ROBOT, SHORT),
    "a dictionary and masks": (ROBOT, {"mask_actions": True, **SHORT}),
    "some of a dictionary": (ROBOT, {"observation_keys": ["arm", "camera"], **SHORT}),
    "processes": ("CartPole-v1", {"vectorization_mode": "async", **SHORT}),
    "a dictionary in processes": (ROBOT, {"vectorization_mode": "async", **SHORT}),
    "memory": ("TMaze-v0", {"corridor_length": 1}),
    "the previous step": (
        "TMaze-v0",
        {"corridor_length": 1, "wrappers": ["torchrl_tit.tasks:PreviousStep"]},
    ),
    "MiniGrid": ("MiniGrid-Empty-5x5-v0", {"max_steps": 2}),
    "MiniGrid's pixels": (
        "MiniGrid-Empty-5x5-v0",
        {
            "max_steps": 2,
            "wrappers": [
                "minigrid.wrappers:RGBImgPartialObsWrapper(tile_size=2)",
                "minigrid.wrappers:ImgObsWrapper",
                "torchrl_tit.tasks:FirstActions(count=3)",
            ],
        },
    ),
    "POPGym": ("popgym-RepeatPreviousEasy-v0", {}),
    "POPGym's numbers": ("popgym-PositionOnlyCartPoleEasy-v0", {}),
    "Atari": ("ALE/Breakout-v5", {}),
    "MinAtar": ("MinAtar/Freeway-v1", {"image_layout": "HWC", **SHORT}),
    "TorchRL": (CORRIDOR, {"half": 1}),
    "TorchRL's masks": (
        CORRIDOR,
        {
            "half": 1,
            "mask_actions": True,
            "wrappers": [
                "torchrl.envs:RenameTransform(in_keys=['allowed'], out_keys=['action_mask'])"
            ],
        },
    ),
    "TorchRL in processes": (CORRIDOR, {"half": 1, "vectorization_mode": "async"}),
    "TorchRL's own": ("torchrl.envs:PendulumEnv", {}),
    "a transform before histories": (
        "CartPole-v1",
        {
            "wrappers": [
                "torchrl.envs:ObservationNorm(loc=0.0, scale=2.0, in_keys=['observation'])"
            ],
            **SHORT,
        },
    ),
    "a device": ("CartPole-v1", {"device": "cpu", **SHORT}),
    "zeros before an episode": ("CartPole-v1", {"padding": "constant", **SHORT}),
}


@pytest.mark.filterwarnings("ignore:The observation '(mission|speech)'")
@pytest.mark.parametrize(
    ("kind", "num_envs", "num_frames"),
    [*((kind, 2, 3) for kind in TASKS), ("MuJoCo", 1, 1), ("a dictionary and masks", 1, 1)],
)
def test_specs_tell_the_truth(kind: str, num_envs: int, num_frames: int) -> None:
    name, settings = TASKS[kind]
    if kind == "MinAtar":
        pytest.importorskip("minatar")
    env = make_env(name, num_envs, seed=0, num_frames=num_frames, **settings)
    try:
        check_env_specs(env, break_when_any_done="both")
        check_env_specs(env.append_transform(StepCounter()), break_when_any_done="both")
    finally:
        env.close(raise_if_closed=False)

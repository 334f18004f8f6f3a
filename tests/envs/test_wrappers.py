"""Tasks, wrappers and transforms by name."""

import gymnasium
import pytest
import torch

from tests.envs.test_spaces import kinds
from torchrl_tit.envs import make_env, time_limit
from torchrl_tit.envs.names import find_task

MINIGRID = "MiniGrid-Empty-5x5-v0"
FLATTEN = "gymnasium.wrappers:FlattenObservation"


class OutOfTune(gymnasium.Wrapper):
    """Fails when it is made."""

    def __init__(self, env: gymnasium.Env) -> None:
        raise RuntimeError("no strings")


class Tuned(gymnasium.Wrapper):
    """Takes settings that the functions which pass them on have, too."""

    def __init__(self, env: gymnasium.Env, name: str, kind: str) -> None:
        super().__init__(env)
        self.metadata = {**env.metadata, "render_fps": len(name + kind)}


def test_settings_may_have_any_name():
    env = make_env("CartPole-v1", wrappers=[f"{__name__}:Tuned(name='lute', kind='F')"])
    assert env.render_fps == 5
    for task, setting in (("TMaze-v0", "mode"), ("TMaze-v0", "wraps"), ("ALE/Pong-v5", "speed")):
        with pytest.raises(ValueError, match=f"cannot be made: .*'{setting}'"):
            make_env(task, **{setting: 1})  # type: ignore[arg-type]


def test_gymnasium_wrappers_in_order():
    pixels = make_env(
        MINIGRID,
        2,
        seed=0,
        wrappers=[
            "minigrid.wrappers:RGBImgPartialObsWrapper(tile_size=2)",
            "minigrid.wrappers:ImgObsWrapper",
        ],
    )
    assert kinds(pixels) == ((3, 14, 14), "uint8")
    gray = "gymnasium.wrappers:GrayscaleObservation"
    inner_first = ["minigrid.wrappers:ImgObsWrapper", gray]
    assert kinds(make_env(MINIGRID, wrappers=inner_first)) == ((7, 7), "uint8")
    with pytest.raises(ValueError, match="GrayscaleObservation' cannot be made"):
        make_env(MINIGRID, wrappers=inner_first[::-1])


def test_observations_that_do_not_fit_their_space_are_named():
    # ViewSizeWrapper narrows MiniGrid's symbols, not its pictures.
    names = [
        "minigrid.wrappers:ViewSizeWrapper(agent_view_size=3)",
        "minigrid.wrappers:RGBImgPartialObsWrapper(tile_size=8)",
        "minigrid.wrappers:ImgObsWrapper",
    ]
    with pytest.raises(ValueError, match=r"shape \(56, 56, 3\), but its space says \(24, 24, 3\)"):
        make_env(MINIGRID, 2, wrappers=names).reset()


def test_names_in_modules():
    assert find_task("tests.envs.tasks:Robot-v0") == "tests.envs.tasks:Robot-v0"
    assert time_limit("tests.envs.tasks:Robot-v0") == 50
    assert time_limit("tests.envs.tasks:Corridor") is None
    assert find_task(MINIGRID) in (MINIGRID, f"minigrid:{MINIGRID}")


@pytest.mark.parametrize(
    ("name", "wrappers", "words"),
    [
        ("no_such_module:Task-v0", [], "there is no module 'no_such_module'"),
        ("tests.envs.tasks:Plain-v0", [], "tests.envs.tasks neither registers 'Plain-v0'"),
        ("tests.envs.tasks:Robot", [], "neither registers 'Robot' with Gymnasium"),
        ("MiniGrid-Emty-5x5-v0", [], "Unknown task .* did you mean MiniGrid-Empty-5x5-v0"),
        ("CartPole-v1", ["gymnasium:Env"], "'gymnasium:Env' is neither a gymnasium.Wrapper nor"),
        ("CartPole-v1", ["gymnasium.wrappers:Flat"], "gymnasium.wrappers has no 'Flat'"),
        ("CartPole-v1", ["no_such_module:Wrapper"], "there is no module 'no_such_module'"),
        ("CartPole-v1", [f"{__name__}:OutOfTune"], "cannot be made: RuntimeError: no strings"),
        (
            "CartPole-v1",
            ["torchrl.envs:StepCounter", FLATTEN],
            "FlattenObservation' stands after a TorchRL transform",
        ),
        ("ALE/Pong-v5", [FLATTEN], "read in one way"),
        ("ALE/Pong-v5", ["torchrl.envs:StepCounter(max_steps=9)"], "ends a game .* that goes on"),
        ("ALE/Pong-v5", ["torchrl.envs:RewardScaling(loc=0, scale=2)"], "changes the rewards of"),
        ("CartPole-v1", ["torchrl.envs:FrameSkipTransform"], "has ended, and loses its end"),
        ("CartPole-v1", ["torchrl.envs:EndOfLifeTransform"], "games here step together"),
    ],
)
def test_one_line_says_what_is_wrong(name, wrappers, words):
    with pytest.raises(ValueError, match=words) as caught:
        make_env(name, wrappers=wrappers)
    assert "\n" not in str(caught.value)


def test_transforms_that_do_not_fit_a_task():
    with pytest.raises(ValueError, match=r"CatTensors'\] do not fit CartPole-v1: ") as raised:
        make_env("CartPole-v1", wrappers=["torchrl.envs:CatTensors"])
    assert "\n" not in str(raised.value)
    name = "torchrl.envs:ActionDiscretizer(num_intervals=5)"
    made = make_env("Pendulum-v1", wrappers=[name], clip_actions=False)
    assert made.action_spec.rand().dtype == torch.int64
    with pytest.raises(ValueError, match="must be Bounded"):
        make_env("Pendulum-v1", wrappers=[name])

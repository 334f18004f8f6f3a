"""Any TorchRL environment is a task, with the keys and kinds of our environments."""

import numpy as np
import pytest
import torch
from tensordict import assert_close
from tensordict.nn import TensorDictModule
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    NonTensor,
    OneHot,
    Unbounded,
)
from torchrl.envs import EnvBase, GymEnv, RenameTransform, TransformedEnv

from tests.envs.tasks import Corridor
from tests.envs.test_spaces import kinds
from tests.transforms.streams import assert_histories
from torchrl_tit.agents.acting import Actor
from torchrl_tit.envs import make_env
from torchrl_tit.envs.torchrl_specs import TensorReader, action_spec
from torchrl_tit.envs.torchrl_tasks import TorchRLTask

CORRIDOR = "tests.envs.tasks:Corridor"


def cart_pole() -> EnvBase:
    return GymEnv("CartPole-v1")


def not_an_env() -> EnvBase:
    return "no"


def batched() -> EnvBase:
    return make_env("CartPole-v1", 2)


def crowd() -> EnvBase:
    env = Corridor()
    env.reward_spec = Unbounded((2,))
    return env


def two_hands() -> EnvBase:
    env = Corridor()
    env.full_action_spec = Composite(left=Categorical(2), right=Categorical(2))
    return env


def nested() -> EnvBase:
    renaming = RenameTransform([], [], ["action"], [("agents", "action")])
    return TransformedEnv(Corridor(), renaming)


def actions(env: EnvBase, steps: int) -> list[torch.Tensor]:
    torch.manual_seed(0)
    return [env.action_spec.rand() for _ in range(steps)]


def test_keys_and_kinds():
    env = make_env(CORRIDOR, 3, seed=0, num_frames=2)
    expected = {
        "allowed": [2, 2, 2],
        "pixels": ((3, 5, 7), "uint8"),
        "place": [7],
        "sensors/wind": ((1,), "float32"),
    }
    assert kinds(env) == expected
    assert type(env.action_spec) is Categorical
    assert env.action_spec.shape == (3,)
    for name in expected:
        assert_histories(env, 2, "same", 20, ("observation", name), ("history", name))


def test_copies_play_as_one_alone():
    together = make_env(CORRIDOR, 3, observation_keys=["place", "sensors"], num_frames=2)
    chosen = actions(together, 25)
    root, steps = together.reset(seed=5), []
    for action in chosen:
        step, root = together.step_and_maybe_reset(root.set("action", action))
        steps.append(step)
    ended = torch.stack([step["next", "done"].flatten() for step in steps])
    for i in range(3):
        env = Corridor()
        env.set_seed(5 + i)
        root = env.reset()
        total = 0.0
        for j, action in enumerate(chosen):
            step = steps[j][i]
            assert step["observation", "place"].item() == root["place"].int().argmax()
            assert step["observation", "sensors/wind"] == root["sensors", "wind"].float()
            one_hot = torch.eye(3, dtype=torch.bool)[action[i]]
            taken, root = env.step_and_maybe_reset(root.set("action", one_hot))
            total += taken["next", "reward"].item()
            assert step["next", "reward"] == taken["next", "reward"]
            assert step["next", "episode_reward"].item() == total
            for name in ("done", "terminated"):
                assert step["next", name] == taken["next", "done"]
            assert not step["next", "truncated"]
            total = 0.0 if taken["next", "done"] else total
    assert ended.sum() > 3
    assert not ended.all(1).any()


def test_time_limit_is_truncation():
    env = make_env("torchrl.envs:PendulumEnv", 2, seed=0, max_episode_steps=4, clip_actions=False)
    assert "step_count" not in env.observation_spec["observation"]
    rollout = env.rollout(8, break_when_any_done=False)
    truncated = rollout["next", "truncated"].squeeze(-1)
    assert truncated.tolist() == [([False] * 3 + [True]) * 2] * 2
    assert not rollout["next", "terminated"].any()
    assert env.action_spec_unbatched.space.high.item() == 2


@pytest.mark.parametrize("clip", [True, False])
def test_an_action_that_is_not_a_number_is_refused(clip):
    env = make_env("torchrl.envs:PendulumEnv", 2, seed=0, clip_actions=clip)
    with pytest.raises(ValueError, match=r"the action \[nan\] is not a number"):
        env.step(env.reset().set("action", torch.tensor([[1.0], [torch.nan]])))


@pytest.mark.parametrize(
    "found",
    [
        Bounded(-1, 1, (2, 3)),
        OneHot(3),
        MultiOneHot([2, 3]),
        MultiCategorical([2, 3]),
        Binary(3, shape=(2, 3)),
    ],
    ids=lambda spec: type(spec).__name__,
)
def test_actions_of_several_copies_are_converted_at_once(found):
    spec, write = action_spec(found, clip=True)
    actions = 3 * spec.rand((4,)) if spec.dtype.is_floating_point else spec.rand((4,))
    written = write(actions)
    assert torch.equal(written, torch.stack([write(action) for action in actions]))
    assert found.expand(4, *found.shape).is_in(written)


def test_an_agent_acts_on_a_machine_in_the_tasks_own_form():
    """The environment of which it takes the form has never begun."""
    policy = TensorDictModule(
        lambda x: 9 * x.sign(), in_keys=[("observation", "th")], out_keys=["action"]
    )
    actor = Actor(
        policy, lambda n: make_env("torchrl.envs:PendulumEnv", n, observation_keys=["th", "thdot"])
    )
    state = {"th": np.array([[0.5], [-0.5]]), "thdot": np.zeros((2, 1))}
    assert actor.act(state).tolist() == [[2.0], [-2.0]]


def test_masks():
    env = make_env(f"{__name__}:masked", 2, seed=0, mask_actions=True, observation_keys=["place"])
    rollout = env.rollout(30, break_when_any_done=False)
    assert rollout["action_mask"].shape == (2, 30, 3)
    assert 0.5 < rollout["action_mask"][..., 1].float().mean() < 1
    assert rollout["action_mask"][..., 0].all()


def masked(*closed: int) -> EnvBase:
    from torchrl.envs import RenameTransform, TransformedEnv

    return TransformedEnv(Closed(*closed), RenameTransform(["allowed"], ["action_mask"]))


class Closed(Corridor):
    """Allows nothing at some places."""

    def __init__(self, *closed: int) -> None:
        self.closed = closed
        super().__init__()

    def _observe(self):
        found = super()._observe()
        return found.set("allowed", found["allowed"] & (abs(self.place) not in self.closed))


def test_a_mask_may_allow_nothing_only_at_the_end():
    ends = TorchRLTask(masked(3), mask_actions=True, observation_keys=["place"])
    assert not ends.rollout(1_000)["next", "action_mask"][-1].any()
    middle = TorchRLTask(masked(1), mask_actions=True, observation_keys=["place"])
    with pytest.raises(ValueError, match="allows no action, though the episode goes on"):
        middle.rollout(1_000)


def test_transforms_are_inside():
    wrapper = "torchrl.envs:RewardScaling(loc=1.0, scale=2.0)"
    env = make_env(CORRIDOR, 2, seed=0, wrappers=[wrapper], observation_keys=["place"])
    plain = make_env(CORRIDOR, 2, seed=0, observation_keys=["place"])
    root, other = env.reset(seed=1), plain.reset(seed=1)
    for action in actions(env, 6):
        step, root = env.step_and_maybe_reset(root.set("action", action))
        expected, other = plain.step_and_maybe_reset(other.set("action", action))
        assert torch.equal(step["next", "reward"], expected["next", "reward"] * 2 + 1)


def test_pictures():
    env = make_env(CORRIDOR, 2, seed=0, render_mode="rgb_array")
    env.reset()
    pictures = env.base_env.render()
    assert pictures.shape == (2, 5, 7, 3)
    assert pictures[:, :, 3].min() == 255
    task = make_env("torchrl.envs:PendulumEnv", seed=0)
    with pytest.raises(ValueError, match='neither a method "render" nor an observation "pixels"'):
        task.base_env.render()


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        (OneHot(4), [4]),
        (OneHot(3, shape=(2, 3)), [3, 3]),
        (MultiOneHot([2, 3]), [2, 3]),
        (Categorical(5), [5]),
        (Categorical(5, shape=(2,)), [5, 5]),
        (MultiCategorical([2, 3]), [2, 3]),
        (Binary(3), [2, 2, 2]),
        (Unbounded((2, 9, 9), dtype=torch.uint8), ((2, 9, 9), "uint8")),
        (Unbounded((9, 9, 3)), ((3, 9, 9), "float32")),
        (Bounded(-1, 1, (), dtype=torch.float64), ((1,), "float32")),
        (Unbounded((3,), dtype=torch.int64), ((3,), "float32")),
    ],
)
def test_kinds_of_observations(spec, expected):
    read = TensorReader(Composite(seen=spec))
    sizes = getattr(read.spec, "nvec", None)
    shape = (tuple(read.spec.shape), str(read.spec.dtype).removeprefix("torch."))
    assert (shape if sizes is None else torch.as_tensor(sizes).tolist()) == expected
    value = spec.rand()
    seen = read(Composite(seen=spec).zero().set("seen", value))
    assert read.spec.is_in(seen)
    if isinstance(spec, OneHot | MultiOneHot):
        widths = [2, 3] if isinstance(spec, MultiOneHot) else [spec.shape[-1]]
        parts = value.float().split(widths, -1)
        assert seen.tolist() == torch.stack([p.argmax(-1) for p in parts], -1).flatten().tolist()
    elif len(spec.shape) == 3 and spec.shape[-1] == 3:
        assert torch.equal(seen, value.movedim(-1, 0))
    else:
        assert torch.equal(seen.flatten(), value.flatten().to(seen.dtype))


@pytest.mark.parametrize(
    ("found", "ours", "action", "expected"),
    [
        (Categorical(3), Categorical, 2, 2),
        (Categorical(3, shape=(1,)), Categorical, 2, [2]),
        (Categorical(3, shape=(2,)), MultiCategorical, [2, 0], [2, 0]),
        (OneHot(3), Categorical, 2, [False, False, True]),
        (MultiOneHot([2, 3]), MultiCategorical, [1, 0], [False, True, True, False, False]),
        (Binary(2, dtype=torch.float32), Binary, [1, 0], [1.0, 0.0]),
        (Bounded(-1, 1, (2, 1)), Unbounded, [-3.0, 0.5], [[-1.0], [0.5]]),
        (Unbounded((1,), dtype=torch.float64), Unbounded, [3.0], [3.0]),
    ],
)
def test_kinds_of_actions(found, ours, action, expected):
    spec, convert = action_spec(found, clip=True)
    assert isinstance(spec, ours)
    assert spec.is_in(torch.as_tensor(action, dtype=spec.dtype))
    converted = convert(torch.as_tensor(action, dtype=spec.dtype))
    assert converted.tolist() == expected
    assert found.is_in(converted)


def test_the_one_action_may_have_a_nested_key():
    played = []
    for name in ("nested", "Corridor"):
        module = __name__ if name == "nested" else Corridor.__module__
        env = make_env(f"{module}:{name}", 2, seed=0)
        assert isinstance(env.action_spec, Categorical)
        torch.manual_seed(0)
        played.append(env.rollout(9, break_when_any_done=False))
    assert_close(*played)


def test_text_is_left_out():
    specs = Composite(note=NonTensor(shape=()), place=Categorical(3))
    with pytest.warns(
        UserWarning, match=r"'note' \(NonTensor\(shape=\[\].*\) is left out.*--observ.* place"
    ):
        assert TensorReader(specs).spec.shape == (1,)
    with pytest.raises(ValueError, match="not supported: 'note'"):
        TensorReader(Composite(note=NonTensor(shape=())))
    place = Categorical(3)
    with pytest.raises(ValueError, match='two observations with the name "place"'):
        TensorReader(Composite(place=place, observation=Composite(place=place)))


@pytest.mark.parametrize(
    ("name", "settings", "kind", "words"),
    [
        ("batched", {}, ValueError, r"batch size \[2\]; expected an environment without batch"),
        ("crowd", {}, ValueError, "several rewards in a step; expected one number"),
        ("two_hands", {}, ValueError, r"actions \['left', 'right'\]; expected one"),
        ("not_an_env", {}, ValueError, "must make a TorchRL EnvBase, but made a str"),
        ("cart_pole", {"speed": 3}, ValueError, "cannot be made: TypeError: .*'speed'"),
        ("cart_pole", {"mask_actions": True}, ValueError, 'observation "action_mask": leave out'),
        ("masked", {"observation_keys": ["up"]}, ValueError,
         "no observation 'up', .* only pixels, place"),
        ("cart_pole", {"wrappers": ["gymnasium.wrappers:ClipAction"]}, ValueError,
         "takes TorchRL transforms and no gymnasium.Wrapper"),
        ("CORRIDOR", {}, ValueError, "neither registers 'CORRIDOR' .* nor has a class or function"),
        ("nothing", {}, ValueError, "neither registers 'nothing' with Gymnasium"),
        ("TensorReader", {}, ValueError, "neither registers 'TensorReader' .* makes a TorchRL Env"),
    ],
)  # fmt: skip
def test_one_line_says_what_is_wrong(name, settings, kind, words):
    with pytest.raises(kind, match=words) as caught:
        make_env(f"{__name__}:{name}", **settings)
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"UnboundedDiscrete.* are not supported, only floats"):
        action_spec(Unbounded((2,), dtype=torch.int64), clip=True)

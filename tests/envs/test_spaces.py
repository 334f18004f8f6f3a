"""Every space is written in its kind, with the values that the task returned."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, Graph, MultiBinary, MultiDiscrete, Sequence, Text
from gymnasium.spaces import Tuple as TupleSpace
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FilterObservation
from torchrl.data import Binary, Categorical, MultiCategorical, Unbounded
from torchrl.envs import Compose, GymWrapper, InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import set_recurrent_mode

from tests.envs.tasks import Echo, Robot
from tests.transforms.streams import assert_histories
from torchrl_tit.envs import GymVectorEnv, make_env, observation_keys, observation_specs
from torchrl_tit.envs.actions import box_action_spec
from torchrl_tit.envs.spaces import ObservationReader
from torchrl_tit.modules import Backbone, history_keys
from torchrl_tit.networks import build_network
from torchrl_tit.settings.networks import enhanced_tit
from torchrl_tit.transforms import History

ROBOT = "tests.envs.tasks:Robot-v0"
NAMES = ["arm/gear", "arm/joint_angles", "camera", "contacts", "wheels"]


def kinds(env):
    """Kind, shape and dtype of each observation, or the sizes of categories."""
    specs = observation_specs(env)
    several = specs if isinstance(specs, dict) else {"": specs}
    found: dict[str, Any] = {}
    for name, spec in several.items():
        if isinstance(spec, MultiCategorical):
            assert spec.dtype is torch.int64
            found[name] = torch.as_tensor(spec.nvec).tolist()
        else:
            assert isinstance(spec, Unbounded)
            found[name] = (tuple(spec.shape), str(spec.dtype).removeprefix("torch."))
    return found if isinstance(specs, dict) else found[""]


def echo(actions=None, observations=None, copies=2, **settings):
    tasks = [lambda: Echo(actions or Discrete(2), observations)] * copies
    return GymVectorEnv(SyncVectorEnv(tasks, autoreset_mode=AutoresetMode.DISABLED), **settings)


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (Box(-1, 1, ()), ((1,), "float32")),
        (Box(-1, 1, (2, 3), np.float64), ((2, 3), "float32")),
        (Box(0, 9, (3,), np.int32), ((3,), "float32")),
        (
            Box(0, 1, (3,), np.bool_),  # type: ignore[arg-type]
            ((3,), "float32"),
        ),
        (Box(0, 255, (128,), np.uint8), ((128,), "uint8")),
        (Box(0, 255, (9, 8, 3), np.uint8), ((3, 9, 8), "uint8")),
        (Box(0, 255, (2, 9, 8), np.uint8), ((2, 9, 8), "uint8")),
        (Discrete(5, start=-2), [5]),
        (MultiDiscrete(np.array([[2, 3], [4, 5]]), start=np.array([[1, 0], [0, 7]])), [2, 3, 4, 5]),
        (MultiBinary((2, 2)), [2, 2, 2, 2]),
        (Dict({"only": Discrete(3)}), [3]),
        (
            TupleSpace([Discrete(2), Dict({"b": Box(0, 1, (2,)), "a": Discrete(3)})]),
            {"0": [2], "1/a": [3], "1/b": ((2,), "float32")},
        ),
    ],
)
def test_kinds_of_observations(space, expected):
    env = echo(observations=space)
    assert kinds(env) == expected
    check_env_specs(env)


def test_values_are_those_of_gym_wrapper():
    # Of TorchRL's wrapper: the same tasks, seeds and actions.
    with pytest.warns(UserWarning, match="'speech' .* left out"):
        ours = make_env(ROBOT, 3, seed=5, num_frames=2)
    read = ["arm", "camera", "contacts", "wheels"]
    tasks = SyncVectorEnv(
        [lambda: FilterObservation(Robot(), read)] * 3, autoreset_mode=AutoresetMode.DISABLED
    )
    theirs = GymWrapper(tasks, categorical_action_encoding=True)
    theirs.set_seed(5)
    root, expected = ours.reset(), theirs.reset()
    ended = 0
    for _ in range(25):
        seen, arm = root["observation"], expected["arm"]
        assert list(seen.keys()) == NAMES
        gear = arm["gear"]
        assert torch.equal(seen["arm/gear"], gear.reshape(3, 1) - 1)
        assert torch.equal(seen["arm/joint_angles"], arm["joint.angles"])
        assert torch.equal(seen["camera"], expected["camera"].movedim(-1, -3))
        assert torch.equal(seen["contacts"], expected["contacts"].long())
        assert torch.equal(seen["wheels"], expected["wheels"] - torch.tensor([0, -2]))
        action = ours.rand_action(root)["action"]
        step, root = ours.step_and_maybe_reset(root)
        action = action + torch.tensor([0, -1])  # it passes actions on as they are
        other, expected = theirs.step_and_maybe_reset(expected.set("action", action))
        assert torch.equal(step["next", "reward"], other["next", "reward"].float())
        assert torch.equal(step["next", "done"], other["next", "done"])
        ended += int(step["next", "done"].sum())
    assert ended > 3


@pytest.mark.filterwarnings("ignore:The observation 'speech'")
@pytest.mark.parametrize("padding", ["same", "constant"])
def test_histories_of_each_observation(padding):
    env = make_env(ROBOT, 3, seed=0, num_frames=3, padding=padding)
    check_env_specs(env)
    for name in NAMES:
        assert_histories(env, 3, padding, 12, ("observation", name), ("history", name))


@pytest.mark.parametrize(
    ("actions", "spec", "shape"),
    [
        (Discrete(3, start=-1), Categorical, ()),
        (MultiDiscrete([2, 3], start=[5, -1]), MultiCategorical, (2,)),
        (MultiDiscrete(np.array([[2], [3]])), MultiCategorical, (2,)),
        (MultiBinary(3), Binary, (3,)),
        (MultiBinary((2, 2)), Binary, (4,)),
        (Box(-1, 1, (2, 3)), Unbounded, (6,)),
        (Box(-1, 1, ()), Unbounded, (1,)),
        (Box(0, 5, (2,), np.int32), Unbounded, (2,)),
    ],
)
def test_kinds_of_actions(actions, spec, shape):
    env = echo(actions)
    assert isinstance(env.action_spec, spec)
    assert env.action_spec_unbatched.shape == shape
    check_env_specs(env)
    root = env.rand_action(env.reset())
    total = root["action"].flatten(1).sum(1) if shape else root["action"]
    if spec is not Unbounded:
        start = getattr(actions, "start", None)
        expected = total + (0 if start is None else int(np.sum(start)))
        assert torch.equal(env.step(root)["next", "reward"].flatten(), expected.float())


def test_boxes_of_any_order_are_clipped_and_restored():
    low = np.array([[-1, -2, -3], [-1, -1, -1]], np.float32)
    env = echo(Box(low, -low))
    root = env.reset().set("action", torch.full((2, 6), -2.0))
    assert env.step(root)["next", "reward"].flatten().tolist() == [-8, -8]
    bounded = echo(Box(low, -low), clip_actions=False).action_spec_unbatched
    assert bounded.space.low.tolist() == low.flatten().tolist()


@pytest.mark.parametrize("clip", [True, False])
@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int32, np.int64, np.uint64])
def test_integers_are_clipped_before_they_could_wrap(dtype, clip):
    limits = np.iinfo(dtype)
    for low, high in ((limits.min, limits.max), (0, 5)):
        env = echo(Box(low, high, (3,), dtype), clip_actions=clip)
        actions = torch.tensor([[1e20, 2.6, 2.6], [-1e20, -torch.inf, 2.6]])
        env.step(env.reset().set("action", actions))  # the task refuses what is not in its space
        assert env.action_writer(actions).tolist() == [[high, 3, 3], [low, low, 3]]


@pytest.mark.parametrize("clip", [True, False])
def test_bounds_are_rounded_inwards(clip):
    env = echo(Box(0.1, 0.3, (2,), np.float64), clip_actions=clip)
    bounds = [torch.full((2, 2), x) for x in (-7.0, 7.0)]
    if not clip:
        spec = env.action_spec.space
        bounds = [spec.low, spec.high]
        torch.testing.assert_close(bounds, [torch.full((2, 2), 0.1), torch.full((2, 2), 0.3)])
    for action in bounds:  # the task refuses what is not in its space
        env.step(env.reset().set("action", action))
    limits = (np.array([-1e300, 0.3]), np.array([1e300, 0.3]))
    space = box_action_spec(*limits, clip=False).space
    largest = torch.finfo(torch.float32).max
    torch.testing.assert_close(space.low, torch.tensor([-largest, 0.3]))
    torch.testing.assert_close(space.high, torch.tensor([largest, 0.3]))
    assert (space.low <= space.high).all()


@pytest.mark.parametrize("dtype", [np.int64, np.float32])
@pytest.mark.parametrize("clip", [True, False])
def test_an_action_that_is_not_a_number_is_refused(dtype, clip):
    env = echo(Box(0, 9, (2,), dtype), clip_actions=clip)
    root = env.reset().set("action", torch.tensor([[1.0, 2.0], [3.0, torch.nan]]))
    with pytest.raises(ValueError, match=r"^the action \[3.0, nan\] is not a number: [^\n]*$"):
        env.step(root)


def test_masks_in_info():
    env = make_env("Taxi-v4", 2, seed=0, mask_actions=True)
    task: Any = gymnasium.make("Taxi-v4").unwrapped
    root = env.reset()
    for _ in range(3):
        for state, mask in zip(root["observation"], root["action_mask"], strict=True):
            assert mask.tolist() == task.action_mask(state.item()).astype(bool).tolist()
        _, root = env.step_and_maybe_reset(env.rand_action(root))
    # What is not reset keeps its mask.
    before = root["action_mask"].clone()
    root["_reset"] = torch.tensor([[True], [False]])
    after = env.base_env.reset(root)
    assert torch.equal(after["action_mask"][1], before[1])
    assert (
        after["action_mask"][0].tolist()
        == task.action_mask(after["observation"][0].item()).astype(bool).tolist()
    )
    env.close()


@pytest.mark.filterwarnings("ignore:The observation 'speech'")
def test_masks_of_several_actions():
    env = make_env(ROBOT, 2, seed=0, mask_actions=True)
    rollout = env.rollout(12, break_when_any_done=False)
    masks = rollout["action_mask"]
    assert masks.shape == (2, 12, 5)
    assert masks[..., 0].all()
    assert not masks[..., 4].any()
    assert 0 < masks[..., 1].float().mean() < 1
    first, second = (action.unsqueeze(-1) for action in rollout["action"].unbind(-1))
    assert masks[..., :2].gather(-1, first).all()  # random actions are allowed ones
    assert masks[..., 2:].gather(-1, second).all()


class Mask(MultiBinary):
    """Masks by chance, which always allow the first action."""

    def sample(self, mask=None, probability=None):
        drawn = super().sample()
        drawn[0] = True
        return drawn


def test_masks_among_observations():
    space = Dict({"action_mask": Mask(3), "place": Discrete(4)})
    env = echo(Discrete(3), space, mask_actions=True)
    assert kinds(env) == [4]
    check_env_specs(env)
    assert env.reset()["action_mask"].shape == (2, 3)
    parts = TupleSpace([Mask(2), Mask(3)])
    env = echo(MultiDiscrete([2, 3]), Dict(action_mask=parts, at=Discrete(4)), mask_actions=True)
    assert env.reset()["action_mask"].shape == (2, 5)
    # Otherwise it is an observation as any other.
    assert kinds(echo(Discrete(3), space)) == {"action_mask": [2, 2, 2], "place": [4]}


class Blocked(gymnasium.Env):
    """Blocks all its motors at its third step."""

    observation_space = Box(-9, 9, (2,))
    action_space = MultiDiscrete([2, 3])

    def __init__(self, length: int) -> None:
        self.length, self.steps = length, 0

    def _observe(self) -> tuple[Any, dict[str, Any]]:
        mask = np.full(2, True), np.full(3, self.steps != 3)
        return np.zeros(2, np.float32), {"action_mask": mask}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._observe()

    def step(self, action):
        self.steps += 1
        observation, info = self._observe()
        return observation, 1.0, self.steps >= self.length, False, info


def test_a_mask_may_allow_nothing_only_at_the_end():
    for length in (3, 5):
        tasks = [lambda length=length: Blocked(length)] * 2
        vector = SyncVectorEnv(tasks, autoreset_mode=AutoresetMode.DISABLED)
        env = GymVectorEnv(vector, mask_actions=True)
        if length == 3:
            assert env.rollout(7, break_when_any_done=False)["next", "done"].sum() == 4
            continue
        with pytest.raises(ValueError, match=r"allows no action, though the episode goes on"):
            env.rollout(7, break_when_any_done=False)


def test_chosen_observations():
    env = make_env(ROBOT, 2, observation_keys=["camera"])
    assert kinds(env) == ((3, 5, 6), "uint8")
    assert observation_keys(env) == ["observation"]
    assert env.reset()["history"].shape == (2, 1, 3, 5, 6)
    env = make_env(ROBOT, 1, observation_keys=["wheels", "arm"])
    assert list(kinds(env)) == ["arm/gear", "arm/joint_angles", "wheels"]


def test_layouts():
    image = Box(0, 255, (3, 8, 3), np.uint8)
    assert ObservationReader(image, image_layout="HWC").spec.shape == (3, 3, 8)
    assert ObservationReader(image, image_layout="CHW").spec.shape == (3, 8, 3)
    pixels = np.arange(5 * 6 * 3).reshape(1, 5, 6, 3).astype(np.uint8)
    read = ObservationReader(Box(0, 255, (5, 6, 3), np.uint8))(pixels)
    np.testing.assert_array_equal(read, pixels.transpose(0, 3, 1, 2))
    assert not np.shares_memory(read, pixels)


BIG = Box(0, 255, (9, 8, 7), np.uint8)
MIXED = Dict({"pose": Box(-1, 1, (2,)), "speech": Text(3)})


@pytest.mark.parametrize(
    ("space", "settings", "kind", "words"),
    [
        (BIG, {}, ValueError, r"\[9, 8, 7\].*`--image-layout HWC` or `--image-layout CHW`"),
        (Box(0, 1, (2, 9, 4)), {}, ValueError, "not clear whether its channels"),
        (Box(0, 1, (2, 9, 4)), {"image_layout": "WHC"}, ValueError, "'WHC', not one of .*'HWC'"),
        (Box(0, 1, (2, 3, 4, 5)), {}, ValueError, "at most 3 dimensions.*FlattenObservation"),
        (Text(5), {}, ValueError, r"not supported: 'observation' \(Text\(.*Supported are Box"),
        (Sequence(Discrete(2)), {}, ValueError, "not supported: 'observation'.*Sequence"),
        (Graph(Box(0, 1, (2,)), None), {}, ValueError, "not supported: 'observation'.*Graph"),
        (Dict({}), {}, ValueError, "none at all"),
        (MIXED, {"keys": ["speech"]}, ValueError, "not supported: 'speech'"),
        (MIXED, {"keys": ["pos"]}, ValueError, "no observation 'pos'.* only pose, speech"),
        (Dict({"a.b": Discrete(2), "a_b": Discrete(3)}), {}, ValueError, 'two .*"a_b".*rename'),
        (
            Dict({"a/b": Discrete(2), "a": Dict({"b": Discrete(3)})}),
            {"keys": ["a/b"]},
            ValueError,
            'two observations with the name "a/b"',
        ),
    ],
)
def test_observations_that_cannot_be_read(space, settings, kind, words):
    with pytest.raises(kind, match=words) as caught:
        ObservationReader(space, **settings)
    assert "\n" not in str(caught.value)


def test_actions_and_masks_that_are_not_supported():
    with pytest.raises(ValueError, match=r"Actions of the kind Dict\(.*not supported, only Disc"):
        echo(Dict({"a": Discrete(2)}))
    with pytest.raises(ValueError, match=r"no mask of its actions.*leave out mask_actions"):
        echo(mask_actions=True)
    with pytest.raises(ValueError, match="Only Discrete and MultiDiscrete actions can be masked"):
        echo(Box(-1, 1), mask_actions=True)
    with pytest.raises(ValueError, match='"action_mask" has 4 entries, but there are 3 actions'):
        echo(Discrete(3), Dict(action_mask=MultiBinary(4), at=Discrete(2)), mask_actions=True)


def test_a_reward_that_is_an_array():
    class Payer(Echo):
        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, np.ones(1), *rest

    tasks = [lambda: Payer(Discrete(2))]
    env = GymVectorEnv(SyncVectorEnv(tasks, autoreset_mode=AutoresetMode.DISABLED))
    with pytest.raises(ValueError, match="returns an array as its reward: return a float"):
        env.rollout(1)


class Arm(gymnasium.Env):
    """A camera, a place, and a nested entry."""

    action_space = Discrete(2)
    observation_space = Dict(
        camera=Box(0, 255, (3, 12, 12), np.uint8),
        arm=Dict(left=Box(-1, 1, (2,))),
        place=Box(-1, 1, (3,)),
    )

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self.observation_space.sample(), 1.0, self.steps == 7, False, {}


def test_torchrls_own_environments_with_several_observations() -> None:
    keys = ["camera", "place", ("arm", "left")]
    env = TransformedEnv(GymWrapper(Arm()), Compose(InitTracker(), History(4, in_keys=keys)))
    specs = observation_specs(env)
    assert isinstance(specs, dict)
    shapes = {name: tuple(spec.shape) for name, spec in specs.items()}
    assert shapes == {"camera": (3, 12, 12), "place": (3,), "arm/left": (2,)}
    assert observation_keys(env) == keys
    network = build_network(enhanced_tit(4), specs)
    backbone = Backbone(network, history_keys(specs), observation_keys=keys)
    steps = env.rollout(12, break_when_any_done=False)
    expected = backbone(steps.clone())["features"]
    with set_recurrent_mode(True):
        torch.testing.assert_close(backbone(steps)["features"], expected, rtol=1e-4, atol=1e-5)


def test_what_an_environment_lacks_is_said_in_one_line() -> None:
    env = GymWrapper(Arm())
    with pytest.raises(ValueError, match=r"no 'observation' .* only .*camera, place: add History"):
        observation_specs(env)
    pixels = History(2, in_keys=["camera"])
    spec: Any = observation_specs(TransformedEnv(env, pixels))
    assert spec.shape == (3, 12, 12)
    odd = History(2, in_keys=["camera", "place"], out_keys=["a", "b"])
    with pytest.raises(ValueError, match=r"\['a', 'b'\] have no names: call them"):
        observation_specs(TransformedEnv(env, odd))

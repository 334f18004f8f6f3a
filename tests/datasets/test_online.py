"""A storage of collected steps keeps each frame once, and its histories are the environment's."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.utils._pytree import tree_leaves
from torchrl.data import ReplayBuffer
from torchrl.envs import TransformedEnv

from tests.datasets.rollouts import Transitions
from tests.transforms.streams import StreamEnv
from torchrl_tit.datasets import (
    ConsecutiveSampler,
    HistoryStorage,
    OnlineHistoryStorage,
    episodes_from_arrays,
    keep_batch,
)
from torchrl_tit.transforms import History

ENVS, STEPS = 3, 60


def play(num_frames: int, padding: Any = "same", seed: int = 0) -> TensorDictBase:
    """Steps [envs, time] of images with histories; most episodes are shorter than four steps."""
    env = StreamEnv((ENVS,), (6, 5), torch.uint8, seed=seed)
    history = History(num_frames, observation_ndim=2, padding=padding)
    return TransformedEnv(env, history).rollout(STEPS, break_when_any_done=False)


def store(storage: OnlineHistoryStorage, steps: TensorDictBase, sizes: list[int]) -> None:
    """Adds steps [envs, time] in batches of these numbers of steps."""
    for batch in steps.exclude("history", ("next", "history")).split(sizes, dim=1):
        storage.set(range(0), batch.transpose(0, 1).reshape(-1))


def flat(steps: TensorDictBase) -> TensorDictBase:
    """[envs, time] -> [time * envs], as stored."""
    return steps.transpose(0, 1).reshape(-1)


def assert_items(items: TensorDictBase, expected: TensorDictBase) -> None:
    assert set(items.keys()) == {"observation", "history", "action", "next"}
    assert {"history", "observation", "reward", "done"} <= set(items["next"].keys())
    for key in items.keys(True, True):
        assert torch.equal(items[key], expected[key]), key


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_frames", [1, 2, 4, 20])
def test_items_are_those_of_the_environment(num_frames: int, padding: Any) -> None:
    steps = play(num_frames, padding)
    storage = OnlineHistoryStorage(500, num_frames, num_envs=ENVS, padding=padding)
    store(storage, steps, [1, 7, 30, 22])
    assert len(storage) == ENVS * STEPS
    assert_items(storage[:], flat(steps))
    index = torch.tensor([[0, 17, -1], [100, 3, 44]])
    assert_items(storage[index], flat(steps)[index])
    assert_items(storage[5], flat(steps)[5])


def test_each_frame_is_kept_once() -> None:
    steps = play(8)
    storage = OnlineHistoryStorage(ENVS * STEPS, 8, num_envs=ENVS)
    store(storage, steps, [20, 20, 20])
    ends = int(steps["next", "done"].sum())
    assert storage.num_episode_ends == ends > 20
    images = [x for x in tree_leaves(storage.state_dict()) if x.dtype == torch.uint8]
    assert sum(len(x) for x in images) == ENVS * STEPS + ends + ENVS


def test_an_environment_that_was_reset_in_between_starts_anew() -> None:
    first, second = play(4, seed=0), play(4, seed=1)
    first["next", "done"][:, -1] = False  # cut off without a flag
    first["next", "terminated"][:, -1] = False
    storage = OnlineHistoryStorage(1000, 4, num_envs=ENVS, is_init=True)
    store(storage, first, [STEPS])
    before = storage.num_episode_ends
    store(storage, second, [30, 30])
    assert_items(
        storage[:].exclude("is_init", ("next", "is_init")), flat(torch.cat([first, second], 1))
    )
    assert storage.num_episode_ends == before + ENVS + int(second["next", "done"].sum())
    starts = storage[:]["is_init"].view(-1, ENVS)
    assert starts[0].all()
    assert starts[STEPS].all()


def test_an_episode_begins_where_is_init_says_so() -> None:
    frames = torch.zeros(6, 2)  # that look as if they went on, and are not equal to themselves
    frames[:, 1] = torch.nan
    flag = torch.zeros(6, 1, dtype=torch.bool)
    outcome = {"observation": frames, "reward": torch.ones(6, 1), "terminated": flag, "done": flag}
    steps = TensorDict({"observation": frames, "action": torch.arange(6), "next": outcome}, [6])
    begins = flag.clone()
    begins[4] = True
    for is_init, starts in ((None, [0]), (begins, [0, 4])):
        storage = OnlineHistoryStorage(6, 3, is_init=True)
        given = steps if is_init is None else steps.copy().set("is_init", is_init)
        storage.set(range(0), given[:3])
        storage.set(range(0), given[3:])
        assert storage[:]["is_init"].flatten().nonzero().flatten().tolist() == starts
        assert storage.num_episode_ends == len(starts) - 1


@pytest.mark.parametrize("padding", ["same", "constant"])
def test_the_next_history_is_always_the_history_moved_by_one(
    rolled: Transitions, padding: Any
) -> None:
    """Also at ends of episodes, and if terminal observations are zeros."""
    online = OnlineHistoryStorage(500, 4, num_envs=ENVS, padding=padding)
    store(online, play(4, padding), [60])
    episodes = episodes_from_arrays(**rolled)
    for storage in (
        online,
        HistoryStorage(episodes, 4, padding=padding),
        HistoryStorage(episodes, 4, padding=padding, terminal_observations="zero"),
        HistoryStorage(episodes, 4, padding=padding, time_limits="drop"),
    ):
        items = storage[:]
        assert items["next", "terminated"].any()
        assert torch.equal(items["next", "history"][:, :-1], items["history"][:, 1:])
        assert torch.equal(items["next", "history"][:, -1], items["next", "observation"])
        assert torch.equal(items["history"][:, -1], items["observation"])


def test_parts_restore_everything() -> None:
    """Saved piece by piece, the second piece after a reset that no flag shows."""
    first, second = play(4, seed=0), play(4, seed=1)
    first["next", "done"][:, -1] = False
    whole, restored = (OnlineHistoryStorage(2000, 4, num_envs=ENVS) for _ in range(2))
    saved = (0, 0)
    for steps in (first, second, play(4, seed=2)):
        store(whole, steps, [25, 35])
        restored.add_part(whole.part(*saved))
        saved = (len(whole), whole.num_episode_ends)
        assert (len(restored), restored.num_episode_ends) == saved
    assert whole.part(*saved) == {}
    more = play(4, seed=3)
    for storage in (whole, restored):
        store(storage, more, [STEPS])
    assert (restored[:] == whole[:]).all()
    again = OnlineHistoryStorage(2000, 4, num_envs=ENVS)
    again.load_state_dict(whole.state_dict())
    assert (again[:] == whole[:]).all()


def make_buffer(slice_length: int) -> ReplayBuffer:
    storage = OnlineHistoryStorage(1000, 4, num_envs=ENVS, is_init=True)
    sampler = ConsecutiveSampler(slice_length)
    buffer = ReplayBuffer(
        storage=storage, sampler=sampler, collate_fn=keep_batch, batch_size=12, generator=None
    )
    buffer.extend(flat(play(4)))
    return buffer


def test_a_buffer_draws_from_it() -> None:
    storage = OnlineHistoryStorage(1000, 4, num_envs=ENVS)
    buffer = ReplayBuffer(storage=storage, collate_fn=keep_batch, batch_size=5000)
    buffer.extend(flat(play(4)[:, :20]))
    steps = play(4)[:, :20]
    drawn = buffer.sample()["next", "reward"].mean()
    assert drawn.item() == pytest.approx(steps["next", "reward"].mean().item(), abs=0.05)
    restored = OnlineHistoryStorage(1000, 4, num_envs=ENVS)
    other = ReplayBuffer(storage=restored, collate_fn=keep_batch, batch_size=5000)
    other.load_state_dict(buffer.state_dict())
    assert (other[:] == buffer[:]).all()
    buffer.empty()
    assert len(buffer) == 0


def test_slices_are_consecutive_steps_of_an_environment() -> None:
    buffer = make_buffer(4)
    for _ in range(20):
        batch = buffer.sample()
        assert batch.batch_size == (3, 4)
        goes_on = ~batch["is_init"][:, 1:, 0]
        assert torch.equal(goes_on, ~batch["next", "done"][:, :-1, 0])
        assert torch.equal(batch["next", "is_init"], batch["is_init"])
        before, after = batch["next", "history"][:, :-1], batch["history"][:, 1:]
        assert torch.equal(before[goes_on], after[goes_on])


def counts(sampler: ConsecutiveSampler, storage: Any) -> Tensor:
    index, _ = sampler.sample(storage, 40_000)
    return index.flatten().bincount(minlength=len(storage))


def test_slices_draw_every_transition_equally(rolled: Transitions) -> None:
    """The ends of episodes too; only the first and last steps of all are drawn less often."""
    storage = HistoryStorage(episodes_from_arrays(**rolled), 2)
    drawn = counts(ConsecutiveSampler(4), storage)
    expected = 40_000 / (len(storage) - 3)
    assert ((drawn[3:-3] - expected).abs() < 6 * (4 * expected) ** 0.5).all()
    assert drawn[0] > 0
    assert drawn[-1] > 0


def test_what_is_refused() -> None:
    storage = OnlineHistoryStorage(30, 2, num_envs=ENVS)
    steps = flat(play(2))
    with pytest.raises(ValueError, match="4 steps cannot be those of 3 environments"):
        storage.set(range(0), steps[:4])
    storage.set(range(0), steps[:27])
    with pytest.raises(RuntimeError, match="room for 30 steps, but not for 33"):
        storage.set(range(0), steps[27:33])
    with pytest.raises(RuntimeError, match="cannot be changed"):
        storage[0] = steps[0]
    for wrong in (27, -28):
        with pytest.raises(IndexError, match="There are 27 items"):
            storage[wrong]
    assert storage.contains([0, 26, 27]).tolist() == [True, True, False]
    for settings, message in (
        ({"num_frames": 0}, "num_frames must be at least 1"),
        ({"num_envs": 0}, "num_envs must be at least 1"),
        ({"padding": "zeros"}, "padding must be one of"),
    ):
        with pytest.raises(ValueError, match=message):
            OnlineHistoryStorage(30, **settings)
    with pytest.raises(ValueError, match="slice_length must be at least 1, but is 0"):
        ConsecutiveSampler(0)
    with pytest.raises(ValueError, match="12 steps cannot be divided into slices of 5"):
        ConsecutiveSampler(5).sample(storage, 12)
    with pytest.raises(ValueError, match="9 consecutive steps, which is less than a slice of 10"):
        ConsecutiveSampler(10).sample(storage, 20)

"""SequenceHistory writes in an environment what SequenceStorage cuts out of the stored episodes."""

import pytest
import torch
from torchrl.envs import Compose, GymEnv, TargetReturn, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.transforms.streams import StreamEnv
from torchrl_tit.envs import make_env
from torchrl_tit.transforms import SequenceHistory


def add_history(env, num_frames, target=100.0, scale=10.0):
    history = SequenceHistory(num_frames, return_scale=scale)
    return TransformedEnv(env, Compose(TargetReturn(target), history))


def reference(steps, num_frames, target, scale):
    """The sequences of one environment's steps [T], one step after the other."""
    episode: list[tuple] = []
    sequences = []
    for step in steps.unbind(0):
        to_go = target - sum(reward for *_, reward in episode)
        actions = [action for _, action, _, _ in episode]
        rows = [(o, a, g) for (o, _, g, _), a in zip(episode, actions, strict=True)]
        rows.append((step["observation"], torch.zeros_like(step["action"]), to_go / scale))
        first = max(0, len(rows) - num_frames)
        rows = rows[first:]
        missing = num_frames - len(rows)
        observations = [torch.zeros_like(rows[0][0])] * missing + [o for o, _, _ in rows]
        taken = [torch.zeros_like(rows[0][1])] * missing + [a for _, a, _ in rows]
        sequences.append(
            {
                "observation": torch.stack(observations),
                "action": torch.stack(taken),
                "return_to_go": torch.tensor([0.0] * missing + [float(g) for *_, g in rows]),
                "timestep": torch.tensor([0] * missing + list(range(first, first + len(rows)))),
                "mask": torch.tensor([False] * missing + [True] * len(rows)),
            }
        )
        reward = step["next", "reward"].item()
        episode.append((step["observation"], step["action"], to_go / scale, reward))
        if step["next", "done"].item():
            episode = []
    return sequences


@pytest.mark.parametrize("num_frames", [1, 2, 5])
@pytest.mark.parametrize("task", ["CartPole-v1", "Hopper-v5"])
def test_equals_the_plain_reference(task, num_frames):
    env = add_history(make_env(task, 3, seed=0), num_frames)
    torch.manual_seed(0)
    steps = env.rollout(60, break_when_any_done=False)
    assert (steps["next", "done"].sum(1) > 1).all()  # environments are reset one by one
    for one in steps.unbind(0):
        for t, expected in enumerate(reference(one, num_frames, 100.0, 10.0)):
            for name, value in expected.items():
                actual = one["sequence", name][t]
                actual = actual.squeeze(-1) if name == "return_to_go" else actual
                torch.testing.assert_close(actual, value, rtol=1e-5, atol=1e-5)


def test_what_follows_a_step_holds_the_next_observation():
    env = add_history(make_env("Hopper-v5", 2, seed=0), 4)
    steps = env.rollout(40, break_when_any_done=False)
    assert steps["next", "done"].any()  # there it is the observation that the episode ended in
    following = steps["next", "sequence"]
    assert torch.equal(following["observation"][..., -1, :], steps["next", "observation"])
    assert torch.equal(following["action"][..., -2, :], steps["action"])
    assert torch.equal(following["timestep"][..., -1], steps["sequence", "timestep"][..., -1] + 1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_env("CartPole-v1", 3),
        lambda: make_env("Hopper-v5", 1, clip_actions=False),
        lambda: GymEnv("CartPole-v1"),  # one-hot actions, no batch
        lambda: StreamEnv([3], shape=(2, 4, 5), dtype=torch.uint8),
    ],
)
def test_specs_say_what_is_written(make):
    env = add_history(make(), 3)
    check_env_specs(env)
    before = env.observation_spec["observation"]
    written = env.reset()["sequence", "observation"]
    assert written.dtype == before.dtype
    assert written.shape == (*env.batch_size, 3, *before.shape[len(env.batch_size) :])


@pytest.mark.parametrize("ask", ["observation_spec", "reset"])
@pytest.mark.parametrize("late", [False, True])
def test_a_target_is_needed(ask, late):
    transforms = [SequenceHistory(3), TargetReturn(1.0)] if late else [SequenceHistory(3)]
    env = TransformedEnv(make_env("CartPole-v1"), Compose(*transforms))
    with pytest.raises(
        KeyError, match=r"no 'target_return'.*put TorchRL's TargetReturn before Seq"
    ):
        env.observation_spec if ask == "observation_spec" else env.reset()


def test_an_action_of_another_shape_is_refused():
    env = add_history(GymEnv("CartPole-v1"), 3)  # which takes one-hot actions
    with pytest.raises(
        ValueError, match=r"action of shape \[\], but the environment takes \[2\].*one-hot"
    ):
        env.rollout(3, lambda td: td.set("action", torch.tensor(1)))

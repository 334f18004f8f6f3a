"""Decision Transformer as TensorDictModules: training, acting, and what is kept while acting."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, GymEnv, TargetReturn, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.networks.reference import randomize
from tests.transforms.streams import StreamEnv
from torchrl_tit.envs import make_env
from torchrl_tit.evaluation import evaluate
from torchrl_tit.modules import SequenceBackbone, acting, make_dt_actor, make_dt_predictor
from torchrl_tit.networks import DecisionTransformer
from torchrl_tit.transforms import SequenceHistory

SMALL: dict[str, Any] = {"embed_dim": 16, "num_heads": 2, "num_blocks": 2, "context": 5}


def make_network(shape=(11,), actions=3, seed=0, **settings):
    network = DecisionTransformer(shape, actions, **{**SMALL, **settings}).eval()
    randomize(network, seed)
    return network


def make_batch(shape=(11,), actions=3, *, kind="continuous", batch=4, steps=5):
    torch.manual_seed(0)
    mask = torch.arange(steps).expand(batch, steps) >= torch.arange(batch).unsqueeze(1) % steps
    observation = (
        torch.randint(0, 256, (batch, steps, *shape), dtype=torch.uint8)
        if len(shape) > 1
        else torch.randn(batch, steps, *shape)
    )
    if kind == "continuous":
        action = torch.rand(batch, steps, actions) * 2 - 1
        action[~mask] = -10
    else:
        action = torch.randint(actions, (batch, steps))
        if kind == "one-hot":
            action = torch.nn.functional.one_hot(action, actions)
        else:
            action[~mask] = -10
    return TensorDict(
        {
            "observation": observation,
            "action": action,
            "return_to_go": torch.rand(batch, steps, 1),
            "timestep": torch.arange(steps).expand(batch, steps).clone(),
            "mask": mask,
        },
        [batch],
    )


def make_environment(task="Hopper-v5", num_envs=3, context=5, **settings):
    history = SequenceHistory(context)
    env = make_env(task, num_envs, seed=0, **settings)
    return TransformedEnv(env, Compose(TargetReturn(3600.0), history))


@pytest.mark.parametrize("kind", ["continuous", "discrete", "one-hot"])
@pytest.mark.parametrize("shape", [(11,), (3, 8, 8)])
@pytest.mark.parametrize("encoder", ["linear", "inner_transformer"])
def test_acts_as_it_predicts(kind, shape, encoder):
    space = "continuous" if kind == "continuous" else "discrete"
    patch = {"patch_size": 4} if len(shape) > 1 and encoder != "linear" else {}
    network = make_network(shape, action_space=space, state_encoder=encoder, **patch)
    batch = make_batch(shape, kind=kind)
    predicted = make_dt_predictor(network)(batch.clone())["action"]
    assert predicted.shape == (4, 5, 3)
    actor = make_dt_actor(network, one_hot=kind == "one-hot")
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action = actor(TensorDict({"sequence": batch.clone()}, [4]))["action"]
    expected = predicted[:, -1]
    if kind == "discrete":
        assert action.dtype == torch.int64
        assert torch.equal(action, expected.argmax(-1))
    elif kind == "one-hot":
        assert torch.equal(action.int().argmax(-1), expected.argmax(-1))
        assert (action.sum(-1) == 1).all()
    else:
        torch.testing.assert_close(action, expected)


def test_indices_and_one_hot_vectors_are_the_same_actions():
    network = make_network(action_space="discrete")
    indices = make_batch(kind="discrete")
    vectors = indices.clone()
    vectors["action"] = torch.nn.functional.one_hot(indices["action"].clamp(min=0), 3)
    outputs = [make_dt_predictor(network)(batch)["action"] for batch in (indices, vectors)]
    torch.testing.assert_close(outputs[0][indices["mask"]], outputs[1][indices["mask"]])


def test_a_gaussian_policy_draws_or_takes_the_mean():
    network = make_network(action_space="gaussian")
    actor, td = make_dt_actor(network), TensorDict({"sequence": make_batch()}, [4])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        mean = actor(td.clone())
    torch.testing.assert_close(mean["action"], mean["loc"].tanh())
    with set_exploration_type(ExplorationType.RANDOM):
        drawn = [actor(td.clone())["action"] for _ in range(2)]
    assert not torch.equal(*drawn)
    assert all(x.abs().max() < 1 for x in drawn)
    every_step = make_dt_actor(network, group=None, newest=False)
    assert every_step.get_dist(make_batch()).batch_shape == (4, 5)


@pytest.mark.parametrize("encoder", ["linear", "inner_transformer"])
def test_acting_keeps_tokens_and_changes_nothing(encoder):
    network = make_network(state_encoder=encoder)
    actor = make_dt_actor(network)
    frames = []
    network.state_encoder.register_forward_pre_hook(
        lambda module, inputs: frames.append(inputs[0].shape[:-1].numel())
    )
    env = make_environment(max_episode_steps=7)
    torch.manual_seed(0)
    td, resets = env.reset(), 0
    with torch.no_grad(), acting(actor):
        for step in range(30):
            frames.clear()
            action = actor(td.clone())["action"]
            started = (td["sequence", "timestep"][:, -1] == 0).sum()
            if step:  # one observation each, and the padding of those that began anew
                assert sum(frames) <= len(td) + started
            expected = network(*(td["sequence", n] for n in NAMES))[:, -1]
            torch.testing.assert_close(action, expected, rtol=0, atol=1e-5)
            resets += int(started)
            _, td = env.step_and_maybe_reset(td.set("action", torch.rand(3, 3) * 2 - 1))
            if step == 20:  # weights change: nothing that was kept is of use
                randomize(network, seed=1)
    assert resets > 6


NAMES = ("observation", "action", "return_to_go", "timestep", "mask")


def test_what_is_kept_is_no_part_of_states_and_copies():
    actor = make_dt_actor(make_network())
    batch = TensorDict({"sequence": make_batch()}, [4])

    def kept():
        (backbone,) = (m for m in actor.modules() if isinstance(m, SequenceBackbone))
        return backbone._cache and backbone._cache._kept

    with torch.no_grad(), acting(actor):
        actor(batch.clone())
        assert kept()
        assert not any("cache" in name for name in actor.state_dict())
        assert not kept()
        copied = copy.deepcopy(actor)
    torch.testing.assert_close(copied(batch.clone())["action"], actor(batch.clone())["action"])
    assert not kept()


@pytest.mark.parametrize("task", ["Hopper-v5", "CartPole-v1"])
def test_works_in_a_collector(task):
    shape, actions = ((11,), 3) if task == "Hopper-v5" else ((4,), 2)
    space = "continuous" if task == "Hopper-v5" else "discrete"
    network = make_network(shape, actions, action_space=space)
    env = make_environment(task, max_episode_steps=6)
    actor = make_dt_actor(network)
    collector = Collector(
        env,
        actor,
        frames_per_batch=60,
        total_frames=120,
        exploration_type=ExplorationType.DETERMINISTIC,
        auto_register_policy_transforms=False,
    )
    with acting(actor):
        for batch in collector:
            sequence = batch["sequence"]
            predicted = network(*(as_network_input(sequence[n], n, space, actions) for n in NAMES))
            expected = predicted[..., -1, :]
            if space == "discrete":
                assert torch.equal(batch["action"], expected.argmax(-1))
            else:
                torch.testing.assert_close(batch["action"], expected, rtol=0, atol=1e-5)
    collector.shutdown()


def as_network_input(entry, name, space, actions):
    one_hot = name == "action" and space == "discrete"
    return torch.nn.functional.one_hot(entry, actions) if one_hot else entry


def test_one_hot_environment_without_a_batch():
    env = TransformedEnv(
        GymEnv("CartPole-v1"), Compose(TargetReturn(500.0), SequenceHistory(context=5))
    )
    actor = make_dt_actor(make_network((4,), 2, action_space="discrete"), one_hot=True)
    steps = env.rollout(10, actor)
    assert (steps["action"].sum(-1) == 1).all()


def test_images_and_integers_of_a_stream():
    env = StreamEnv([3], shape=(8, 8), dtype=torch.uint8)
    env = TransformedEnv(env, Compose(TargetReturn(5.0), SequenceHistory(5)))
    assert env.reset()["sequence", "observation"].dtype == torch.uint8


def test_evaluation_side_by_side_equals_one_after_another():
    actor = make_dt_actor(make_network())

    def make(num_envs):
        return make_environment(num_envs=num_envs, max_episode_steps=25)

    with acting(actor):
        together = evaluate(make, actor, 8, seed=3, shrink=True)
        apart = torch.cat([evaluate(make, actor, 1, seed=3 + i) for i in range(8)])
    assert together.unique().numel() == 8
    torch.testing.assert_close(together, apart, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("space", "kind", "message"),
    [
        (
            "continuous",
            "discrete",
            r"int64 are discrete, but .* continuous: set action_space='disc",
        ),
        (
            "discrete",
            "continuous",
            r"float32 are continuous, but .* discrete: set action_space='co",
        ),
        ("gaussian", "one-hot", r"int64 are discrete, but this network's are gaussian"),
    ],
)
def test_actions_of_the_other_kind_are_refused(space, kind, message):
    backbone = SequenceBackbone(make_network(action_space=space))
    with pytest.raises(TypeError, match=message):
        backbone(make_batch(kind=kind))


def test_a_missing_entry_is_named():
    with pytest.raises(KeyError, match=r"no sequence under .*'observation'.*add SequenceHistory"):
        make_dt_actor(make_network())(TensorDict({"observation": torch.zeros(2, 11)}, [2]))


def test_a_prediction_is_no_distribution():
    with pytest.raises(ValueError, match=r"gaussian, .*make_dt_actor.* on TorchRL's OnlineDTLoss"):
        make_dt_predictor(make_network(action_space="gaussian"))

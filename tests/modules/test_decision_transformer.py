"""Decision Transformer as TensorDictModules: training, acting, and the frames kept meanwhile."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TargetReturn, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit.envs import make_env
from torchrl_tit.evaluation import evaluate
from torchrl_tit.modules import (
    Backbone,
    DTHead,
    acting,
    make_dt_actor,
    make_dt_backbone,
    make_dt_predictor,
)
from torchrl_tit.networks import DTTIT, DecisionTransformer, EnhancedTIT
from torchrl_tit.transforms import SequenceHistory

pytestmark = pytest.mark.numerics

SMALL: dict[str, Any] = {"embed_dim": 16, "num_heads": 2, "num_blocks": 2, "num_frames": 5}
NAMES = ("observation", "action", "return_to_go", "timestep", "mask")


def make_network(
    shape=(11,), actions=3, seed=0, *, space="continuous", kind=DecisionTransformer, **settings
):
    """A network and its head."""
    network = kind(shape, action_dim=actions, **{**SMALL, **settings}).eval()
    randomize(network, seed)
    head = DTHead(network.features_dim, actions, space)
    randomize(head, seed)
    return network, head


def predict(network, head, sequence):
    """The newest step's action."""
    return head(network(*(sequence[name] for name in NAMES)))


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


def make_environment(task="Hopper-v5", num_envs=3, num_frames=5, **settings):
    history = SequenceHistory(num_frames)
    env = make_env(task, num_envs, seed=0, **settings)
    return TransformedEnv(env, Compose(TargetReturn(3600.0), history))


@pytest.mark.parametrize("kind", ["continuous", "discrete", "one-hot"])
@pytest.mark.parametrize("shape", [(11,), (3, 8, 8)])
@pytest.mark.parametrize("network_class", [DecisionTransformer, DTTIT])
def test_acts_as_it_predicts(kind, shape, network_class):
    space = "continuous" if kind == "continuous" else "discrete"
    patch = {"patch_size": 4} if len(shape) > 1 and network_class is DTTIT else {}
    network, head = make_network(shape, space=space, kind=network_class, **patch)
    batch = make_batch(shape, kind=kind)
    predicted = make_dt_predictor(network, head)(batch.clone())["action"]
    assert predicted.shape == (4, 5, 3)
    actor = make_dt_actor(network, head, one_hot=kind == "one-hot")
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
        torch.testing.assert_close(action, expected, rtol=1e-4, atol=1e-5)


def test_a_gaussian_policy_draws_or_takes_the_mean():
    network, head = make_network(space="gaussian")
    actor, td = make_dt_actor(network, head), TensorDict({"sequence": make_batch()}, [4])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        mean = actor(td.clone())
    assert_near(mean["action"], mean["loc"].tanh())
    with set_exploration_type(ExplorationType.RANDOM):
        drawn = [actor(td.clone())["action"] for _ in range(2)]
    assert not torch.equal(*drawn)
    assert all(x.abs().max() < 1 for x in drawn)
    every_step = make_dt_actor(network, head, group=None, every_frame=True)
    assert every_step.get_dist(make_batch()).batch_shape == (4, 5)


@pytest.mark.parametrize("network_class", [DecisionTransformer, DTTIT])
def test_acting_keeps_tokens_and_changes_nothing(network_class):
    network, head = make_network(kind=network_class)
    actor = make_dt_actor(network, head)
    frames = []
    network.frames[0].register_forward_pre_hook(
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
            expected = predict(network, head, td["sequence"])
            torch.testing.assert_close(action, expected, rtol=0, atol=1e-5)
            resets += int(started)
            _, td = env.step_and_maybe_reset(td.set("action", torch.rand(3, 3) * 2 - 1))
            if step == 20:  # weights change: what was kept is of no use
                randomize(network, seed=1)
    assert resets > 6


def test_evaluation_side_by_side_equals_one_after_another():
    actor = make_dt_actor(*make_network())

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
        ("continuous", "discrete",
         r"int64 are discrete, but .* continuous: set action_space='disc"),
        ("discrete", "continuous",
         r"float32 are continuous, but .* discrete: set action_space='co"),
        ("gaussian", "one-hot", r"int64 are discrete, but this head's are gaussian"),
    ],
)  # fmt: skip
def test_actions_of_the_other_kind_are_refused(space, kind, message):
    network, head = make_network(space=space)
    batch = make_batch(kind=kind)
    for module in (
        make_dt_actor(network, head, group=None),
        make_dt_actor(network, head, group=None, every_frame=True),
        *([make_dt_predictor(network, head)] if space != "gaussian" else []),
    ):
        with pytest.raises(TypeError, match=message):
            module(batch.clone())


def test_a_missing_entry_is_named():
    with pytest.raises(KeyError, match=r"no history under .*'observation'.*SequenceHistory for De"):
        make_dt_actor(*make_network())(TensorDict({"observation": torch.zeros(2, 11)}, [2]))


def test_a_prediction_is_no_distribution():
    with pytest.raises(ValueError, match=r"gaussian: .*make_dt_actor.*with TorchRL's OnlineDTLoss"):
        make_dt_predictor(*make_network(space="gaussian"))


def test_the_features_of_every_frame_are_not_kept():
    network, _ = make_network()
    backbone = make_dt_backbone(network, every_frame=True)
    batch = make_batch()
    with torch.no_grad(), backbone.acting():
        features = backbone(batch)["features"]
    assert features.shape == (4, 5, 16)
    assert not backbone.keeps_frames
    with pytest.raises(ValueError, match="PairedOuterTransformer encodes the newest frame only"):
        Backbone(EnhancedTIT(observation_shape=(4,)), every_frame=True)
    assert torch.equal(features, network.every_frame(*(batch[name] for name in NAMES)))

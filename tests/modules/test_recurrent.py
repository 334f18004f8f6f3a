"""A backbone that carries a recurrent state, step by step and over whole sequences."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.modules import RandomPolicy, get_primers_from_module, set_recurrent_mode
from torchrl.objectives.value import GAE

from tests.numerics import assert_near
from tests.transforms.streams import StreamEnv
from torchrl_tit import Backbone, settings
from torchrl_tit.envs import make_env
from torchrl_tit.modules import as_sequences, make_actor, make_value
from torchrl_tit.networks import HistoryNetwork, build_network
from torchrl_tit.transforms import History

pytestmark = pytest.mark.numerics

N, T, H = 3, 12, 6
TRUNKS = ["shared", "separate"]


def make_backbone(trunks="shared", name="lstm"):
    sizes = {"hidden_dim": H, "features_dim": 5} if name == "lstm" else {}
    network = settings.NETWORKS[name](embed_dim=8, **sizes)
    out_keys = ["features"] if trunks == "shared" else ["policy", "value"]
    return Backbone(build_network(network, (2,), trunks=trunks), out_keys=out_keys)


def sequences(backbone):
    """Random sequences with episodes that begin within, from states that are not zero."""
    is_init = torch.rand(N, T, 1) < 0.25
    is_init[0, 0], is_init[1, 5] = False, True
    states = {key: torch.randn(N, T, *shape) for key, shape in backbone.state_shapes.items()}
    td = TensorDict({"history": torch.randn(N, T, 1, 2), "is_init": is_init, **states}, [N, T])
    for state in states.values():
        state[is_init.squeeze(-1)] = 0
    return td


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize(
    ("trunks", "name"),
    [("shared", "lstm"), ("separate", "lstm"), ("separate", "mingru"), ("shared", "mamba2")],
)
@torch.no_grad()
def test_sequences_equal_single_steps(trunks, name):
    backbone = make_backbone(trunks, name)
    td = sequences(backbone)
    with set_recurrent_mode(True):
        whole = backbone(td.clone())
    states = {key: td[key][:, 0] for key in backbone.state_shapes}
    for t in range(T):
        step = td[:, t].clone()
        for key, state in states.items():
            # An environment starts an episode with a state of zeros, which is not relied on.
            step[key] = state
        step = backbone(step)
        for key in backbone.features_keys:
            torch.testing.assert_close(step[key], whole[key][:, t], rtol=0, atol=1e-9)
        for key in states:
            states[key] = step["next", key]
    for key, state in states.items():  # the states that sequences end with
        torch.testing.assert_close(state, whole["next", key][:, -1], rtol=0, atol=1e-9)
    assert set(backbone.out_keys) == {*backbone.features_keys, *(("next", key) for key in states)}


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", ["mingru", "gated-deltanet", "mamba2"])
@torch.no_grad()
def test_stored_states_count_under_vmap(name):
    """TorchRL maps over the weights of critics, and GAE over the data; LSTMs cannot be mapped."""
    backbone = make_backbone(name=name)
    td = sequences(backbone)
    for state in map(td.get, backbone.state_shapes):
        state.normal_()
    td["is_init"][:, 0] = True  # as a SliceSampler marks the first steps of slices
    with set_recurrent_mode(True):
        expected = backbone(td.clone())["features"]
        weights = TensorDict.from_module(backbone)

        def with_weights(weights, td):
            with weights.to_module(backbone):
                return backbone(td.copy())["features"]

        both = torch.vmap(with_weights, (0, None))(torch.stack([weights, 2 * weights]), td)
        twice = torch.vmap(backbone)(torch.stack([td, td]))["features"]
    assert_near(both[0], expected)
    assert_near(twice, expected.expand_as(twice))


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("name", ["lstm", "gru", "mingru", "gated-deltanet", "mamba2"])
@torch.no_grad()
def test_the_next_values_of_gae_are_those_of_the_steps_that_follow(name):
    """It marks the next step of a first one as first, too: its state is not that of a start."""
    backbone = make_backbone(name=name)
    value = TensorDictSequential(backbone, make_value(backbone.features_dim))
    transforms = Compose(InitTracker(), History(1), backbone.make_tensordict_primer())
    env = TransformedEnv(StreamEnv([N], (2,), torch.float64), transforms)
    steps = env.rollout(20, lambda td: env.rand_action(backbone(td)), break_when_any_done=False)
    steps = steps.exclude("features")
    walked = value(steps.clone())["state_value"]
    for batch, expected in ((steps.clone(), walked), (steps[1].clone(), walked[1])):
        with set_recurrent_mode(True):
            GAE(gamma=0.9, lmbda=0.9, value_network=value, deactivate_vmap=True)(batch)
        assert_near(batch["state_value"], expected)
        inside = ~batch["next", "done"][..., :-1, :]
        assert 0 < inside.sum() < inside.numel()
        following = batch["next", "state_value"][..., :-1, :]
        assert_near(following[inside], expected[..., 1:, :][inside])


@pytest.mark.parametrize(
    ("name", "trunks", "num_frames"),
    [
        ("lstm", "shared", 1),
        ("lstm", "separate", 1),
        ("gru", "separate", 1),
        ("mingru", "shared", 1),
        ("gated-deltanet", "separate", 1),
        ("mamba2", "shared", 1),
        ("lstm", "shared", 4),
        ("enhanced-tit", "shared", 4),
    ],
)
def test_a_collector_registers_what_the_policy_needs(name, trunks, num_frames):
    network = build_network(settings.NETWORKS[name](num_frames), (4,), trunks=trunks)
    out_keys = ["features"] if isinstance(network, HistoryNetwork) else ["policy", "value"]
    backbone = Backbone(network, out_keys=out_keys)
    env = make_env("CartPole-v1", 2, seed=0, num_frames=num_frames)
    primer = get_primers_from_module(backbone)
    keys = set(primer.primers.keys()) if backbone.is_recurrent else set()
    assert keys == set(backbone.state_shapes)
    key = backbone.features_keys[0]
    head = make_actor(backbone.features_dim, env.action_spec_unbatched, in_key=key)
    collector = Collector(
        env,
        TensorDictSequential(backbone, head),
        frames_per_batch=100,
        total_frames=100,
        auto_register_policy_transforms=True,
    )
    (batch,) = collector
    assert batch["is_init"][:, 1:].any()
    for key in backbone.state_shapes:
        assert not batch[key][batch["is_init"].squeeze(-1)].any()
    assert {key for key in set(batch.keys()) if "recurrent" in key} == set(backbone.state_shapes)
    with set_recurrent_mode(True), torch.no_grad():
        again = backbone(batch.exclude(*backbone.features_keys))
    for key in backbone.features_keys:
        assert_near(again[key], batch[key])
    collector.shutdown()


@pytest.mark.parametrize("name", ["lstm", "mamba2"])
@torch.no_grad()
def test_the_state_has_the_dtype_of_the_weights(name):
    pixels = Bounded(0, 255, (3,), dtype=torch.uint8)
    backbone = Backbone(build_network(settings.NETWORKS[name](), pixels).double())
    transforms = Compose(History(1), backbone.make_transforms())
    env = TransformedEnv(StreamEnv([N], dtype=torch.uint8), transforms)
    steps = env.rollout(T, TensorDictSequential(backbone, RandomPolicy(env.action_spec)))
    for key in backbone.state_shapes:
        assert env.observation_spec[key].dtype == torch.float64
        assert steps[key].dtype == steps["next", key].dtype == torch.float64
    again = backbone(as_sequences(steps))["features"]
    torch.testing.assert_close(again, steps["features"], rtol=0, atol=1e-9)


def test_slices_of_another_entry_than_the_history_are_refused():
    env = TransformedEnv(StreamEnv([N]), Compose(InitTracker(), History(1)))
    steps = env.rollout(T, break_when_any_done=False)
    as_sequences(steps)
    for part in (steps, steps["next"]):
        part["observation"] = part["observation"] + 1
    with pytest.raises(ValueError, match="'observation', but it is not the newest frame of 'histo"):
        as_sequences(steps)


@pytest.mark.parametrize("trunks", TRUNKS)
def test_a_missing_entry_says_what_to_add(trunks):
    backbone = make_backbone(trunks)
    td = sequences(backbone)[:, 0]
    for key in ["is_init", *backbone.state_shapes]:
        with pytest.raises(
            KeyError, match=rf"no entry under '{key}'.*make_transforms\(\)"
        ) as error:
            backbone(td.exclude(key))
        assert "\n" not in str(error.value)
    with pytest.raises(KeyError, match=r"no history under 'history'.*torchrl_tit.History"):
        backbone(td.exclude("history"))

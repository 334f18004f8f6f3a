"""A backbone that carries a recurrent state, step by step and over whole sequences."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.modules import get_primers_from_module, set_recurrent_mode

from tests.modules.frames import CountedFrames
from tests.numerics import assert_near
from torchrl_tit import Backbone, settings
from torchrl_tit.envs import make_env
from torchrl_tit.modules import acting, make_actor
from torchrl_tit.networks import HistoryNetwork, build_network

pytestmark = pytest.mark.numerics

N, T, H = 3, 12, 6
TRUNKS = ["shared", "separate"]
STATE = ["recurrent_state_h", "recurrent_state_c"]


def make_backbone(trunks="shared", shape=(2,), num_frames=1):
    network = settings.NETWORKS["lstm"](num_frames, embed_dim=8, hidden_dim=H, features_dim=5)
    out_keys = ["features"] if trunks == "shared" else ["policy", "value"]
    return Backbone(build_network(network, shape, trunks=trunks), out_keys=out_keys)


def sequences(backbone):
    """Random sequences with episodes that begin within, from states that are not zero."""
    is_init = torch.rand(N, T, 1) < 0.25
    is_init[0, 0], is_init[1, 5] = False, True
    states = {key: torch.randn(N, T, *shape) for key, shape in backbone.state_shapes.items()}
    td = TensorDict({"history": torch.randn(N, T, 1, 2), "is_init": is_init, **states}, [N, T])
    for key in states:
        td[key] *= ~is_init.unsqueeze(-1)
    return td


def by_hand(network, td, prefix=""):
    """Features [N, T, F] by the formulas of an LSTM (Hochreiter and Schmidhuber; forget gate)."""
    (embed,), lstm = network.frames, network.history_encoder.memory.lstm
    hidden, cell = (td[prefix + key][:, 0, 0] for key in STATE)
    features = []
    for t in range(T):
        continues = ~td["is_init"][:, t]
        hidden, cell = hidden * continues, cell * continues
        gates = (
            embed(td["history"][:, t, 0]).squeeze(-2) @ lstm.weight_ih_l0.T
            + lstm.bias_ih_l0
            + hidden @ lstm.weight_hh_l0.T
            + lstm.bias_hh_l0
        )
        write, forget, new, read = gates.chunk(4, -1)
        cell = forget.sigmoid() * cell + write.sigmoid() * new.tanh()
        hidden = read.sigmoid() * cell.tanh()
        features.append(network.head(hidden))
    return torch.stack(features, 1)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("trunks", TRUNKS)
def test_sequences_equal_the_formulas_with_their_gradients(trunks):
    backbone = make_backbone(trunks)
    td = sequences(backbone)
    network = backbone.module
    if trunks == "shared":
        expected = [by_hand(network, td)]
    else:
        expected = [by_hand(network.policy, td, "policy_"), by_hand(network.value, td, "value_")]
    with set_recurrent_mode(True):
        out = backbone(td.clone())
    features = [out[key] for key in backbone.features_keys]
    assert_near(features, expected)
    probes = [torch.randn_like(x) for x in features]
    weights = list(backbone.parameters())

    def gradients(outputs):
        loss = sum((x * probe).sum() for x, probe in zip(outputs, probes, strict=True))
        return torch.autograd.grad(loss, weights)

    assert_near(gradients(features), gradients(expected))


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("trunks", TRUNKS)
@torch.no_grad()
def test_sequences_equal_single_steps(trunks):
    backbone = make_backbone(trunks)
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
            last = t == T - 1 or td["is_init"][:, t + 1].squeeze(-1)
            ends = torch.as_tensor(last).expand(N)
            computed = whole["next", key][:, t][ends]  # the states that sequences end with
            torch.testing.assert_close(states[key][ends], computed, rtol=0, atol=1e-9)
    assert set(backbone.out_keys) == {*backbone.features_keys, *(("next", key) for key in states)}


@pytest.mark.parametrize("trunks", TRUNKS)
def test_a_rollout_as_sequences_has_the_features_of_its_steps(trunks):
    """Across ends of episodes and of sequences: the state is carried, or starts at zero."""
    backbone = make_backbone(trunks, (4,))
    env = TransformedEnv(make_env("CartPole-v1", 4, seed=0), backbone.make_transforms())
    head = make_actor(5, env.action_spec_unbatched, in_key=backbone.features_keys[0])
    collector = Collector(
        env,
        TensorDictSequential(backbone, head),
        frames_per_batch=400,
        total_frames=800,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        begins = batch["is_init"].squeeze(-1)
        assert begins[:, 1:].sum() > 4
        assert torch.equal(begins[:, 1:], batch["next", "done"][:, :-1].squeeze(-1))
        for key, shape in backbone.state_shapes.items():
            states, after = batch[key], batch["next", key]
            assert states.shape[2:] == shape
            assert not states[begins].any()
            assert states[~begins].any()
            continues = ~begins[:, 1:]
            assert torch.equal(states[:, 1:][continues], after[:, :-1][continues])
        with set_recurrent_mode(True), torch.no_grad():
            again = backbone(batch.select(*backbone.in_keys).reshape(-1, 20))
        for key in backbone.features_keys:
            assert_near(again[key].reshape(batch[key].shape), batch[key])
    collector.shutdown()


@pytest.mark.parametrize(
    ("name", "trunks", "num_frames"),
    [
        ("lstm", "shared", 1),
        ("lstm", "separate", 1),
        ("gru", "separate", 1),
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


@pytest.mark.usefixtures("float64")
@torch.no_grad()
def test_with_several_frames_it_reads_these_and_carries_no_state():
    backbone = make_backbone(num_frames=4)
    assert not backbone.is_recurrent
    assert backbone.in_keys == ["history"]
    assert backbone.out_keys == ["features"]
    assert len(backbone.make_transforms()) == 0
    stream = torch.randn(5, 9, 2)
    single = make_backbone()
    single.load_state_dict(backbone.state_dict())
    frames = CountedFrames(backbone.module)
    with acting(backbone):
        for start in range(5):
            window = stream[:, start : start + 4]
            seen = backbone(TensorDict({"history": window}, [5]))["features"]
            assert frames.take() == (5 if start else 20)
            td = TensorDict({"history": window.unsqueeze(2)}, [5, 4])
            td["is_init"] = torch.zeros(5, 4, 1, dtype=torch.bool)
            for key, shape in single.state_shapes.items():
                td[key] = torch.zeros(5, 4, *shape)
            with set_recurrent_mode(True):
                assert_near(seen, single(td)["features"][:, -1])


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

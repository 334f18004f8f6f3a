"""The recurrent backbone against an LSTM written out step by step."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.modules import set_recurrent_mode

from torchrl_tit.envs import make_env
from torchrl_tit.modules import LSTMBackbone, LSTMConfig, make_actor

CONFIG = LSTMConfig(embed_dim=8, hidden_dim=6, features_dim=5)
N, T = 3, 12


def sequences():
    """Random sequences with episodes that begin in their midst, from states that are not zero."""
    is_init = torch.rand(N, T, 1) < 0.25
    hidden, cell = torch.randn(2, N, T, 1, 6) * ~is_init.unsqueeze(-1)
    return TensorDict(
        {
            "history": torch.randn(N, T, 1, 2),
            "is_init": is_init,
            "recurrent_state_h": hidden,
            "recurrent_state_c": cell,
        },
        [N, T],
    )


def by_hand(backbone, td):
    """Features [N, T, F] by the formulas of Hochreiter and Schmidhuber, with a forget gate."""
    embedding, lstm = backbone[0].module, backbone[1].lstm
    hidden, cell = td["recurrent_state_h"][:, 0, 0], td["recurrent_state_c"][:, 0, 0]
    features = []
    for t in range(T):
        goes_on = ~td["is_init"][:, t]
        hidden, cell = hidden * goes_on, cell * goes_on
        gates = (
            embedding(td["history"][:, t]) @ lstm.weight_ih_l0.T
            + lstm.bias_ih_l0
            + hidden @ lstm.weight_hh_l0.T
            + lstm.bias_hh_l0
        )
        write, forget, new, read = gates.chunk(4, -1)
        cell = forget.sigmoid() * cell + write.sigmoid() * new.tanh()
        hidden = read.sigmoid() * cell.tanh()
        features.append(backbone[2].module(hidden))
    return torch.stack(features, 1)


def test_sequences_are_those_by_hand_with_their_gradients():
    torch.manual_seed(0)
    backbone, td = LSTMBackbone((2,), config=CONFIG), sequences()
    expected = by_hand(backbone, td)
    with set_recurrent_mode(True):
        features = backbone(td)["features"]
    torch.testing.assert_close(features, expected)
    probe = torch.randn_like(features)
    weights = list(backbone.parameters())
    gradients = torch.autograd.grad((features * probe).sum(), weights)
    for gradient, other in zip(
        gradients, torch.autograd.grad((expected * probe).sum(), weights), strict=True
    ):
        torch.testing.assert_close(gradient, other, atol=1e-5, rtol=1e-4)


def test_sequences_of_a_rollout_are_its_steps():
    """Over ends of episodes and of sequences: the state goes on, or begins at zero."""
    env = TransformedEnv(make_env("CartPole-v1", 4, seed=0), CONFIG.make_transforms())
    backbone = LSTMBackbone((4,), config=CONFIG)
    policy = TensorDictSequential(backbone, make_actor(5, env.action_spec_unbatched))
    collector = Collector(
        env,
        policy,
        frames_per_batch=400,
        total_frames=800,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        features, states = batch["features"].clone(), batch["recurrent_state_h"].squeeze(-2)
        memory = batch["memory"].clone()
        begins = batch["is_init"].squeeze(-1)
        assert begins[:, 1:].sum() > 4
        torch.testing.assert_close(begins[:, 1:], batch["next", "done"][:, :-1].squeeze(-1))
        assert not states[begins].any()
        assert torch.equal(states[:, 1:][~begins[:, 1:]], memory[:, :-1][~begins[:, 1:]])
        with set_recurrent_mode(True), torch.no_grad():
            again = backbone(batch.select(*backbone.in_keys).reshape(-1, 20))
        torch.testing.assert_close(again["features"].reshape(features.shape), features)
    collector.shutdown()


def test_what_it_cannot_read_is_refused():
    with pytest.raises(ValueError, match="observation_shape"):
        LSTMBackbone((84, 84))
    with pytest.raises(ValueError, match="set history to 1"):
        LSTMBackbone((4,), history=2)
    with pytest.raises(ValueError, match="embed_dim must be >= 1"):
        LSTMBackbone((4,), embed_dim=0)
    with pytest.raises(TypeError, match="hidden"):
        LSTMBackbone((4,), hidden=3)

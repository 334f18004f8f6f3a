"""Policy and value heads."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.numerics import assert_near
from torchrl_tit.modules import make_actor, make_value

pytestmark = pytest.mark.numerics


def features(n=200):
    return TensorDict({"features": torch.randn(n, 16)}, [n])


def spread(actor):
    """Makes a head's distributions differ between rows, which its initial weights hardly do."""
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.copy_(torch.randn_like(parameter))
    return actor


@pytest.mark.parametrize("spec", [Categorical(3), OneHot(3)])
def test_discrete(spec):
    actor = spread(make_actor(16, spec))
    with set_exploration_type(ExplorationType.RANDOM):
        td = actor(features())
    logits = td["logits"].log_softmax(-1)
    index = td["action"] if td["action"].ndim == 1 else td["action"].long().argmax(-1)
    assert_near(td["action_log_prob"], logits.gather(-1, index.unsqueeze(-1)).squeeze(-1))
    assert len(set(index.tolist())) == 3
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = actor(features())
    action = td["action"] if td["action"].ndim == 1 else td["action"].long().argmax(-1)
    assert torch.equal(action, td["logits"].argmax(-1))


@pytest.mark.parametrize("spec", [Bounded(-1, 1, (2,)), Unbounded((2,))])
def test_continuous(spec):
    actor = make_actor(16, spec)
    with set_exploration_type(ExplorationType.RANDOM):
        td = actor(features())
    assert torch.equal(td["scale"], torch.ones(200, 2))
    assert td["action"].abs().max() > 1.5  # neither squashed nor clipped
    expected = torch.distributions.Normal(td["loc"], td["scale"]).log_prob(td["action"]).sum(-1)
    assert_near(td["action_log_prob"], expected)
    log_scale = [p for p in actor.parameters() if p.shape == (2,) and not p.any()]
    assert log_scale  # state-independent, learned, at 0
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = actor(features())
    assert torch.equal(td["action"], td["loc"])


def test_value_and_keys():
    td = TensorDict({"agent": {"value_features": torch.randn(5, 16)}}, [5])
    assert make_value(16, in_key=("agent", "value_features"))(td)["state_value"].shape == (5, 1)
    td = TensorDict({"policy": torch.randn(5, 16)}, [5])
    assert make_actor(16, Categorical(2), in_key="policy", action_key="move")(td)["move"].shape == (
        5,
    )


@pytest.mark.parametrize("spec", [Unbounded((2, 3)), Unbounded((2,), dtype=torch.int64)])
def test_other_action_spaces_are_refused(spec):
    with pytest.raises(ValueError, match="no policy head"):
        make_actor(16, spec)

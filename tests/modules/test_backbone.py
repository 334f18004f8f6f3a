"""The backbone as a TensorDictModule."""

from contextlib import nullcontext

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import set_skip_existing
from torchrl.data import Categorical
from torchrl.objectives import ClipPPOLoss

from torchrl_tit import Backbone, EnhancedTIT, VanillaTIT
from torchrl_tit.modules import make_actor, make_value
from torchrl_tit.networks import MLP


@pytest.mark.parametrize("network_class", [EnhancedTIT, VanillaTIT])
@pytest.mark.parametrize("leading", [(), (3,), (2, 3)])
def test_writes_what_the_network_puts_out(network_class, leading):
    network = network_class((4,), history=3)
    history = torch.randn(*leading, 3, 4)
    td = Backbone(network)(TensorDict({"history": history}, leading))
    assert td["features"].shape == (*leading, 64)
    assert torch.equal(td["features"], network(history))


def test_nested_keys():
    backbone = Backbone(
        EnhancedTIT((4,), history=2),
        in_keys=[("agent", "history")],
        out_keys=[("agent", "features")],
    )
    td = backbone(TensorDict({"agent": {"history": torch.randn(5, 2, 4)}}, [5]))
    assert td["agent", "features"].shape == (5, 64)


def test_a_key_can_be_a_name():
    backbone = Backbone(EnhancedTIT((4,), history=2), in_keys="past", out_keys="seen")
    td = backbone(TensorDict({"past": torch.randn(5, 2, 4)}, [5]))
    assert td["seen"].shape == (5, 64)


@pytest.mark.parametrize("acts", [False, True])
@torch.no_grad()
def test_is_called_as_any_tensordict_module(acts):
    network = EnhancedTIT((4,), history=2)
    backbone = Backbone(network)
    history = torch.randn(5, 2, 4)
    expected = network(history)
    with backbone.acting() if acts else nullcontext():
        td = TensorDict({"history": history}, [5])
        assert backbone(td) is td
        torch.testing.assert_close(td["features"], expected)
        other = TensorDict({}, [5])
        assert backbone(td, tensordict_out=other) is other
        torch.testing.assert_close(other["features"], expected)
        torch.testing.assert_close(backbone(history), expected)
        td["features"] = torch.zeros(5)
        with set_skip_existing(True):
            assert not backbone(td)["features"].any()
        assert backbone(td)["features"].any()
        locked = TensorDict({"history": history, "features": torch.zeros(5, 64)}, [5]).lock_()
        with pytest.raises(RuntimeError, match="lock"):
            backbone(locked)


def test_two_trunks_write_two_keys():
    backbone = Backbone(MLP((4,), history=1), out_keys=["policy", "value"])
    td = backbone(TensorDict({"history": torch.randn(5, 1, 4)}, [5]))
    assert td["policy"].shape == td["value"].shape == (5, 64)
    assert not torch.equal(td["policy"], td["value"])


def test_a_missing_history_says_what_is_there():
    backbone = Backbone(EnhancedTIT((4,), history=2))
    with pytest.raises(KeyError, match=r"no history under 'history', only \['observation'\]"):
        backbone(TensorDict({"observation": torch.randn(5, 4)}, [5]))


@pytest.mark.parametrize("keys", [{"in_keys": []}, {"in_keys": ["a", "b"]}, {"out_keys": []}])
def test_wrong_keys(keys):
    with pytest.raises(ValueError, match="one history"):
        Backbone(EnhancedTIT((4,)), **keys)


def test_wrong_shape_names_what_fits():
    backbone = Backbone(EnhancedTIT((4,), history=2))
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 2, 4\]"):
        backbone(TensorDict({"history": torch.randn(5, 3, 4)}, [5]))


def test_gradients_of_a_loss_on_heads_reach_the_backbone():
    network = EnhancedTIT((4,), history=2)
    backbone = Backbone(network)
    actor, critic = make_actor(64, Categorical(2)), make_value(64)
    loss = ClipPPOLoss(actor, critic)
    td = TensorDict(
        {
            "history": torch.randn(16, 2, 4),
            "action": torch.randint(0, 2, (16,)),
            "action_log_prob": torch.full((16,), -0.7),
            "advantage": torch.randn(16, 1),
            "value_target": torch.randn(16, 1),
        },
        [16],
    )
    terms = loss(backbone(td))
    (terms["loss_objective"] + terms["loss_critic"]).backward()
    gradients = [p.grad for p in network.parameters() if p.grad is not None]
    assert len(gradients) == len(list(network.parameters()))
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert all(gradient.any() for gradient in gradients)


@pytest.mark.parametrize("acts", [False, True])
def test_autocast_computes_in_bfloat16_and_hands_over_float32(acts):
    torch.manual_seed(0)
    network = EnhancedTIT((4,), history=3)
    backbone = Backbone(network, autocast=torch.bfloat16)
    seen = []
    network.get_submodule("head.1").register_forward_hook(
        lambda module, args, out: seen.append(out.dtype)
    )
    history = torch.randn(32, 3, 4)
    full = network(history)
    assert seen.pop() == torch.float32
    with backbone.acting() if acts else nullcontext(), torch.set_grad_enabled(not acts):
        features = backbone(TensorDict({"history": history}, [32]))["features"]
    assert seen.pop() == torch.bfloat16
    assert features.dtype == torch.float32
    assert 0 < (features - full).abs().max() < 0.2
    if not acts:
        features.square().sum().backward()
        assert {p.grad.dtype for p in network.parameters() if p.grad is not None} == {torch.float32}


def test_autocast_of_two_trunks():
    backbone = Backbone(MLP((4,), history=1), out_keys=["a", "b"], autocast=torch.bfloat16)
    td = backbone(TensorDict({"history": torch.randn(5, 1, 4)}, [5]))
    assert td["a"].dtype == td["b"].dtype == torch.float32

"""Integrated gradients: they add up to what the observation makes of the target."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import MultiCategorical

from tests.analysis.policies import ACTIONS, make_policy
from tests.numerics import assert_near
from torchrl_tit.analysis import integrated_gradients
from torchrl_tit.analysis.targets import compute_target
from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

NETWORKS: dict[str, Network] = {
    "enhanced": enhanced_tit(3, embed_dim=8, features_dim=8),
    "mlp": mlp(3, hidden_dim=8),  # with a trunk each for policy and value
    "lstm": lstm(embed_dim=8, hidden_dim=8, features_dim=8),  # whose state is carried
}
OBSERVATION = (4,)


def make_states(network: Network) -> TensorDict:
    states = TensorDict({"history": torch.randn(2, network.num_frames, 4)}, [2])
    if network.carries_state:
        for key in ("recurrent_state_h", "recurrent_state_c"):
            states[key] = torch.randn(2, 1, 8)
        states["is_init"] = torch.zeros(2, 1, dtype=torch.bool)
    return states


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("target", ["action", "value"])
@pytest.mark.parametrize("name", NETWORKS)
def test_they_add_up(name: str, target: Any) -> None:
    pytest.importorskip("captum")
    network = NETWORKS[name]
    policy, states = make_policy(network, OBSERVATION), make_states(network)
    states["action"] = torch.arange(2) % ACTIONS
    shares = integrated_gradients(policy, states, target=target, steps=200)["observation"]
    assert shares.shape == states["history"].shape
    assert shares.any(-1).all(), "a frame without any share"
    before = states.clone()
    before["history"] = torch.zeros_like(before["history"])
    difference = compute_target(policy, states, target) - compute_target(policy, before, target)
    torch.testing.assert_close(shares.sum((1, 2)), difference, rtol=0, atol=1e-4)


@pytest.mark.usefixtures("float64")
def test_points_are_added_until_the_sum_is_right() -> None:
    """Steep targets need more of them."""
    pytest.importorskip("captum")
    network = NETWORKS["enhanced"]
    policy, states = make_policy(network, OBSERVATION), make_states(network)
    states["history"] *= 3
    states["action"] = torch.arange(2)
    exact = integrated_gradients(policy, states, steps=2000)["observation"]
    with pytest.warns(UserWarning, match="with 32 points, attributions miss the difference in the"):
        rough = integrated_gradients(policy, states, steps=1, tolerance=0)["observation"]
    assert_near(rough, integrated_gradients(policy, states, steps=32, tolerance=9)["observation"])
    for tolerance in (0.1, 0.01):
        shares = integrated_gradients(policy, states, steps=8, tolerance=tolerance)["observation"]
        apart = (shares.sum((1, 2)) - exact.sum((1, 2))).abs()
        assert (apart <= 1.1 * tolerance * shares.abs().sum((1, 2))).all()


@pytest.mark.usefixtures("float64")
def test_chosen_actions() -> None:
    pytest.importorskip("captum")
    network = NETWORKS["enhanced"]
    policy, states = make_policy(network, OBSERVATION), make_states(network)
    # Without an action it is the policy's own, also on the way from zeros.
    own = policy.eval()(states.clone())
    assert_near(integrated_gradients(policy, states), integrated_gradients(policy, own))
    one = integrated_gradients(policy, states[0])["observation"]
    assert_near(one, integrated_gradients(policy, states)["observation"][:1])


def test_bytes_count_as_the_network_reads_them() -> None:
    pytest.importorskip("captum")
    policy = make_policy(NETWORKS["enhanced"], OBSERVATION)
    bytes_ = torch.randint(256, (2, 3, 4), dtype=torch.uint8)
    states = TensorDict({"history": bytes_, "action": torch.tensor([1, 3])}, [2])
    floats = states.clone().set("history", bytes_.float() / 255)
    assert_near(integrated_gradients(policy, states), integrated_gradients(policy, floats))


def test_categories_beside_an_array_stay_as_they_are() -> None:
    pytest.importorskip("captum")
    observation: dict[str, Any] = {"row": MultiCategorical([3, 2]), "state": (4,)}
    policy = make_policy(NETWORKS["enhanced"], observation)
    histories: dict[str, Tensor] = {
        "row": torch.randint(2, (2, 3, 2)),
        "state": torch.randn(2, 3, 4),
    }
    states = TensorDict({"history": TensorDict(histories, [2])}, [2])
    shares = integrated_gradients(policy, states)
    assert list(shares) == ["state"]
    assert shares["state"].any()
    alone = make_policy(NETWORKS["enhanced"], MultiCategorical([3, 2]))
    states = TensorDict({"history": histories["row"]}, [2])
    with pytest.raises(ValueError, match="reads categories only, which have no gradient"):
        integrated_gradients(alone, states)


def test_captum_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "captum.attr", None)
    network = replace(NETWORKS["enhanced"], num_frames=1)
    policy, states = make_policy(network, OBSERVATION), make_states(network)
    with pytest.raises(ValueError, match=r"need captum: pip install 'torchrl-tit\[explain\]'"):
        integrated_gradients(policy, states)

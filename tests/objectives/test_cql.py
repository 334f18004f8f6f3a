"""The losses of CQL equal their formulas, written as loops in NumPy."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot, Unbounded
from torchrl.modules import QValueActor, ValueOperator

from torchrl_tit.modules import make_squashed_actor
from torchrl_tit.objectives import ContinuousCQLLoss, DelayedDiscreteCQLLoss

pytestmark = pytest.mark.numerics

BATCH, SAMPLES, OBSERVATION, ACTION = 5, 3, 4, 2
GAMMA, WEIGHT = 0.9, 7.0
SPEC = Bounded(-torch.tensor([1.0, 2.0]), torch.tensor([1.0, 0.5]), shape=(ACTION,))
WIDTHS = (2.0, 2.5)


class Quadratic(nn.Module):
    """w . s + a' M a + s_0 v . a: a value that is easy to compute in NumPy too."""

    def __init__(self):
        super().__init__()
        self.w = nn.Parameter(torch.randn(OBSERVATION, dtype=torch.float64))
        self.m = nn.Parameter(torch.randn(ACTION, ACTION, dtype=torch.float64))
        self.v = nn.Parameter(torch.randn(ACTION, dtype=torch.float64))

    def forward(self, s, a):
        square = torch.einsum("...i,ij,...j->...", a, self.m, a)
        return (s @ self.w + square + s[..., 0] * (a @ self.v)).unsqueeze(-1)


def value(params, critic, s, a):
    w, m, v = (params[name][critic].detach().numpy() for name in ("w", "m", "v"))
    return s @ w + a @ m @ a + s[0] * (v @ a)


def make_batch(seed=1):
    generator = np.random.default_rng(seed)
    low, high = SPEC.space.low.numpy(), SPEC.space.high.numpy()

    def states():
        return torch.from_numpy(generator.normal(size=(BATCH, OBSERVATION)))

    terminated = torch.tensor([[False], [True], [False], [False], [True]])
    return TensorDict(
        {
            "state": states(),
            "observation": states(),
            "action": torch.from_numpy(generator.uniform(low, high, (BATCH, ACTION))),
            "next": {
                "state": states(),
                "observation": states(),
                "reward": torch.from_numpy(generator.normal(size=(BATCH, 1))),
                "terminated": terminated,
                "done": terminated | torch.tensor([[True], [False], [False], [False], [False]]),
            },
        },
        [BATCH],
    )


def with_samples(batch, seed=2):
    """A batch with random numbers as the policy's samples, and these."""
    generator = np.random.default_rng(seed)

    def numbers(*shape):
        return torch.from_numpy(generator.normal(size=shape))

    samples = {
        "action": numbers(BATCH, ACTION).requires_grad_(),
        "log_prob": numbers(BATCH).requires_grad_(),
        "actions": numbers(BATCH, 2 * SAMPLES, ACTION),
        "log_probs": numbers(BATCH, 2 * SAMPLES),
        "next_action": numbers(BATCH, ACTION),
    }
    return batch.copy().set("policy_samples", TensorDict(samples, [BATCH])), samples


def make_loss(critic=None, **settings):
    """The actor reads "observation", the critics read "state"."""
    actor = make_squashed_actor(OBSERVATION, SPEC, in_key="observation").double()
    critic = critic or ValueOperator(Quadratic(), in_keys=["state", "action"])
    options = {"min_q_weight": WEIGHT, "num_random": SAMPLES, "alpha_init": 0.3, **settings}
    loss = ContinuousCQLLoss(actor, critic, action_spec=SPEC, **options)
    loss.make_value_estimator(gamma=GAMMA)
    for name, weight in loss.target_qvalue_network_params.items(True, True):
        weight.data.normal_()
        assert not torch.equal(weight, loss.qvalue_network_params[name])
    return loss


def weights(params):
    return {key[-1]: weight for key, weight in params.items(True, True)}


def uniform_actions(monkeypatch):
    """Fixes the uniform draws and returns the actions they become, [B, m, A]."""
    drawn = torch.from_numpy(np.random.default_rng(3).uniform(size=(BATCH, SAMPLES, ACTION)))
    monkeypatch.setattr(torch, "rand", lambda *shape, **_: drawn.reshape(shape))
    low = SPEC.space.low.numpy()
    return low + np.array(WIDTHS) * drawn.numpy()


def log_density(loss, state, action):
    """The log density of a policy's action in a state, and the action of its mean."""
    head = loss.actor_network_params
    weight = {key[-2:]: w.detach().numpy() for key, w in head.items(True, True)}
    mean, log_std = (
        state @ weight[name, "weight"].T + weight[name, "bias"] for name in ("mean", "log_std")
    )
    middle, half = (SPEC.space.high + SPEC.space.low).numpy() / 2, np.array(WIDTHS) / 2
    squashed = (action - middle) / half
    density = norm.logpdf(np.arctanh(squashed), mean, np.exp(log_std))
    density -= np.log(1 - squashed**2) + np.log(half)
    return density.sum(), middle + half * np.tanh(mean)


@pytest.mark.parametrize("over_critics", ["mean", "sum"])
def test_critics(monkeypatch, over_critics):
    loss = make_loss(over_critics=over_critics)
    batch, samples = with_samples(make_batch())
    uniform = uniform_actions(monkeypatch)
    params = weights(loss.qvalue_network_params)
    targets = weights(loss.target_qvalue_network_params)
    errors, gaps = np.zeros(2), np.zeros(2)
    for b in range(BATCH):
        s, a = batch["state"][b].numpy(), batch["action"][b].numpy()
        s_next, a_next = batch["next", "state"][b].numpy(), samples["next_action"][b].numpy()
        best = min(value(targets, c, s_next, a_next) for c in range(2))
        # Truncated episodes bootstrap, terminated ones do not. The target has no entropy term.
        future = 0.0 if batch["next", "terminated"][b] else GAMMA * best
        target = batch["next", "reward"][b].item() + future
        for c in range(2):
            exponents = [
                value(params, c, s, u) + math.log(WIDTHS[0] * WIDTHS[1]) for u in uniform[b]
            ]
            for j in range(2 * SAMPLES):  # evaluated at s, even those sampled at s'
                drawn = samples["actions"][b, j].numpy()
                exponents.append(value(params, c, s, drawn) - samples["log_probs"][b, j].item())
            q = value(params, c, s, a)
            gaps[c] += (math.log(sum(map(math.exp, exponents))) - q) / BATCH
            errors[c] += (q - target) ** 2 / BATCH
    terms = loss.critic_loss(batch)
    gap = gaps.mean() if over_critics == "mean" else gaps.sum()
    assert terms["loss_qvalue"].item() == pytest.approx(errors.sum(), rel=1e-6)  # float32 gamma
    assert terms["loss_cql"].item() == pytest.approx(WEIGHT * gap, rel=1e-6)
    assert loss.q_loss(batch)[0] == terms["loss_qvalue"]
    assert loss.cql_loss(batch)[0] == terms["loss_cql"]
    (terms["loss_qvalue"] + terms["loss_cql"]).backward()
    assert all(weight.grad.any() for weight in params.values())
    assert all(weight.grad is None for weight in (samples["action"], *targets.values()))


def test_actor():
    loss, (batch, samples) = make_loss(), with_samples(make_batch())
    params = weights(loss.qvalue_network_params)
    expected = 0.0
    for b in range(BATCH):
        s, a = batch["state"][b].numpy(), samples["action"][b].detach().numpy()
        worst = min(value(params, c, s, a) for c in range(2))
        expected += (0.3 * samples["log_prob"][b].item() - worst) / BATCH
    loss_actor, _ = loss.actor_loss(batch)
    assert loss_actor.item() == pytest.approx(expected, rel=1e-6)  # alpha is a float32
    loss_actor.backward()
    assert samples["action"].grad is not None
    torch.testing.assert_close(samples["log_prob"].grad, torch.full((BATCH,), 0.3 / BATCH).double())
    assert all(w.grad is None for w in params.values())
    assert loss.log_alpha.grad is None


def test_actor_that_clones():
    """Nothing else gets a gradient; where the data's action is at a bound, it is finite."""
    loss, batch = make_loss(), make_batch()
    torch.manual_seed(5)
    log_prob = loss.sample_policy(batch)["policy_samples", "log_prob"].mean().item()
    torch.manual_seed(5)
    loss_actor, others = loss.actor_bc_loss(batch)
    pairs = zip(batch["observation"].numpy(), batch["action"].numpy(), strict=True)
    likelihood = np.mean([log_density(loss, state, action)[0] for state, action in pairs])
    assert others["bc_log_prob"].item() == pytest.approx(likelihood)
    assert loss_actor.item() == pytest.approx(0.3 * log_prob - likelihood)
    batch["action"][0], batch["action"][1] = SPEC.space.high, SPEC.space.low
    loss.actor_bc_loss(batch)[0].backward()
    assert all(w.grad.isfinite().all() for w in weights(loss.actor_network_params).values())
    assert all(w.grad is None for w in weights(loss.qvalue_network_params).values())
    assert loss.log_alpha.grad is None


def test_cloned_actions_keep_away_from_the_bounds():
    """At them, a squashed Gaussian's mean would have to be infinite."""
    loss, batch, likelihoods = make_loss(), make_batch(), []
    high, low = SPEC.space.high, SPEC.space.low
    for share in (1.0, 0.995, 0.99):
        batch["action"] = (low + share * (high - low)).expand_as(batch["action"]).clone()
        likelihoods.append(loss.actor_bc_loss(batch)[1]["bc_log_prob"])
    at_bound, at_margin, inside = likelihoods
    torch.testing.assert_close(at_bound, at_margin)
    assert not torch.isclose(at_margin, inside, rtol=1e-3)


def test_temperature():
    loss, (batch, samples) = make_loss(), with_samples(make_batch())
    excess = samples["log_prob"].detach().mean().item() - ACTION  # target entropy: -2
    loss_alpha, _ = loss.alpha_loss(batch)
    assert loss_alpha.item() == pytest.approx(-0.3 * excess, rel=1e-6)
    loss_alpha.backward()  # with respect to the logarithm: exp(log alpha) again
    assert loss.log_alpha.grad.item() == pytest.approx(-0.3 * excess, rel=1e-6)
    assert samples["log_prob"].grad is None


def test_the_policy_is_sampled_where_it_should_be():
    """Differentiably at s, detached at s', and densities have the Jacobian of tanh and bounds."""
    loss, batch = make_loss(), make_batch()
    torch.manual_seed(5)
    samples = loss.sample_policy(batch)["policy_samples"]
    assert samples["actions"].shape == (BATCH, 2 * SAMPLES, ACTION)
    assert {key for key, value in samples.items() if value.requires_grad} == {"action", "log_prob"}

    def check(state, action, log_prob):
        density, best = log_density(loss, state, action)
        assert log_prob == pytest.approx(density, rel=1e-5)
        return best

    for b in range(BATCH):
        here, there = (d["observation"][b].numpy() for d in (batch, batch["next"]))
        check(here, samples["action"][b].detach().numpy(), samples["log_prob"][b].item())
        for j in range(2 * SAMPLES):
            state = here if j < SAMPLES else there
            check(state, samples["actions"][b, j].numpy(), samples["log_probs"][b, j].item())
        best = check(there, samples["actions"][b, -1].numpy(), samples["log_probs"][b, -1].item())
        np.testing.assert_allclose(samples["next_action"][b].numpy(), best, rtol=1e-6)


def test_forward_computes_the_same_terms_and_adds_priorities_to_the_batch(monkeypatch):
    loss, (batch, samples) = make_loss(), with_samples(make_batch())
    uniform_actions(monkeypatch)
    monkeypatch.setattr(loss, "sample_policy", lambda _: batch)
    given = make_batch()
    terms, critics = loss(given), loss.critic_loss(batch)
    assert (given.exclude("td_error") == make_batch()).all()
    assert given.keys() == {*make_batch().keys(), "td_error"}
    errors = critics["td_error"]
    assert errors.shape == (2, BATCH)
    torch.testing.assert_close(errors.sum(0).mean(), terms["loss_qvalue"].detach())
    torch.testing.assert_close(given["td_error"], errors.max(0).values)
    expected = {
        "loss_qvalue": critics["loss_qvalue"],
        "loss_cql": critics["loss_cql"],
        "loss_actor": loss.actor_loss(batch)[0],
        "loss_alpha": loss.alpha_loss(batch)[0],
        "alpha": torch.tensor(0.3),
        "entropy": -samples["log_prob"].mean(),
    }
    assert set(terms.keys()) == set(loss.out_keys) == set(expected)
    for name, value in expected.items():
        torch.testing.assert_close(terms[name], value.detach(), msg=name)


def test_the_action_has_the_key_of_the_actor():
    actor = make_squashed_actor(
        OBSERVATION, SPEC, in_key="observation", action_key=("arm", "action")
    )
    critic = ValueOperator(Quadratic(), in_keys=["state", ("arm", "action")])
    loss = ContinuousCQLLoss(actor, critic, action_spec=SPEC)
    assert ("arm", "action") in loss.in_keys
    with pytest.raises(KeyError, match="arm"):
        loss(make_batch())


@pytest.mark.parametrize("spec", [Categorical(3), Unbounded((2,)), Bounded(-1, 1, shape=(4, 2))])
def test_actions_without_bounds_are_refused(spec):
    actor = make_squashed_actor(OBSERVATION, SPEC, in_key="observation")
    critic = ValueOperator(Quadratic(), in_keys=["state", "action"])
    with pytest.raises(ValueError, match="action_spec must be a Bounded spec of one dimension"):
        ContinuousCQLLoss(actor, critic, action_spec=spec)
    with pytest.raises(ValueError, match="no squashed policy for the action space"):
        make_squashed_actor(OBSERVATION, spec)
    endless = Bounded(torch.zeros(2), torch.tensor([1.0, math.inf]))
    with pytest.raises(ValueError, match=r"no uniform samples for actions from .* to \[1.0, inf\]"):
        ContinuousCQLLoss(actor, critic, action_spec=endless)


def test_critics_that_do_not_read_the_action_are_refused():
    actor = make_squashed_actor(OBSERVATION, SPEC, in_key="observation")
    blind = ValueOperator(nn.Linear(OBSERVATION, 1), in_keys=["observation"])
    with pytest.raises(ValueError, match=r"must read the action under 'action'.*\['observation'\]"):
        ContinuousCQLLoss(actor, blind, action_spec=SPEC)


@pytest.mark.parametrize("spec", [Categorical(3), OneHot(3)])
def test_discrete_actions(spec):
    """The target is that of the target network, unlike in TorchRL's `DiscreteCQLLoss`."""
    linear = nn.Linear(OBSERVATION, 3).double()
    actor = QValueActor(linear, in_keys=["state"], spec=spec)
    loss = DelayedDiscreteCQLLoss(actor, action_space=spec)
    loss.make_value_estimator(gamma=GAMMA)
    targets = weights(loss.target_value_network_params)
    for weight in targets.values():
        weight.data.normal_()
    batch = make_batch().set("action", spec.rand((BATCH,)))

    def values(params, state):
        return (params["weight"].detach() @ state + params["bias"].detach()).numpy()

    error = gap = 0.0
    for b in range(BATCH):
        action = batch["action"][b]
        index = int(action.long().argmax() if isinstance(spec, OneHot) else action)
        q = values(weights(loss.value_network_params), batch["state"][b])
        best = max(values(targets, batch["next", "state"][b]))
        # Truncated episodes bootstrap, terminated ones do not.
        future = 0.0 if batch["next", "terminated"][b] else GAMMA * best
        error += (q[index] - batch["next", "reward"][b].item() - future) ** 2 / 2 / BATCH
        gap += (math.log(np.exp(q).sum()) - q[index]) / BATCH
    losses = loss(batch)
    assert losses["loss_qvalue"].item() == pytest.approx(error, rel=1e-6)  # gamma is a float32
    assert losses["loss_cql"].item() == pytest.approx(gap, rel=1e-6)
    (losses["loss_qvalue"] + losses["loss_cql"]).backward()
    assert all(w.grad is not None for w in weights(loss.value_network_params).values())
    assert all(w.grad is None for w in targets.values())

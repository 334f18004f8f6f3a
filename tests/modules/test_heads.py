"""Policy and value heads, which write tensors without a search for data frames."""

import math
from itertools import product
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.distributions import kl_divergence
from torch.nn import functional as F
from torch.nn.functional import one_hot
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    Unbounded,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob

from tests.numerics import assert_near
from torchrl_tit.modules import make_actor, make_squashed_actor, make_value

pytestmark = pytest.mark.numerics

NVEC = torch.tensor([[2, 3], [1, 4]])
DISCRETE = {
    "categorical": (Categorical(3), [3], {}),
    "categorical-int32": (Categorical(3, dtype=torch.int32), [3], {}),
    "several-categorical": (Categorical(3, shape=(2,)), [3, 3], {"batch_dims": 0}),
    "one-hot": (OneHot(3), [3], {}),
    "multi-categorical": (MultiCategorical([2, 3]), [2, 3], {}),
    "multi-categorical-matrix": (MultiCategorical(NVEC), [2, 3, 1, 4], {"batch_dims": 0}),
    "multi-one-hot": (MultiOneHot([2, 3]), [2, 3], {}),
    "binary": (Binary(3), [2, 2, 2], {}),
    "binary-bool-matrix": (Binary(shape=(1, 2), dtype=torch.bool), [2, 2], {"batch_dims": 0}),
}
MASKABLE = [name for name in DISCRETE if "binary" not in name]


def features(n=200):
    return TensorDict({"features": torch.randn(n, 16)}, [n])


def spread(actor):
    """Makes a head's distributions differ between rows, which its initial weights hardly do."""
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.copy_(torch.randn_like(parameter))
    return actor


def act(actor, td, kind=ExplorationType.RANDOM):
    with set_exploration_type(kind):
        return actor(td.clone())


def all_actions(spec, sizes):
    """Every action of a spec, [actions, *shape], and the options that it consists of."""
    options = torch.tensor(list(product(*map(range, sizes))))
    if isinstance(spec, OneHot):
        parts = [one_hot(x, n) for x, n in zip(options.unbind(-1), sizes, strict=True)]
        return torch.cat(parts, -1).to(spec.dtype), options
    return options.reshape(-1, *spec.shape).to(spec.dtype), options


def probabilities(actor, td, spec, sizes, options):
    """Probabilities of all actions by hand, [rows, actions]."""
    weight, bias = actor.parameters()
    flat = td["features"] @ weight.T + bias
    if isinstance(spec, Binary):  # the logit of "on"; that of "off" is 0
        flat = torch.stack([torch.zeros_like(flat), flat], -1).flatten(-2)
    if "action_mask" in td:
        flat = flat.masked_fill(~td["action_mask"], -torch.inf)
    components = [logits.softmax(-1) for logits in flat.split(sizes, -1)]
    chosen = [p[:, x] for p, x in zip(components, options.unbind(-1), strict=True)]
    return torch.stack(chosen).prod(0)


def some_mask(rows, sizes):
    """Random masks [rows, options] that allow an option of each component at least."""
    mask = torch.rand(rows, sum(sizes)) < 0.5
    for part in mask.split(sizes, -1):
        part.scatter_(-1, torch.randint(part.shape[-1], (rows, 1)), True)
    return mask


@pytest.mark.parametrize(
    ("name", "masked"),
    [*((name, False) for name in DISCRETE), *((name, True) for name in MASKABLE)],
)
def test_discrete_actions_against_enumeration(name, masked):
    spec, sizes, settings = DISCRETE[name]
    actor = make_actor(16, spec, mask_key="action_mask" if masked else None, **settings)
    spread(actor).double()
    td = features(5).double()
    if masked:
        td["action_mask"] = some_mask(5, sizes)
    actions, options = all_actions(spec, sizes)
    expected = probabilities(actor, td, spec, sizes, options)
    assert_near(expected.sum(-1), torch.ones(5, dtype=torch.float64))

    policy = actor.get_dist(td)
    each = actions.unsqueeze(1).expand(-1, 5, *spec.shape)
    assert_near(policy.log_prob(each).exp().T, expected)
    assert_near(policy.entropy(), torch.special.entr(expected).sum(-1))

    # Compiled losses draw samples of samples.
    assert policy.log_prob(policy.sample((2,))).shape == (2, 5)

    likely = act(actor, td, ExplorationType.DETERMINISTIC)
    assert torch.equal(likely["action"], actions[expected.argmax(-1)])

    drawn = act(actor, td[:1].expand(20_000))
    assert drawn["action"].shape == (20_000, *spec.shape)
    assert drawn["action"].dtype == spec.dtype
    assert spec.expand(20, *spec.shape).is_in(drawn["action"][:20])
    same = drawn["action"].reshape(20_000, 1, -1) == actions.reshape(1, len(actions), -1)
    which = same.all(-1).long().argmax(-1)
    assert_near(drawn["action_log_prob"], expected[0].log()[which])
    shares = which.bincount(minlength=len(actions)) / 20_000
    assert (shares - expected[0]).abs().max() < 0.02
    assert not shares[expected[0] == 0].any()


@pytest.mark.parametrize("name", [name for name in DISCRETE if "binary" in name or "hot" in name])
def test_the_mode_of_a_tie_is_an_action(name):
    spec, _, settings = DISCRETE[name]
    td = TensorDict({"features": torch.zeros(2, 16)}, [2])  # equal logits
    action = act(make_actor(16, spec, **settings), td, ExplorationType.DETERMINISTIC)["action"]
    assert spec.expand(2, *spec.shape).is_in(action)


@pytest.mark.parametrize("shape", [(), (2,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_continuous(shape, dtype):
    spec = Unbounded(shape, dtype=dtype)
    actor = make_actor(16, spec, batch_dims=0)
    td = act(actor, features())
    assert td["action"].shape == (200, *shape)
    assert td["action"].dtype == dtype
    assert torch.equal(td["scale"], torch.ones(200, *shape, dtype=dtype))
    assert td["action"].abs().max() > 1.5  # neither squashed nor clipped
    normal = torch.distributions.Normal(td["loc"], td["scale"])
    assert_near(td["action_log_prob"], normal.log_prob(td["action"]).reshape(200, -1).sum(-1))
    assert_near(actor.get_dist(td).entropy(), normal.entropy().reshape(200, -1).sum(-1))
    log_scale = [p for p in actor.parameters() if not p.any() and p.shape == (spec.shape.numel(),)]
    assert log_scale  # state-independent, learned, at 0
    td = act(actor, features(), ExplorationType.DETERMINISTIC)
    assert torch.equal(td["action"], td["loc"])


def test_the_deviation_starts_as_a_share_of_half_the_range():
    spec = Bounded(torch.tensor([-1.0, 0.0, 0.0]), torch.tensor([1.0, 10.0, torch.inf]))
    actor = make_actor(16, spec, std=0.4)
    assert_near(act(actor, features())["scale"][0], torch.tensor([0.4, 2.0, 0.4]))
    (scale,) = (m for m in actor.modules() if hasattr(m, "state_independent_scale"))
    torch.nn.init.constant_(scale.state_independent_scale, 3.0)
    actor.reset_parameters_recursive()
    assert_near(act(actor, features())["scale"][0], torch.tensor([0.4, 2.0, 0.4]))
    batched = spec.expand(5, 3)
    assert_near(
        act(make_actor(16, batched, batch_dims=1, std=0.4), features())["scale"][0],
        torch.tensor([0.4, 2.0, 0.4]),
    )


@pytest.mark.parametrize("name", ["categorical", "one-hot", "multi-categorical", "multi-one-hot"])
def test_a_batched_spec_gives_the_same_head(name):
    spec, _, _ = DISCRETE[name]
    td = act(make_actor(16, spec.expand(4, 7, *spec.shape)), features(28).reshape(4, 7))
    assert td["action"].shape == (4, 7, *spec.shape)


@pytest.mark.parametrize("spec", [Bounded(-1, 1, (8, 2)), Unbounded((8, 2)), Binary(shape=(8, 2))])
def test_a_batched_spec_that_does_not_tell_is_refused(spec):
    with pytest.raises(ValueError, match=r"shape=\[8, 2\].*: pass env.action_spec_unbatched"):
        make_actor(16, spec)
    assert act(make_actor(16, spec, batch_dims=1), features(8))["action"].shape == (8, 2)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("spec", [MultiCategorical([2, 3]), MultiOneHot([2, 3])])
def test_the_divergence_of_choices_and_its_gradient(spec, masked):
    """By enumeration, in float64; one component has fewer options than the other."""
    actor = make_actor(4, spec, mask_key="mask" if masked else None).double()
    for weight in actor.parameters():
        nn.init.normal_(weight)
    features = torch.randn(2, 6, 4, dtype=torch.float64)
    mask = torch.ones(6, 5, dtype=torch.bool)
    mask[:3, 4] = False
    p, q = (actor.get_dist(TensorDict({"features": x, "mask": mask}, [6])) for x in features)
    divergence = kl_divergence(p, q)
    every = [spec.rand() for _ in range(200)]
    actions = torch.stack(list({str(x.tolist()): x for x in every}.values())).unsqueeze(1)
    actions = actions.expand(-1, 6, *actions.shape[2:])
    logs, others = p.log_prob(actions), q.log_prob(actions)
    terms = torch.where(logs.isinf(), 0.0, logs.exp() * (logs - others))
    torch.testing.assert_close(divergence, terms.nan_to_num(0.0).sum(0))
    divergence.mean().backward()
    assert all(weight.grad.isfinite().all() for weight in actor.parameters())


def test_a_row_without_any_action_is_refused():
    actor = make_actor(16, MultiCategorical([2, 3]), mask_key=("agent", "mask"))
    mask = torch.ones(4, 5, dtype=torch.bool)
    mask[2, 2:] = False
    with pytest.raises(ValueError, match=r"\('agent', 'mask'\) allows no action at \[2, 1\]"):
        actor(features(4).set(("agent", "mask"), mask))
    with pytest.raises(ValueError, match=r"bool mask of the shape \[4, 5\], not torch.int8"):
        actor(features(4).set(("agent", "mask"), mask.to(torch.int8)))


def test_value_and_keys():
    td = TensorDict({"agent": {"value_features": torch.randn(5, 16)}}, [5])
    make_value(16, in_key=("agent", "value_features"))(td)
    assert td["agent", "state_value"].shape == (5, 1)
    td = TensorDict({"policy": torch.randn(5, 16)}, [5])
    assert make_actor(16, Categorical(2), in_key="policy", action_key="move")(td)["move"].shape == (
        5,
    )


LOW, HIGH = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 10.0])


def distribution(mean: float, std: float, dtype: torch.dtype, samples: int = 1000) -> TanhNormal:
    """That of the actor, whose mean and log standard deviation are leaves."""
    actor = make_squashed_actor(3, Bounded(LOW, HIGH))
    parameters = {
        "loc": torch.full((samples, 2), mean, dtype=dtype, requires_grad=True),
        "scale": torch.full((samples, 2), std, dtype=dtype, requires_grad=True),
    }
    return actor[-1].get_dist(TensorDict(parameters, [samples]))


def density(x: torch.Tensor, mean: float, std: float) -> torch.Tensor:
    """The exact log density of the action whose value before the tanh is x, float64 [..., 2]."""
    half = ((HIGH - LOW) / 2).double()
    normal = -(((x - mean) / std) ** 2) / 2 - math.log(std) - math.log(2 * math.pi) / 2
    return (normal - half.log() - 2 * (math.log(2) - x - F.softplus(-2 * x))).sum(-1)


@pytest.mark.parametrize("std", [0.5, 1.0, 7.0])
@pytest.mark.parametrize("mean", [0.0, -4.0, 8.0, 20.0])
def test_samples_have_their_exact_density_and_gradient(mean, std):
    """The value before the tanh is known: mean + std * noise."""
    dist = distribution(mean, std, torch.float32)
    torch.manual_seed(0)
    action, log_prob = rsample_and_log_prob(dist)
    assert (action >= LOW).all()
    assert (action <= HIGH).all()
    torch.manual_seed(0)
    x = dist.base_dist.rsample().detach().double()
    saturated = (x.abs() > 7.5).double().mean()
    assert saturated > 0.5 or mean < 8
    tolerance: Any = {"rtol": 1e-5, "atol": 1e-4}
    torch.testing.assert_close(log_prob.double(), density(x, mean, std), **tolerance)
    # With the noise fixed, only the width of the normal and the tanh change with the parameters.
    slopes = torch.autograd.grad(log_prob.sum(), [dist.loc, dist.scale])
    of_mean, noise = 2 * x.tanh(), (x - mean) / std
    torch.testing.assert_close(slopes[0].double(), of_mean, **tolerance)
    torch.testing.assert_close(slopes[1].double(), of_mean * noise - 1 / std, **tolerance)


@pytest.mark.parametrize(("dtype", "gap"), [(torch.float32, 1e-6), (torch.float64, 1e-15)])
def test_given_actions_at_a_bound_are_evaluated_next_to_it(dtype, gap):
    mean, std = 1.0, 0.5
    dist = distribution(mean, std, dtype, samples=2)
    log_prob = dist.log_prob(torch.stack([LOW, HIGH]).to(dtype))
    x = torch.tensor([[gap - 1] * 2, [1 - gap] * 2], dtype=dtype).atanh().double()
    tolerance: Any = {"rtol": 1e-5, "atol": 0}
    torch.testing.assert_close(log_prob.double(), density(x, mean, std), **tolerance)
    (slope,) = torch.autograd.grad(log_prob.sum(), dist.loc)
    torch.testing.assert_close(slope.double(), (x - mean) / std**2, **tolerance)

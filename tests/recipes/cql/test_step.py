"""A gradient step of continuous CQL against one written out by hand, on the same batch."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from recipes.cql import CQLAlgorithm
from tests.recipes.cql.cql_runs import make_algorithm, make_cql
from torchrl_tit.settings.networks import mlp

ORDER = ("temperature", "critic", "actor", "target")
BATCH, WEIGHT, SAMPLES, GAMMA, TAU = 200, 3.0, 4, 0.97, 0.1
RATES = {"temperature": 0.02, "critic": 3e-3, "actor": 1e-3}
ENTRIES = 3  # of an action of Hopper, each from -1 to 1

Layers = list[Tensor]  # weight, bias, weight, bias, ...


class Adam:
    """Kingma and Ba, arXiv 1412.6980, algorithm 1."""

    def __init__(self, weights: Layers, rate: float) -> None:
        self.weights, self.rate, self.steps = weights, rate, 0
        self.first = [torch.zeros_like(w) for w in weights]
        self.second = [torch.zeros_like(w) for w in weights]

    def descend(self, loss: Tensor) -> None:
        self.steps += 1
        gradients = torch.autograd.grad(loss, self.weights)
        for w, g, m, v in zip(self.weights, gradients, self.first, self.second, strict=True):
            m.copy_(0.9 * m + 0.1 * g)
            v.copy_(0.999 * v + 0.001 * g * g)
            unbiased = m / (1 - 0.9**self.steps), v / (1 - 0.999**self.steps)
            w.data -= self.rate * unbiased[0] / (unbiased[1].sqrt() + 1e-8)


class ByHand:
    """Actor, two critics and their targets as lists of weights, and one step on them."""

    def __init__(self, state: dict[str, Tensor]) -> None:
        def layers(network: str) -> Iterator[Tensor]:
            for name, weight in state.items():
                if name.startswith(f"{network}_params"):
                    yield weight.detach().clone()

        self.log_alpha = state["log_alpha"].detach().clone()
        self.actor = list(layers("actor_network"))
        stacked, targets = list(layers("qvalue_network")), list(layers("target_qvalue_network"))
        self.critics = [[w[i].clone() for w in stacked] for i in range(2)]
        self.targets = [[w[i].clone() for w in targets] for i in range(2)]
        trained = {
            "temperature": [self.log_alpha],
            "critic": [w for critic in self.critics for w in critic],
            "actor": self.actor,
        }
        for weight in chain(*trained.values()):
            weight.requires_grad_()
        self.adam = {name: Adam(weights, RATES[name]) for name, weights in trained.items()}

    def policy(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation before the tanh: one hidden layer, two linear heads."""
        hidden = F.relu(F.linear(state, *self.actor[:2]))
        log_std = F.linear(hidden, *self.actor[4:]).clamp(-20, 2)
        return F.linear(hidden, *self.actor[2:4]), log_std.exp()

    @staticmethod
    def value(critic: Layers, state: Tensor, action: Tensor) -> Tensor:
        x = torch.cat([state, action], -1)
        for i in range(0, len(critic) - 2, 2):
            x = F.relu(F.linear(x, *critic[i : i + 2]))
        return F.linear(x, *critic[-2:]).squeeze(-1)

    def step(self, batch: TensorDictBase, drawn: TensorDictBase, uniform: Tensor, order) -> None:
        """Steps everything once; the samples are those of the actor before its step."""
        s, a, after = batch["observation"], batch["action"], batch["next"]
        mean, std = self.policy(s)
        # The noise that the action was drawn with; the gradient flows through mean and std.
        noise = ((drawn["action"].detach().atanh() - mean) / std).detach()
        action, log_prob = squash(mean, std, noise)
        with torch.no_grad():
            next_mean, next_std = self.policy(after["observation"])
            next_action = next_mean.tanh()
            densities = [
                log_density(drawn["actions"][:, part], m.unsqueeze(1), d.unsqueeze(1))
                for part, m, d in (
                    (slice(SAMPLES), mean, std),
                    (slice(SAMPLES, None), next_mean, next_std),
                )
            ]

        def temperature() -> None:
            self.adam["temperature"].descend(
                -(self.log_alpha.exp() * (log_prob.detach() - ENTRIES)).mean()
            )

        def critic() -> None:
            with torch.no_grad():
                best = torch.minimum(
                    *(self.value(t, after["observation"], next_action) for t in self.targets)
                )
                alive = 1 - after["terminated"].squeeze(-1).double()
                target = after["reward"].squeeze(-1) + GAMMA * alive * best
            actions = torch.cat([2 * uniform - 1, drawn["actions"]], 1)
            states = s.unsqueeze(1).expand(-1, 3 * SAMPLES, -1)
            flat = torch.full_like(densities[0], ENTRIES * math.log(0.5))
            density = torch.cat([flat, *densities], 1)
            loss = torch.zeros((), dtype=torch.float64)
            for weights in self.critics:
                q = self.value(weights, s, a)
                soft_maximum = (self.value(weights, states, actions) - density).logsumexp(1)
                # Half the weight for each: the mean over the critics.
                loss = loss + (q - target).square().mean() + WEIGHT / 2 * (soft_maximum - q).mean()
            self.adam["critic"].descend(loss)

        def actor() -> None:
            worst = torch.minimum(*(self.value(c, s, action) for c in self.critics))
            self.adam["actor"].descend((self.log_alpha.exp().detach() * log_prob - worst).mean())

        def target() -> None:
            for kept, trained in zip(self.targets, self.critics, strict=True):
                for w, new in zip(kept, trained, strict=True):
                    w.copy_((1 - TAU) * w + TAU * new.detach())

        steps = {"temperature": temperature, "critic": critic, "actor": actor, "target": target}
        for name in order:
            steps[name]()


def squash(mean: Tensor, std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """An action, and its log density with the exact Jacobian of tanh."""
    action = (mean + std * noise).tanh()
    normal = -noise.square() / 2 - std.log() - math.log(2 * math.pi) / 2
    return action, (normal - (1 - action.square()).log()).sum(-1)


def log_density(action: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    return squash(mean, std, (action.atanh() - mean) / std)[1]


@pytest.fixture(scope="module")
def step(tmp_path_factory):
    """Two updates: the state before and after, the batch, and the samples of each."""
    folder = tmp_path_factory.mktemp("step")
    recipe = make_cql(
        folder,
        backbone=mlp(hidden_dim=12, num_layers=1, activation="relu"),
        conservative_weight=WEIGHT,
        action_samples=SAMPLES,
        batch_size=BATCH,
        gamma=GAMMA,
        tau=TAU,
        **{f"{name}_learning_rate": rate for name, rate in RATES.items()},
    )
    algorithm = make_algorithm(recipe)
    loss = algorithm.model.double()
    loss.log_alpha.data.fill_(math.log(0.4))
    batch = sample_doubles(algorithm)
    batch["action"] *= 0.9  # off the bounds, where densities are infinite
    draws: list[tuple[TensorDictBase, Tensor]] = []
    sample_policy = loss.sample_policy
    uniform = torch.rand(BATCH, SAMPLES, ENTRIES, dtype=torch.float64)

    def record(tensordict):
        samples = sample_policy(tensordict)
        draws.append((samples["policy_samples"], uniform))
        return samples

    loss.sample_policy = record
    algorithm.prepare(0, folder)
    before = {name: weight.clone() for name, weight in loss.state_dict().items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "rand", lambda *shape, **_: uniform.reshape(shape))
        for number in range(2):
            algorithm.update(batch, number)
    assert len(draws) == 2
    return before, ByHand(loss.state_dict()), batch, draws


def sample_doubles(algorithm: CQLAlgorithm) -> TensorDictBase:
    batch = algorithm.make_buffer().sample()
    return batch.apply(lambda x: x.double() if x.is_floating_point() else x)


def difference(left: ByHand, right: ByHand) -> float:
    """The largest difference between two sets of weights."""

    def weights(one: ByHand) -> Layers:
        return [one.log_alpha, *one.actor, *chain(*one.critics, *one.targets)]

    pairs = zip(weights(left), weights(right), strict=True)
    return max((a - b).abs().max().item() for a, b in pairs)


@pytest.mark.parametrize("order", [ORDER, ("actor", "temperature", "critic", "target")])
def test_the_order_is_temperature_critic_actor_target(step, order):
    """The actor reads temperature and critics that were stepped before."""
    before, after, batch, draws = step
    ours = ByHand(before)
    assert difference(ours, after) > 1e-3  # the updates did something
    for samples, uniform in draws:
        ours.step(batch, samples, uniform, order)
    same = difference(ours, after)
    assert same < 1e-8 if order == ORDER else same > 1e-6

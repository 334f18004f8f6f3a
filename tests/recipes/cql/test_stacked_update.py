"""One gradient step of several agents against one of each, with the same random numbers."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.recipes.cql.cql_runs import TIT, make_cql
from torchrl_tit.networks import MLPConfig
from torchrl_tit.objectives import PolicySamples

SEEDS = (3, 0, 7)
QUIET_TIT = replace(TIT, attention_dropout_outer=0.0, ffn_dropout_inner=0.0)
SETTINGS = [
    {"backbone": MLPConfig(hidden_dim=12, num_layers=1, activation="relu")},
    {"backbone": replace(QUIET_TIT, num_blocks=2, share_blocks=True), "over_critics": "sum"},
    {"backbone": QUIET_TIT, "critic": "backbone", "history": 4},
]


@pytest.fixture
def noise(monkeypatch):
    """Draws from fixed numbers; of ``noise.seed`` where agents are stepped one by one."""

    class Noise:
        seed: int | None = None
        normal = torch.randn(4, len(SEEDS), 8, 3, dtype=torch.float64)
        uniform = torch.rand(8, 4, 3, dtype=torch.float64)

        def draw(self, shape, dtype, device):
            """[B, A] and [m, B, A] of one seed, [N, B, A] and [m, N, B, A] of all."""
            numbers = self.normal if self.seed is None else self.normal[:, self.seed]
            return numbers[0].clone() if numbers.ndim > len(shape) else numbers.clone()

    noise = Noise()
    monkeypatch.setattr("torch.distributions.normal._standard_normal", noise.draw)
    monkeypatch.setattr(torch, "rand", lambda *shape, **_: noise.uniform.reshape(shape))
    return noise


def make_agents(recipe):
    for seed in SEEDS:
        torch.manual_seed(seed)
        agent = recipe.make_agent()
        agent.loss.double()
        yield agent.train() or agent


@pytest.mark.parametrize("nested", [False, True], ids=["loop", "vmap"])
@pytest.mark.parametrize("settings", SETTINGS, ids=["mlp", "tit", "backbone"])
def test_as_many_updates_of_one(tmp_path, noise, settings, nested):
    """``nested`` runs the critics through vmap too, as on a GPU."""
    recipe = make_cql(tmp_path, action_samples=4, actor_learning_rate=1e-3, tau=0.1, **settings)
    singles, agents = list(make_agents(recipe)), list(make_agents(recipe))
    for agent in agents:
        agent.loss.deactivate_vmap = not nested
        agent.loss._make_vmap()
    steps = [recipe.make_update(agent)[0] for agent in singles]
    together, _ = recipe.make_stacked_update(agents)
    buffer = recipe.make_buffer()
    start = {name: weight.clone() for name, weight in agents[0].state_dict().items()}
    for number in range(4):
        batches = [
            buffer.sample().apply(lambda x: x.double() if x.is_floating_point() else x)
            for _ in SEEDS
        ]
        expected = []
        for noise.seed, (step, batch) in enumerate(zip(steps, batches, strict=True)):
            expected.append(step(batch, number, 0))
        noise.seed = None
        terms = together(torch.stack(batches), number, 0)
        torch.testing.assert_close(terms, torch.stack(expected), rtol=1e-9, atol=1e-9)
    for one, agent in zip(singles, agents, strict=True):
        for name, weight in one.state_dict().items():
            torch.testing.assert_close(
                agent.state_dict()[name], weight, rtol=1e-9, atol=1e-9, msg=name
            )
    trained = {n for n, w in agents[0].state_dict().items() if not torch.equal(w, start[n])}
    networks = {name.partition("_params")[0] for name in trained}
    assert networks == {"actor_network", "qvalue_network", "target_qvalue_network", "log_alpha"}
    # Each seed has others, so nothing was mixed up unnoticed.
    assert len({agent.loss.log_alpha.item() for agent in agents}) == len(SEEDS)


def test_dropout_and_samples_differ_between_agents(tmp_path):
    recipe = make_cql(tmp_path, history=2)
    agents = [recipe.make_agent(), recipe.make_agent()]
    agents[1].load_state_dict(agents[0].state_dict())
    loss = recipe.make_stacked_update(agents)[0].loss
    batch = recipe.make_buffer().sample().expand(2, recipe.batch_size)
    agents[0].train()
    first, second = loss.sample_policy(batch).next_action  # tanh of the mean
    assert not torch.equal(first, second)
    agents[0].eval()
    samples = loss.sample_policy(batch)
    first, second = samples.next_action
    torch.testing.assert_close(first, second)
    assert not torch.isclose(samples.action[0], samples.action[1]).any()
    losses = loss.critic_losses(
        batch, PolicySamples(*(part[:1].expand_as(part) for part in samples))
    )
    assert losses[0][0] == losses[0][1]
    assert losses[1][0] != losses[1][1]  # uniform actions


class Count(TorchDispatchMode):
    """Counts operations, each of which a GPU would be launched for."""

    number = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.number += 1
        return func(*args, **(kwargs or {}))


def test_more_agents_take_no_more_operations(tmp_path):
    recipe = make_cql(tmp_path, backbone=MLPConfig())
    batch = recipe.make_buffer().sample()
    numbers = []
    for size in (2, 5):
        agents = [recipe.make_agent() for _ in range(size)]
        for agent in agents:
            agent.loss.deactivate_vmap = False
            agent.loss._make_vmap()
        update, _ = recipe.make_stacked_update(agents)
        update(batch.expand(size, *batch.shape), 0, 0)  # Adam begins
        with Count() as count:
            update(batch.expand(size, *batch.shape), 1, 0)
        numbers.append(count.number)
    assert numbers[0] == numbers[1] > 100

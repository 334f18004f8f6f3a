"""Recipes of Online Decision Transformer: its own episodes, resuming, and LAMB."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from torch.distributions import Normal, TanhTransform, TransformedDistribution

from recipes.core import runner
from recipes.core.metrics import read_metrics
from recipes.online_decision_transformer import OnlineData, make_lamb
from tests.datasets.rollouts import roll
from tests.recipes.ppo import tasks
from tests.recipes.small import SMALL_DT, make_algorithm, make_odt, train
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.datasets import (
    SequenceStorage,
    episodes_from_arrays,
    load_episodes,
    select_episodes,
)
from torchrl_tit.settings.networks import dt_tit

pytestmark = pytest.mark.filterwarnings("ignore:target_returns")


def test_a_step_is_the_protocols(tmp_path):
    """Weights and temperature after two steps on the likelihood and entropy of unmasked steps.

    Gradients are clipped, LAMB warms up, and the temperature follows the entropy.
    """
    backbone = dt_tit(**SMALL_DT, timestep_embedding=False, dropout=0.0)
    settings: dict[str, Any] = {"pretraining_updates": 2, "rounds": 0, "evaluation_episodes": 1}
    settings |= {"return_scale": 50.0, "weight_decay": 1.0, "alpha_learning_rate": 0.1}
    recipe = make_odt(tmp_path, backbone=backbone, **settings)
    _, state = load_checkpoint(train(recipe, tmp_path / "run").checkpoints)

    episodes = load_episodes(recipe.dataset)
    mean, std, _ = episodes.observation_statistics()
    storage = SequenceStorage(episodes, 6, return_scale=50.0)
    seed = np.random.SeedSequence([recipe.seed, 0]).generate_state(1).item()
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(recipe.seed)
    agent = make_algorithm(recipe).model
    agent.network.history_encoder.return_scale.fill_(1.0)
    optimizer = make_lamb(list(agent.parameters()), 1.0, 1.0)
    log_alpha = torch.tensor(0.1).log().requires_grad_()
    alpha_optimizer = torch.optim.Adam([log_alpha], lr=0.1)
    for step in range(2):
        batch = storage[torch.randint(len(storage), (8,), generator=generator)]
        batch["observation"] = (batch["observation"] - mean) / (std + 1e-6)
        names = ("observation", "action", "return_to_go", "timestep", "mask")
        features = agent.network.every_frame(*(batch[name] for name in names))
        normal = Normal(*agent.head(features))
        policy = TransformedDistribution(normal, TanhTransform())
        action = batch["action"].clamp(-1 + 1e-6, 1 - 1e-6)
        likelihood = policy.log_prob(action).sum(-1)[batch["mask"]].mean()
        drawn = normal.rsample()
        surprise = normal.log_prob(drawn) - TanhTransform().log_abs_det_jacobian(drawn, drawn)
        entropy = -surprise.sum(-1)[batch["mask"]].mean()
        optimizer.zero_grad()
        (-likelihood - log_alpha.exp().detach() * entropy).backward()
        torch.nn.utils.clip_grad_norm_(agent.parameters(), 0.25)
        optimizer.param_groups[0]["lr"] = 1e-3 * (step + 1) / 4
        optimizer.step()
        alpha_optimizer.zero_grad()
        (log_alpha.exp() * (entropy.detach() + 3)).backward()
        alpha_optimizer.step()
    for name, weight in agent.named_parameters():
        trained = state["networks"][name]
        torch.testing.assert_close(trained, weight.detach(), rtol=1e-4, atol=1e-6, msg=name)
    torch.testing.assert_close(state["alpha"]["value"], log_alpha.detach(), rtol=1e-4, atol=1e-5)


def test_no_number_depends_on_padding(tmp_path):
    backbone = dt_tit(**SMALL_DT, timestep_embedding=False, dropout=0.0)
    algorithm = make_algorithm(make_odt(tmp_path, backbone=backbone))
    algorithm.prepare(0, tmp_path)
    batch = next(algorithm.batches())
    assert not batch["mask"].all()
    other = batch.clone()
    other["observation"][~batch["mask"]] = 5.0
    terms = []
    for samples in (batch, other):
        torch.manual_seed(0)
        terms.append(algorithm.loss(samples))
    for name, value in terms[0].items():
        torch.testing.assert_close(terms[1][name], value, msg=name)


def test_what_a_run_writes(tmp_path):
    recipe = make_odt(tmp_path)
    with train(recipe, tmp_path / "run") as run:
        rows = read_metrics(run.folder / "metrics.csv")
        evaluation = runner.evaluate(run)
    evaluated = [row["step"] for row in rows if not math.isnan(row["return_mean"])]
    assert evaluated == [6, 14, 18]  # after pre-training, two rounds, and the last one
    by_step = {row["step"]: row for row in rows}
    assert math.isnan(by_step[5]["online_return"])
    assert not math.isnan(by_step[15]["online_return"])
    assert by_step[15]["alpha"] != by_step[5]["alpha"]
    assert math.isnan(by_step[18]["alpha"])  # an evaluation between two rows has its own
    assert evaluation["steps"] == 18
    assert evaluation["targets"].keys() == {"40", "10"}


def test_explores_with_drawn_actions_and_keeps_observations_as_they_are(tmp_path):
    algorithm = make_algorithm(make_odt(tmp_path))
    algorithm.model.network.frames[0].mean.fill_(100.0)
    first, again, other = (algorithm.explore(number) for number in (0, 0, 1))
    assert len(first.lengths) == 1
    assert first.finished.all()
    assert 1.0 < first.rows["observation"][0, 0] < 1.5  # Hopper's height, not normalized
    assert torch.equal(first.rows["observation"][0], again.rows["observation"][0])
    assert not torch.equal(first.rows["observation"][0], other.rows["observation"][0])
    actions = [episode.rows["action"][0] for episode in (first, again)]
    assert not torch.equal(*actions)
    assert algorithm.model.training


def test_explores_with_its_own_target_and_noise(tmp_path, monkeypatch):
    recipe = make_odt(tmp_path, exploration_scale=1e-6)
    algorithm = make_algorithm(recipe)
    targets = []

    def make_env(*settings, target_return):
        targets.append(target_return)
        return type(algorithm).make_env(algorithm, *settings, target_return=target_return)

    monkeypatch.setattr(algorithm, "make_env", make_env)
    first, again = (algorithm.explore(0).rows["action"] for _ in range(2))
    assert targets == [recipe.online_return] * 2
    torch.testing.assert_close(first, again, rtol=0, atol=1e-3)  # nor is anything dropped out


def test_episodes_side_by_side_are_whole_and_differ(tmp_path):
    episodes = make_algorithm(make_odt(tmp_path, episodes_per_round=4)).explore(0)
    assert len(episodes.lengths) == 4
    assert episodes.finished.all()
    assert len(set(episodes.returns.tolist())) == 4
    starts = episodes.rows["observation"][episodes.last_rows - episodes.lengths + 1]
    assert (starts[:, 0] > 1.2).all()  # each upright, as an episode begins


def test_a_reward_that_is_not_finite_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", tasks.__name__)
    wrappers = (f"{tasks.__name__}:Paying(reward='nan')",)
    algorithm = make_algorithm(make_odt(tmp_path, wrappers=wrappers))
    with pytest.raises(FloatingPointError, match=r"^the reward of copy 0 is nan$"):
        algorithm.explore(0)


def make_data(capacity):
    episodes = episodes_from_arrays(**roll())

    def make_storage(data):
        return SequenceStorage(data, 4, action_padding=0.0)

    data = OnlineData(episodes, make_storage, batch_size=16, capacity=capacity, seed=0)
    return episodes, data


def test_the_store_begins_with_the_best_episodes_and_forgets_the_oldest():
    episodes, data = make_data(capacity=4)
    best = episodes.returns.argsort(stable=True)[-4:]
    expected = episodes.returns[best].tolist()
    for number in range(6):
        new = select_episodes(episodes, torch.tensor([number]))
        data.add(new)
        expected = [*expected, new.returns.item()][-4:]
        assert data._episodes.returns.tolist() == expected
        assert data.sample()["observation"].shape == (16, 4, 11)
    restored = make_data(capacity=4)[1]
    restored.load_state_dict(data.state_dict())
    assert (restored._episodes.rows == data._episodes.rows).all()
    assert restored.newest_return == data.newest_return
    assert all((restored.sample() == data.sample()).all() for _ in range(3))


def test_actions_have_a_likelihood():
    arrays = roll()
    arrays["actions"] = np.sign(arrays["actions"]).astype(np.float32)
    data = OnlineData(
        episodes_from_arrays(**arrays),
        lambda episodes: SequenceStorage(episodes, 4, action_padding=0.0),
        batch_size=8,
        capacity=4,
        seed=0,
    )
    highest = data.sample()["action"].abs().max()
    assert 1 - 2e-6 < highest < 1


def test_lamb_is_that_of_the_release():
    torch.manual_seed(0)
    wide = nn.Linear(300, 300)
    nn.init.normal_(wide.weight)  # a norm of 300: not cut off
    weights = [p.detach().clone() for p in wide.parameters()]
    optimizer = make_lamb(list(wide.parameters()), learning_rate=0.01, weight_decay=0.1)
    moments = [(torch.zeros_like(w), torch.zeros_like(w)) for w in weights]
    for _ in range(3):
        optimizer.zero_grad()
        wide(torch.randn(16, 300)).square().mean().backward()
        for index, parameter in enumerate(wide.parameters()):
            assert parameter.grad is not None
            mean, square = moments[index]
            mean = 0.9 * mean + 0.1 * parameter.grad
            square = 0.999 * square + 0.001 * parameter.grad**2
            moments[index] = mean, square
            update = mean / (square.sqrt() + 1e-8) + 0.1 * weights[index]
            trust = weights[index].norm() / update.norm()
            weights[index] = weights[index] - 0.01 * trust * update
        optimizer.step()
    for parameter, expected in zip(wide.parameters(), weights, strict=True):
        torch.testing.assert_close(parameter.detach(), expected, rtol=1e-4, atol=1e-5)

"""Networks that carry a state, in every algorithm that learns from samples."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

from recipes.dqn import DQN
from recipes.sac import SAC
from tests.recipes.small import BC, CQL, IQL, TD3BC, DiscreteCQL, make, make_algorithm
from torchrl_tit.modules import Backbone, as_sequences
from torchrl_tit.settings import HistorySettings
from torchrl_tit.settings.networks import lstm

BURN_IN, LENGTH = 3, 5
CASES = [
    (DQN, "CartPole-v1", "lstm"),
    (SAC, "Pendulum-v1", "gru"),
    (BC, "Hopper-v5", "mingru"),
    (IQL, "Hopper-v5", "mamba2"),
    (IQL, "CartPole-v1", "lstm"),
    (TD3BC, "Hopper-v5", "lstm"),
    (CQL, "Hopper-v5", "gated-deltanet"),
    (DiscreteCQL, "CartPole-v1", "lstm"),
]


def recipe_of(kind, env, history, folder):
    """A recipe whose critics have memories too, if they can, and slices with ends of episodes."""
    backbone = lstm(embed_dim=8, hidden_dim=8, features_dim=8)
    fields = {
        "backbone": replace(backbone, history=HistorySettings.get(history)()),
        "env": env,
        "batch_size": 4 * LENGTH,
        "slice_length": LENGTH,
        "burn_in": BURN_IN,
    }
    if kind in (SAC, IQL, TD3BC, CQL):
        fields["critic"] = "backbone"
    if kind in (SAC, DQN):
        limit = ("max_episode_steps=6",)
        return kind(steps_per_batch=40, random_steps=40, num_envs=2, env_settings=limit, **fields)
    return make(kind, folder, **fields)


def terms_of(algorithm, samples):
    """All terms of the losses, with the same random numbers at each call."""
    torch.manual_seed(0)
    if isinstance(algorithm.recipe, CQL):
        samples = algorithm.model.sample_policy(samples)
    terms = dict(algorithm.loss(samples).items())
    if isinstance(algorithm.recipe, CQL | TD3BC):
        terms |= algorithm.actor_loss(samples)
    return terms


def gradients_of(algorithm, terms):
    algorithm.model.zero_grad()
    sum(term for name, term in terms.items() if name.startswith("loss_")).backward()
    return {
        name: weight.grad.clone()
        for name, weight in algorithm.model.named_parameters()
        if weight.grad is not None
    }


def one_after_the_other(raw):
    """What a backbone then does: it reads single steps, and from each the one that followed."""

    def read(backbone, observation, state, is_init):
        step = {"history": observation.unsqueeze(1), "is_init": is_init, **state}
        with set_recurrent_mode(False):
            outputs = backbone.encode_steps(TensorDict(step, [len(observation)]))
        features = [outputs[key] for key in backbone.features_keys]
        return features, {key: outputs["next", key] for key in state}

    def encode(backbone, sequence):
        following = bool(sequence["position"][0, 0])  # from 1 on
        count, found = len(raw), []
        state = {
            key: torch.zeros(count, *shape, dtype=torch.float64)
            for key, shape in backbone.state_shapes.items()
        }
        for time in range(raw.shape[1]):
            if time == BURN_IN:
                state = {key: value.detach() for key, value in state.items()}
            now, after = raw[:, time], raw["next"][:, time]
            features, state = read(backbone, now["observation"], state, now["is_init"])
            if following:
                no_init = torch.zeros_like(now["is_init"])
                features, _ = read(backbone, after["observation"], state, no_init)
            found.append(features)
        stacked = (torch.stack(x[BURN_IN:], 1) for x in zip(*found, strict=True))
        return dict(zip(backbone.features_keys, stacked, strict=True))

    return lambda backbone, sequence: encode(backbone, sequence)


@pytest.mark.numerics
@pytest.mark.parametrize(("kind", "env", "history"), CASES, ids=lambda x: getattr(x, "__name__", x))
def test_losses_of_sequences_are_those_of_steps(kind, env, history, tmp_path, monkeypatch):
    torch.manual_seed(0)
    algorithm = make_algorithm(recipe_of(kind, env, history, tmp_path))
    with torch.no_grad():  # targets of their own
        for name, weight in algorithm.model.state_dict().items():
            if name.startswith("target_") and weight.is_floating_point():
                weight.mul_(0.9)
    algorithm.prepare(0, tmp_path)
    storage = algorithm.buffer.storage
    if kind in (SAC, DQN):
        batch = next(iter(algorithm.collector))
        algorithm.close()
        algorithm.buffer.extend(algorithm.collected(batch).select(*storage_keys(batch)))
    algorithm.model.double()
    every: Any = torch.arange(storage.shape[0])
    every = (every, torch.zeros_like(every)) if kind in (SAC, DQN) else every
    second, third = storage.get(every)["is_init"].flatten().nonzero().flatten()[1:3]
    first = torch.cat([second - torch.arange(1, 7), third - torch.arange(1, 7)])
    index = first.unsqueeze(1) + torch.arange(BURN_IN + LENGTH)
    raw = storage.get((index, torch.zeros_like(index)) if kind in (SAC, DQN) else index)
    raw = raw.apply(lambda x: x.double() if x.is_floating_point() else x)
    begins, terminated = raw["is_init"].squeeze(-1), raw["next", "terminated"].squeeze(-1)
    assert begins[:, 1:BURN_IN].any()
    assert len(set(begins[:, BURN_IN + 1 :].sum(1).tolist())) > 1
    if kind is SAC:  # time limits, after which there are values
        assert (begins[:, BURN_IN + 1 :] & ~terminated[:, BURN_IN:-1]).any()

    terms = terms_of(algorithm, as_sequences(raw, BURN_IN))
    gradients = gradients_of(algorithm, terms)
    monkeypatch.setattr(Backbone, "_encode_arranged", one_after_the_other(raw))
    expected = terms_of(algorithm, as_sequences(raw, BURN_IN))
    torch.testing.assert_close(terms, expected, rtol=1e-9, atol=1e-9)
    expected_gradients = gradients_of(algorithm, expected)
    torch.testing.assert_close(gradients, expected_gradients, rtol=1e-8, atol=1e-9)


def storage_keys(batch):
    following = ("observation", "reward", "terminated", "done")
    return ["observation", "action", *(("next", name) for name in following)]

"""Updates of behavior cloning, IQL and TD3+BC against their formulas, and what they read."""

from __future__ import annotations

import math
import shutil
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict.nn import set_skip_existing
from torch import nn
from torch.nn import functional as F
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import BCLoss

from recipes.bc import BCAlgorithm
from recipes.core.compilation import compile_and_time
from recipes.core.networks import ActionMLP
from recipes.cql import CQL, DiscreteCQL
from recipes.dqn import DQN
from recipes.offline import read_data, with_spaces
from recipes.sac import SAC
from tests.datasets.rollouts import roll, write
from tests.recipes.offline.test_without_env import log_machine
from tests.recipes.small import (
    BC,
    IQL,
    SMALL,
    TD3BC,
    double,
    make,
    make_algorithm,
    make_cartpole_data,
    make_data,
    make_dt,
    tit,
    train,
)
from torchrl_tit.datasets import HistoryStorage, load_episodes
from torchrl_tit.settings.networks import lstm, mlp


def value(loss, network, td, params=None):
    """What a value network says of states, and of their actions if it reads them; [critics, B]."""
    weights = getattr(loss, f"{params or network}_params")
    module = getattr(loss, network)

    def of(single):
        with single.data.to_module(module):
            out = module(td.select(*module.in_keys).clone())
        return out[module.out_keys[-1]].detach()

    if weights.ndim:
        return torch.stack([of(single) for single in weights.unbind(0)]).squeeze(-1)
    return of(weights).squeeze(-1)


def weights_of(loss, keep=False):
    """The weights, or copies of them, without the bounds of actions and the statistics."""
    others = ("low", "high", ".count", ".mean", ".variance")
    weights = {n: w for n, w in loss.state_dict().items() if not n.endswith(others)}
    return weights if keep else {name: weight.clone() for name, weight in weights.items()}


def moved(before, after, prefix):
    return any(not torch.equal(after[n], before[n]) for n in before if n.startswith(prefix))


def assert_follows(before, after, network, tau):
    """Targets step towards the weights as they are after the update."""
    names = [
        n for n in before if n.startswith(f"target_{network}") and before[n].is_floating_point()
    ]
    assert names
    for name in names:
        expected = (1 - tau) * before[name] + tau * after[name.removeprefix("target_")]
        torch.testing.assert_close(after[name], expected)


@pytest.mark.parametrize("env", ["Hopper-v5", "CartPole-v1"])
def test_behavior_cloning(tmp_path, env):
    algorithm, batch = double(make(BC, tmp_path, env=env), tmp_path)
    for name, weight in weights_of(algorithm.model, keep=True).items():
        if name.startswith("actor") and tuple(weight.shape) == (3, 8):
            weight.mul_(100)  # means that the tanh keeps within the bounds
    weights = weights_of(algorithm.model)
    by_shape = {tuple(w.shape): w for n, w in weights.items() if n.startswith("actor")}
    with torch.no_grad():
        features = algorithm.policy(batch.clone())["features"]
    if env == "CartPole-v1":
        logits = F.linear(features, by_shape[2, 8], by_shape[2,])
        expected = F.cross_entropy(logits, batch["action"])
    else:
        mean = F.linear(features, by_shape[3, 8], bias_of(weights, 3)).tanh()
        std = torch.ones(3, dtype=torch.float64)  # exp(0) at the start
        normal = (batch["action"] - mean) ** 2 / (2 * std**2) + std.log()
        expected = (normal + math.log(2 * math.pi) / 2).sum(-1).mean()
        with set_skip_existing(True):  # TorchRL's, which is right for actions that are floats
            theirs = BCLoss(algorithm.policy)(batch.clone())["loss_bc"]
        torch.testing.assert_close(theirs, expected)
    terms = algorithm.update(batch, 0)
    torch.testing.assert_close(terms["loss_bc"], expected)
    assert moved(weights, algorithm.model.state_dict(), "actor")


def bias_of(weights, size):
    """The bias of a linear layer, which is not the logarithm of the standard deviation."""
    (bias,) = (w for n, w in weights.items() if tuple(w.shape) == (size,) and n.endswith("bias"))
    return bias


@pytest.mark.parametrize("env", ["Hopper-v5", "CartPole-v1"])
def test_iql(tmp_path, env):
    discrete = env == "CartPole-v1"
    recipe = make(IQL, tmp_path, env=env, tau=0.1, gamma=0.9, expectile=0.8, temperature=2.0)
    algorithm, batch = double(recipe, tmp_path)
    loss = algorithm.model
    with torch.no_grad():  # targets of their own, and advantages that are not all small
        for name, weight in weights_of(loss, keep=True).items():
            if name.startswith("target_"):
                weight.add_(0.3 * torch.randn_like(weight))
    batch["next", "terminated"][::2] = True
    batch["action"] *= 1 if discrete else 0.9
    action = batch["action"]

    def chosen(values):
        return (
            values.gather(-1, action.expand(2, -1).unsqueeze(-1)).squeeze(-1)
            if discrete
            else values
        )

    q = chosen(value(loss, "qvalue_network", batch))
    worst = chosen(value(loss, "qvalue_network", batch, "target_qvalue_network")).min(0).values
    v, following = (value(loss, "value_network", td) for td in (batch, batch["next"]))
    with torch.no_grad():  # so that advantages have both signs
        shift = (worst - v).median()
        loss.value_network_params["module", "0", "module", "2", "bias"].add_(shift)
    v, following = v + shift, following + shift
    difference = worst - v
    assert (difference > 0).any()
    assert (difference < 0).any()
    expected = {"loss_value": torch.where(difference > 0, 0.8, 0.2).mul(difference**2).mean()}
    alive = 1 - batch["next", "terminated"].squeeze(-1).double()
    target = batch["next", "reward"].squeeze(-1) + 0.9 * alive * following
    expected["loss_qvalue"] = (q - target).square().sum(0).mean()
    log_prob = algorithm.policy.get_dist(batch.clone()).log_prob(action).detach()
    weight = (2.0 * difference).exp().clamp(max=100)
    expected["loss_actor"] = -(weight * log_prob).mean()
    expected["nll"] = -log_prob.mean()

    before = weights_of(loss)
    terms = algorithm.update(batch, 6)
    torch.testing.assert_close(dict(terms), expected)
    after = loss.state_dict()
    assert_follows(before, after, "qvalue_network", 0.1)
    for network in ("actor_network", "qvalue_network", "value_network"):
        assert moved(before, after, network)
    # The actor's rate is a third of the way down a cosine; the others' stays.
    decayed, policy = algorithm.optimizer.param_groups[0]["params"], algorithm.policy.parameters()
    assert set(map(id, decayed)) == set(map(id, policy))
    actor, others = (group["lr"] for group in algorithm.optimizer.param_groups)
    assert actor == pytest.approx(recipe.learning_rate * 0.75)
    assert others == recipe.learning_rate


def test_iql_scales_rewards(tmp_path):
    recipe = make(IQL, tmp_path)
    algorithm, _ = double(recipe, tmp_path)
    scaled = algorithm.load_data()
    returns, longest = scaled.returns[scaled.finished], scaled.lengths[scaled.finished].max()
    assert (returns.max() - returns.min()).item() == pytest.approx(longest.item(), rel=1e-4)


def test_iql_says_where_rewards_cannot_be_scaled(tmp_path):
    rolled = roll()
    rolled["rewards"][:] = 0
    data = str(write(tmp_path / "same.hdf5", rolled))
    algorithm = make_algorithm(make(IQL, tmp_path, dataset=data))
    with pytest.warns(UserWarning, match="no two whole episodes differ in return, so rewards are"):
        episodes = algorithm.load_data()
    assert not episodes.rows["reward"].any()


def test_td3bc(tmp_path):
    recipe = make(TD3BC, tmp_path, tau=0.1, gamma=0.9, policy_noise=0.4)
    algorithm, batch = double(recipe, tmp_path)
    loss = algorithm.model
    with torch.no_grad():
        for name, weight in weights_of(loss, keep=True).items():
            if name.startswith("target_"):
                weight.add_(0.1 * torch.randn_like(weight))
    batch["next", "terminated"][::2] = True
    torch.manual_seed(5)
    noise = (torch.randn_like(batch["action"]) * 0.4).clamp(-0.5, 0.5)
    assert (noise.abs() == 0.5).any()

    def act(td, params):
        with getattr(loss, params).data.to_module(loss.actor_network):
            return loss.actor_network(td.clone())["action"].detach()

    following = batch["next"].clone()
    following["action"] = (act(following, "target_actor_network_params") + noise).clamp(-1, 1)
    worst = value(loss, "qvalue_network", following, "target_qvalue_network").min(0).values
    alive = 1 - batch["next", "terminated"].squeeze(-1).double()
    target = batch["next", "reward"].squeeze(-1) + 0.9 * alive * worst
    expected = (value(loss, "qvalue_network", batch) - target).square().sum(0).mean()

    before = weights_of(loss)
    torch.manual_seed(5)
    terms = dict(algorithm.update(batch, 0))
    torch.testing.assert_close(terms["loss_qvalue"], expected)
    after = weights_of(loss)
    for network in ("actor_network", "qvalue_network"):
        assert moved(before, after, network)
        assert_follows(before, after, network, 0.1)
    # The actor's loss saw the critics after their step, and the actor before its own.
    own = batch.clone()
    old = {n: w for n, w in before.items() if n.startswith("actor")}
    loss.load_state_dict({**after, **old})
    own["action"] = act(batch, "actor_network_params")
    q = value(loss, "qvalue_network", own)[0]
    cloning = (own["action"] - batch["action"]).square().mean()
    torch.testing.assert_close(terms["loss_bc"].double(), cloning, rtol=1e-6, atol=1e-6)
    actor = -2.5 * q.mean() / q.abs().mean() + cloning
    torch.testing.assert_close(terms["loss_actor"].double(), actor, rtol=1e-6, atol=1e-6)

    # Every second step is one of the critics alone, which reports the actor's last terms.
    loss.load_state_dict(after)
    again = algorithm.update(batch, 1)
    last = loss.state_dict()
    assert moved(after, last, "qvalue_network")
    assert not moved(after, last, "actor_network")
    assert not moved(after, last, "target_")
    assert again["loss_actor"] == terms["loss_actor"]


def test_the_noise_of_td3bcs_target_follows_the_range_of_actions(tmp_path):
    loss = make_algorithm(make(TD3BC, tmp_path, env="Pendulum-v1")).model  # from -2 to 2
    assert (loss.policy_noise.item(), loss.noise_clip.item()) == pytest.approx((0.4, 1.0))


@pytest.mark.parametrize(
    ("kind", "term"),
    [(BC, "loss_bc"), (IQL, "loss_qvalue"), (TD3BC, "loss_qvalue"), (CQL, "loss_qvalue")],
)
def test_a_loss_that_is_not_finite_stops_the_run(tmp_path, kind, term):
    algorithm, batch = double(make(kind, tmp_path), tmp_path)
    batch["action" if kind is BC else ("next", "reward")][0] = torch.nan
    with pytest.raises(FloatingPointError, match=f"{term} became nan"):
        algorithm.update(batch, 0)


def test_a_gradient_that_is_not_finite_is_not_saved(tmp_path, monkeypatch):
    def loss(self, samples):
        weight = next(self.model.parameters())
        return {**self.model(samples), "loss_root": (0 * weight).square().sum().sqrt()}

    monkeypatch.setattr(BCAlgorithm, "loss", loss)
    with pytest.raises(
        FloatingPointError, match=r"^the weight .* became nan in .*; none was saved"
    ):
        train(make(BC, tmp_path, total_updates=1), tmp_path / "run")


def test_nothing_that_is_measured_has_dropout(tmp_path):
    settings: dict[str, Any] = {"critic": "backbone", "validation_fraction": 0.5}
    recipe = make(IQL, tmp_path, backbone=tit(3), **settings)  # which have dropout
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, tmp_path)
    critic = vars(algorithm.model)["qvalue_network"]
    modes = [part.training for part in critic.modules()]
    found = [algorithm.measure(0).values]
    algorithm.recipe = replace(recipe, evaluation_seed=7)
    assert [*found, algorithm.measure(0).values] == found * 2
    assert [part.training for part in critic.modules()] == modes


@pytest.mark.parametrize("kind", [SAC, CQL, IQL, TD3BC])
def test_critics_start_as_they_were_built(tmp_path, kind, monkeypatch):
    """Of a single one, TorchRL's loss makes a copy whose weights it draws anew."""
    built = []

    def make_mlp(*sizes, **layers):
        network = ActionMLP(*sizes, **layers)  # Pendulum's bounds are -2 and 2
        built.append({name: weight.clone() for name, weight in network.state_dict().items()})
        return network

    monkeypatch.setattr("recipes.core.networks.ActionMLP", make_mlp)
    settings: dict[str, Any] = {"env": "Pendulum-v1", "backbone": SMALL, "critic_hidden": (16,)}
    recipe = SAC(**settings) if kind is SAC else make(kind, tmp_path, **settings)
    loss = make_algorithm(recipe).model
    stacked = loss.qvalue_network_params.flatten_keys(".")
    for key, weights in stacked.items():
        if key.endswith(("weight", "bias")):
            name = ".".join(key.split(".")[-2:])
            assert torch.equal(weights, torch.stack([critic[name] for critic in built[:2]]))
            assert not torch.equal(*weights)


@pytest.mark.parametrize("critic", ["mlp", "backbone"])
def test_all_networks_normalize_observations(tmp_path, critic):
    recipe = make(TD3BC, tmp_path, backbone=tit(3), critic=critic)
    assert recipe.normalize_observations
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, tmp_path)
    rows = algorithm.load_data().rows["observation"]
    for statistic, expected in {"mean": rows.mean(0), "variance": rows.var(0)}.items():
        buffers = [
            buffer
            for name, buffer in algorithm.model.named_buffers()
            if name.endswith(f"observation.{statistic}" if critic == "backbone" else statistic)
        ]
        assert len(buffers) == 4  # of actor, critics and their targets
        for buffer in buffers:
            torch.testing.assert_close(buffer, expected.expand_as(buffer), rtol=0.05, atol=0.05)


def test_an_entry_that_is_constant_in_the_data_may_change_later(tmp_path):
    """Its deviation counts as 1: the authors of TD3+BC only add 1e-3, and read 0.5 as 500."""
    rolled = roll()
    for name in ("observations", "next_observations"):
        rolled[name][:, 0] = 1.25
    data = str(write(tmp_path / "constant.hdf5", rolled))
    algorithm = make_algorithm(make(TD3BC, tmp_path, dataset=data))
    algorithm.prepare(0, tmp_path)
    seen = torch.as_tensor(rolled["observations"])
    seen[:, 0] += 0.5
    frames = algorithm.policy.module[0].module.frame_encoders["observation"]
    normal = frames.normalize(seen)
    with pytest.warns(UserWarning, match=r"constant\.hdf5: entries 0 of the observations are con"):
        mean, std, _ = algorithm.load_data().observation_statistics()
    assert std[0] == 1
    torch.testing.assert_close(normal, (seen - mean) / (std + 1e-3))
    torch.testing.assert_close(normal[:, 0], torch.full((len(seen),), 0.5 / 1.001))


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (BC, {}),
        *((kind, {"critic": "backbone"}) for kind in (IQL, TD3BC, CQL)),
        (CQL, {"critic": "backbone", "backbone": lstm(3, embed_dim=8, hidden_dim=8)}),
        (DiscreteCQL, {"padding": "constant"}),
        (SAC, {"env": "Hopper-v5", "critic": "backbone"}),
        (SAC, {"env": "Hopper-v5", "critic": "mlp", "padding": "constant"}),
        (DQN, {"env": "CartPole-v1"}),
    ],
)
def test_slices_have_the_loss_and_gradient_of_their_transitions(tmp_path, kind, settings):
    """TorchRL's losses call critics under vmap, so sequences are read there, too."""
    network = tit(3, attention_dropout_outer=0.0, ffn_dropout_inner=0.0)
    discrete = kind in (DiscreteCQL, DQN)
    episodes = load_episodes((make_cartpole_data if discrete else make_data)(tmp_path))
    results = []
    for length in (1, 4):
        fields = {"backbone": network, "batch_size": 8, "slice_length": length, **settings}
        recipe = kind(**fields) if kind in (SAC, DQN) else make(kind, tmp_path, **fields)
        torch.manual_seed(0)
        algorithm = make_algorithm(recipe)
        algorithm.prepare(0, tmp_path)
        algorithm.close()
        algorithm.model.double()
        storage = HistoryStorage(episodes, 3, padding=recipe.padding, is_init=length > 1)
        index = torch.stack([torch.arange(4), episodes.lengths[0] - 2 + torch.arange(4)])
        batch = storage[index if length > 1 else index.flatten()]
        assert length == 1 or batch["is_init"][:, 1:].any()  # an end of an episode
        batch = batch.apply(lambda x: x.double() if x.is_floating_point() else x)
        torch.manual_seed(1)
        terms = (algorithm.learn if kind in (SAC, DQN) else algorithm.update)(batch, 0)
        gradients = [w.grad for w in algorithm.model.parameters() if w.grad is not None]
        results.append([*(x for x in terms.values() if isinstance(x, torch.Tensor)), *gradients])
    torch.testing.assert_close(results[1], results[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("key", "shape"), [("camera", (3, 5, 6)), ("arm/joint_angles", (3,))])
def test_data_of_one_of_several_observations(tmp_path, monkeypatch, key, shape):
    """The file has it as the task writes it: images with their channels last."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", "tests.envs.tasks")
    draw, steps = np.random.default_rng(0), 60
    image = key == "camera"
    pixels, angles = draw.integers(0, 256, (steps, 5, 6, 3), np.uint8), draw.random((steps, 3))
    observations = pixels if image else angles.astype(np.float32)
    arrays = {
        "observations": observations,
        "actions": draw.integers([0, -1], [2, 2], (steps, 2)),
        "rewards": draw.random(steps),
        "terminals": np.arange(steps) % 10 == 9,
        "timeouts": np.zeros(steps, bool),
    }
    data = write(tmp_path / "robot.hdf5", arrays)
    task = {"env": "tests.envs.tasks:Robot-v0", "observation_keys": (key,)}
    recipe = make(BC, tmp_path, **task, backbone=mlp(2, hidden_dim=8), dataset=str(data))
    rows = read_data(recipe).rows["observation"].unflatten(0, (6, 11))
    stored = rows[:, :10].flatten(0, 1)  # the final ones are unknown
    expected = torch.as_tensor(observations)
    assert torch.equal(stored, expected.permute(0, 3, 1, 2) if image else expected)
    algorithm = make_algorithm(recipe)
    algorithm.check()
    algorithm.prepare(0, tmp_path)
    batch = next(algorithm.batches())
    assert batch["history"].shape[2:] == shape
    algorithm.update(batch, 0)


@pytest.mark.parametrize(
    ("made", "space"),
    [
        (partial(make, BC), "Box"),
        (partial(make, BC), "MultiBinary"),
        (partial(make, IQL), "Box"),
        (partial(make, TD3BC), "Box"),
        (partial(make, CQL), "Box"),
        (make_dt, "Box"),
    ],
    ids=["bc", "bc-bits", "iql", "td3bc", "cql", "dt"],
)
def test_actions_of_two_dimensions_are_flat_as_in_the_task(tmp_path, monkeypatch, made, space):
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", "tests.recipes.ppo.tasks")
    draw, steps = np.random.default_rng(0), 60
    actions = draw.integers(0, 2, (steps, 2, 2)).astype(np.float32 if space == "Box" else np.int8)
    arrays = {
        "observations": draw.random((steps, 3), np.float32),
        "actions": actions,
        "rewards": draw.random(steps),
        "terminals": np.arange(steps) % 10 == 9,
        "timeouts": np.zeros(steps, bool),
    }
    task = {"env": f"tests.recipes.ppo.tasks:{space}Actions-v0", "observation_keys": ("state/0",)}
    recipe = made(tmp_path, **task, dataset=str(write(tmp_path / "a.hdf5", arrays)))
    episodes = read_data(recipe)
    found = episodes.rows["action"][episodes.step_rows].numpy()
    np.testing.assert_array_equal(found, actions.reshape(steps, 4))
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, tmp_path)
    algorithm.update(next(algorithm.batches()), 0)


@pytest.mark.parametrize("kind", [IQL, TD3BC, CQL])
def test_critics_read_bytes_as_the_policy_does(tmp_path, kind):
    draw = np.random.default_rng(0)
    data = log_machine(
        tmp_path / "log.hdf5", observations=draw.integers(0, 256, (200, 5), np.uint8)
    )
    recipe = make(kind, tmp_path, env="", dataset=str(data), normalize_observations=False)
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, tmp_path)
    batch = algorithm.buffer.sample()
    terms = algorithm.update(batch, 0)
    assert all(torch.as_tensor(value).isfinite().all() for value in terms.values())
    critic = algorithm.make_critic(algorithm.make_env(1), algorithm.action_spec)
    floats = batch.clone()
    floats["observation"] = batch["observation"] / 255
    values = critic(batch)["state_action_value"]
    assert torch.equal(values, critic(floats)["state_action_value"])


def test_the_actor_of_td3bc_has_torchrls_loss_where_actions_range_from_minus_1_to_1(tmp_path):
    data = log_machine(tmp_path / "log.hdf5")
    recipe = with_spaces(
        TD3BC(dataset=str(data), backbone=SMALL, critic_hidden=(8,), compile="off")
    )
    algorithm, batch = double(recipe, tmp_path)
    expected, others = algorithm.model.actor_loss(batch)
    found = algorithm.actor_loss(batch)
    torch.testing.assert_close(found["loss_actor"], expected)
    torch.testing.assert_close(found["bc_loss"], others["bc_loss"])


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (BC, {}),
        (IQL, {"critic_hidden": (8,)}),
        (TD3BC, {"critic_hidden": (8,)}),
        (CQL, {"critic_hidden": (8,), "cloning_updates": 3}),
    ],
)
def test_policies_do_not_depend_on_the_units_of_the_actions(tmp_path, kind, settings):
    """Of two entries with other units and other middles."""
    draw = np.random.default_rng(0)
    actions = draw.uniform(-1, 1, (60, 2))
    actions[:2] = [[-1, 1], [1, -1]]
    found = []
    for unit, middle in (((1.0, 1.0), (0.0, 0.0)), ((0.03125, 64.0), (3.0, -16.0))):
        logged = actions.astype(np.float32) * unit + np.array(middle)
        data = log_machine(tmp_path / f"{middle}.hdf5", 60, actions=logged)
        fixed = {"backbone": SMALL, "batch_size": 16, "compile": "off"}
        recipe = kind(dataset=str(data), **fixed, **settings)
        algorithm, batch = double(with_spaces(recipe), tmp_path)
        torch.manual_seed(1)
        for step in range(6):
            algorithm.update(batch.clone(), step)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            chosen = algorithm.policy(batch.clone())["action"]
        found.append((chosen - torch.tensor(middle)) / torch.tensor(unit))
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "settings", "expected"),
    [
        (BC, {}, ["the loss"]),
        (IQL, {}, ["the loss"]),
        (IQL, {"total_updates": 9999}, []),
        (IQL, {"slice_length": 2}, []),
        (IQL, {"compile": "off"}, []),
        (TD3BC, {}, ["the loss", "the actor's loss"]),
        (DiscreteCQL, {}, ["the loss"]),
        (
            CQL,
            {"compile": "on", "total_updates": 1},
            ["the loss", "the policy", "the actor's loss", "the actor's cloning loss"],
        ),
    ],
)
def test_losses_are_compiled_where_that_pays(tmp_path, monkeypatch, kind, settings, expected):
    compiled = []
    monkeypatch.setattr(shutil, "which", lambda name: name)
    monkeypatch.setattr("recipes.core.compilation._works", lambda: True)
    monkeypatch.setattr(
        "recipes.offline.compile_and_time", lambda function, name, owner: compiled.append(name)
    )
    algorithm = make_algorithm(make(kind, tmp_path, **{"total_updates": 10_000, **settings}))
    algorithm.prepare(0, tmp_path)
    assert compiled == expected


class Own(nn.Module):
    """A module of a user, which may do what has no graph."""


@pytest.mark.parametrize("part", [None, "model", "policy"])
def test_with_a_module_of_ones_own_graphs_may_break(tmp_path, monkeypatch, part):
    given, compile_function = [], torch.compile

    def compiled(function, **settings):
        given.append(deepcopy(settings))
        return compile_function(function, **settings)  # it changes them

    monkeypatch.setattr(torch, "compile", compiled)
    algorithm = make_algorithm(make(BC, tmp_path))
    if part:
        getattr(algorithm, part).own = Own()
    for _ in range(2):
        compile_and_time(algorithm.loss, "the loss", algorithm)
    for settings in given:
        assert ("guard_filter_fn" in settings.get("options", ())) is (part is None)
        assert settings.get("fullgraph", False) is (part is None)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [BC, IQL, TD3BC, CQL, DiscreteCQL])
def test_compiled_updates_are_the_same(tmp_path, kind, monkeypatch):
    # PyTorch's cache takes kernels for one ATEN_CPU_CAPABILITY for those of another.
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "kernels"))
    network = tit(2, attention_dropout_outer=0.0, ffn_dropout_inner=0.0)
    found = []
    with torch._inductor.config.patch(fallback_random=True):  # the same draws
        for setting in ("off", "on"):
            recipe = make(kind, tmp_path, backbone=network, compile=setting)
            algorithm, batch = double(recipe, tmp_path)
            torch.manual_seed(1)
            terms = [algorithm.update(batch.clone(), step) for step in range(3)]
            found.append((terms, weights_of(algorithm.model)))
    torch.testing.assert_close(*found, rtol=1e-8, atol=1e-10)

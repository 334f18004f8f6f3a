"""What d3rlpy reaches on a data set is written as each run ends, and not run twice."""

import h5py
import pytest
import torch

pytest.importorskip("d3rlpy")

import d3rlpy

from benchmarks import d3rlpy_returns
from benchmarks.measuring import read_rows
from tests.datasets.rollouts import roll, write
from tests.recipes.small import TD3BC, double, make
from torchrl_tit.settings.networks import mlp


@pytest.mark.parametrize("algorithm", d3rlpy_returns.ALGORITHMS)
def test_a_row_a_run_and_none_twice(algorithm, tmp_path, monkeypatch):
    monkeypatch.setattr(d3rlpy_returns, "EPISODES", 2)
    monkeypatch.setattr(d3rlpy_returns, "INTERVAL", 4)
    data, out = write(tmp_path / "rolled.hdf5", roll()), tmp_path / "new" / "d3rlpy.csv"
    with h5py.File(data, "a") as file:
        file.attrs["env_id"] = "Hopper-v5"
    words = [str(data), "--out", str(out), "--algorithms", algorithm, "--seeds", "0"]
    d3rlpy_returns.main([*words, "--updates", "8"])
    (row,) = read_rows(out)
    assert list(row) == d3rlpy_returns.COLUMNS
    assert list(row.values())[:4] == ["rolled", algorithm, "0", "8"]
    assert 0 < float(row["last"]) <= float(row["best"]) < 1000
    monkeypatch.setattr(d3rlpy_returns, "measure", lambda *_: pytest.fail("measured again"))
    d3rlpy_returns.main([*words, "--updates", "8"])


def test_td3bc_takes_the_same_steps(tmp_path):
    """From the same weights, on the same batches, without noise in the target."""
    settings = {
        "backbone": mlp(1, hidden_dim=16, activation="relu"),
        "critic_hidden": (16, 16),
        "policy_noise": 0.0,
    }
    algorithm, batch = double(make(TD3BC, tmp_path, **settings), tmp_path)
    encoder = d3rlpy.models.VectorEncoderFactory([16, 16])
    config = d3rlpy.algos.TD3PlusBCConfig(
        actor_encoder_factory=encoder, critic_encoder_factory=encoder, target_smoothing_sigma=0.0
    )
    other = config.create(device="cpu:0")
    other.create_impl((11,), 3)
    modules = other.impl.modules
    ours = dict(algorithm.model.named_parameters())
    actor = [weight for name, weight in ours.items() if name.startswith("actor")]
    critics = [weight for name, weight in ours.items() if name.startswith("qvalue")]
    pairs = [(modules.policy, modules.targ_policy, actor)]
    for i, critic in enumerate(modules.q_funcs):
        pairs.append((critic, modules.targ_q_funcs[i], [weight[i] for weight in critics]))
    for trained, target, weights in pairs:
        for module in (trained.double(), target.double()):
            for theirs, weight in zip(module.parameters(), weights, strict=True):
                theirs.data.copy_(weight.data)
    encode = algorithm.policy[0].module.frame_encoders["observation"]
    step = batch["next"]
    theirs = d3rlpy.torch_utility.TorchMiniBatch(
        observations=encode(batch["observation"]).flatten(1),
        actions=batch["action"],
        rewards=step["reward"],
        next_observations=encode(step["observation"]).flatten(1),
        next_actions=batch["action"],  # not read
        returns_to_go=step["reward"],  # not read
        terminals=step["terminated"].double(),
        intervals=torch.ones(len(batch), 1, dtype=torch.float64),
        device="cpu:0",
    )
    for number in range(6):
        terms = algorithm.update(batch, number)
        found = other.impl.update(theirs, number)
        assert found["critic_loss"] == pytest.approx(terms["loss_qvalue"].item(), rel=1e-6)
        if "actor_loss" in found:
            assert found["actor_loss"] == pytest.approx(terms["loss_actor"].item(), rel=1e-6)

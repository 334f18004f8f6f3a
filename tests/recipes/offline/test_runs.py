"""Runs of behaviour cloning, IQL and TD3+BC: training, resuming, evaluation, what they read."""

from __future__ import annotations

import pytest
import torch

from tests.datasets.rollouts import roll, write
from tests.recipes.small import (
    BC,
    IQL,
    TD3BC,
    double,
    make,
    make_algorithm,
    tit,
)


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


def test_an_entry_that_is_constant_in_the_data_may_change_a_little(tmp_path):
    """The authors of TD3+BC add 1e-3 to the deviation: 0.5 becomes 500, not 500,000."""
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
    mean, std = algorithm.load_data().observation_statistics()
    assert std[0] == 0
    torch.testing.assert_close(normal, (seen - mean) / (std + 1e-3))
    torch.testing.assert_close(normal[:, 0], torch.full((len(seen),), 500.0))


@pytest.mark.parametrize("kind", [BC, IQL, TD3BC])
def test_slices_have_the_loss_of_their_transitions(tmp_path, kind):
    settings = {} if kind is BC else {"critic": "backbone"}
    network = tit(3, attention_dropout_outer=0.0, ffn_dropout_inner=0.0)
    terms = []
    for length in (1, 4):
        recipe = make(kind, tmp_path, backbone=network, slice_length=length, **settings)
        algorithm, _ = double(recipe, tmp_path)
        index = torch.tensor([[3], [20]]) + torch.arange(4)  # with an end of an episode
        batch = algorithm.buffer.storage[index if length > 1 else index.flatten()]
        batch = batch.apply(lambda x: x.double() if x.is_floating_point() else x)
        noise = torch.linspace(-0.1, 0.1, 24, dtype=torch.float64)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch, "randn_like", lambda x: noise.view(x.shape))  # noqa: B023
            terms.append(algorithm.update(batch, 0))
    torch.testing.assert_close(terms[1], terms[0], rtol=1e-9, atol=1e-9)

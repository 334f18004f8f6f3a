"""The subclasses of docs/how-to/change-ppo.md: they train, resume and compute what they say."""

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from recipes.cli import main
from recipes.core.metrics import read_metrics
from recipes.ppo import PPO, PPOAlgorithm
from tests.numerics import assert_near
from tests.recipes.ppo import tasks
from tests.recipes.ppo.algorithms import perturb
from torchrl_tit.settings.networks import enhanced_tit

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "change-ppo.md").read_text()
VTRACE, PREDICTIVE, NAMED = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
SMALL: dict[str, Any] = {
    "env": "CartPole-v1",
    "env_settings": ("max_episode_steps=11",),
    "backbone": enhanced_tit(4, embed_dim=8, features_dim=8),
    "num_envs": 2,
    "total_steps": 128,
    "steps_per_batch": 64,
    "minibatch_size": 32,
    "epochs": 2,
}


def written(folder: Path, name: str, source: str) -> ModuleType:
    """The module of a user's file."""
    (folder / f"{name}.py").write_text(source)
    sys.path.append(str(folder))
    return __import__(name)


def code_lines(source: str) -> int:
    return len([line for line in source.splitlines() if line.strip()])


def test_they_are_as_short_as_the_page_says():
    assert code_lines(VTRACE) <= 20
    assert code_lines(PREDICTIVE) <= 32
    bare = re.sub(r'\n    prediction_coeff.*?"""\n', "", PREDICTIVE, flags=re.DOTALL)
    imports = [line for line in bare.splitlines() if re.match("(from|import) ", line)]
    assert code_lines(bare) - len(imports) <= 25


@pytest.fixture
def in_float64(float64, monkeypatch):
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", tasks.__name__)
    return SMALL | {"wrappers": (f"{tasks.__name__}:Double",)}


def test_vtrace_with_the_policy_that_collected_is_gae_with_lambda_1(
    in_float64, own_modules, tmp_path
):
    module = written(own_modules, "vtrace_ppo", VTRACE)
    recipe = module.VTrace(**in_float64)
    algorithm = recipe.build()
    perturb(algorithm.model)
    algorithm.prepare(0, tmp_path)
    with torch.no_grad():
        batch = next(iter(algorithm.batches()))
        algorithm.close()
        assert (batch["next", "truncated"] & batch["next", "done"]).any()
        other = batch.clone()
        algorithm.advantages(batch, algorithm.rollout(batch))
        plain = PPOAlgorithm(PPO(**in_float64, gae_lambda=1.0))
        plain.prepare(0, tmp_path)
        plain.close()
        plain.model = algorithm.model
        plain.advantages(other, plain.rollout(other))
    assert_near(batch["advantage"], other["advantage"])
    assert_near(batch["value_target"], other["value_target"])


def test_the_prediction_is_trained_saved_and_logged(own_modules, tmp_path):
    written(own_modules, "predictive", PREDICTIVE + "\n\n" + NAMED)
    command = ["train", "mine/predictive", "--import", "predictive", "--out", "runs/predictive"]
    options = [f"--{name.replace('_', '-')}={SMALL[name]}" for name in SMALL if name != "backbone"]
    options = [option for option in options if "env-settings" not in option]
    main([*command, *options, "--evaluation-episodes", "2", "--backbone.frame.embed-dim", "8"])
    run = own_modules / "runs" / "predictive"
    first, last = read_metrics(run / "metrics.csv")
    assert 0 < last["loss_prediction"] < first["loss_prediction"]
    main(["evaluate", str(run), "--import", "predictive"])


def test_the_prediction_does_not_cross_an_episodes_end(in_float64, own_modules, tmp_path):
    module = written(own_modules, "predictive", PREDICTIVE)
    recipe = module.Predictive(**in_float64, prediction_coeff=1.0)
    algorithm = recipe.build()
    algorithm.prepare(0, tmp_path)
    with torch.no_grad():
        batch = next(iter(algorithm.batches()))
        algorithm.close()
        rollout = algorithm.rollout(batch)
        algorithm.advantages(batch, rollout)
        for minibatch in algorithm.minibatches(batch, rollout):
            loss = algorithm.loss(minibatch)["loss_prediction"]
            steps, errors = minibatch.steps, []
            for features, action, is_init in zip(
                steps["features"], steps["action"], steps["is_init"], strict=True
            ):
                for t in range(len(features) - 1):
                    chosen = torch.eye(2)[action[t]]
                    predicted = algorithm.model.predictor(torch.cat([features[t], chosen]))
                    error = 1 - torch.cosine_similarity(predicted, features[t + 1], dim=0)
                    errors.append(error * (not is_init[t + 1]))
            assert_near(loss, torch.stack(errors).mean())


class Bonus(PPOAlgorithm):
    """Adds the size of an observation to the reward, and reads both again in the loss."""

    step_keys = (*PPOAlgorithm.step_keys, "bonus")

    def collected(self, batch):
        assert not torch.is_grad_enabled()
        batch["bonus"] = batch["observation"].norm(dim=-1, keepdim=True)
        batch["next", "reward"] = batch["next", "reward"] + batch["bonus"]
        return super().collected(batch)

    def loss(self, minibatch):
        [newest] = minibatch.observations
        torch.testing.assert_close(newest.norm(dim=-1, keepdim=True), minibatch.steps["bonus"])
        return super().loss(minibatch)


@pytest.mark.parametrize("frames", [1, 4])
def test_what_is_collected_reaches_the_loss_with_its_observations(frames, tmp_path):
    backbone = enhanced_tit(frames, embed_dim=8, features_dim=8)
    algorithm = Bonus(PPO(**SMALL | {"backbone": backbone}))
    algorithm.prepare(0, tmp_path)
    batch = next(iter(algorithm.batches()))
    algorithm.close()
    returns = algorithm.returns(batch)
    assert algorithm.update(batch, 0)["epochs"] == 2
    assert set(returns.tolist()) <= set(map(float, range(1, 12)))  # without the bonus

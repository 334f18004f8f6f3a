"""What a PPO run encodes while it acts: the newest frames, and no others."""

import pytest

from recipes.core.runner import evaluate
from recipes.ppo import PPO, ActorCritic
from tests.modules.frames import CountedFrames
from tests.recipes.small import train
from torchrl_tit.settings.networks import enhanced_tit

RECIPE = PPO(
    env="Pendulum-v1",
    backbone=enhanced_tit(4, embed_dim=8, features_dim=8),
    total_steps=128,
    steps_per_batch=64,
    num_envs=2,
    minibatch_size=32,
    epochs=1,
    evaluation_episodes=2,
)


@pytest.fixture
def frames(monkeypatch):
    """Counts the frames that are encoded without gradients."""
    counted = []
    init = ActorCritic.__init__

    def counting(model, *args):
        init(model, *args)
        frames = CountedFrames(model.backbone.module)
        frames.only_without_gradients = True
        counted.append(frames)

    monkeypatch.setattr(ActorCritic, "__init__", counting)
    return counted


def test_collection_and_evaluation_encode_each_frame_once(frames, tmp_path):
    run = train(RECIPE, tmp_path / "run")
    # A batch has 64 steps, the 3 older frames of both environments at its start, the 4 of both
    # next histories at its end, and two sequences of 16 that are checked to be finite.
    assert frames[0].take() <= 2 * (64 + 2 * 3 + 2 * 4 + 2 * (16 + 3))
    evaluate(run)
    assert frames[1].take() <= 2 * (200 + 3)  # two episodes

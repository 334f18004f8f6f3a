"""What every recipe has: fields whose values are of their types."""

from dataclasses import replace
from typing import Any

import pytest

from recipes.ppo import PPO
from recipes.registry import get_recipe
from torchrl_tit.networks import MLP
from torchrl_tit.settings import Head, Outer
from torchrl_tit.settings.networks import mlp

HALF: Any = 2.5
OUTER: Any = Outer()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"initialization": "orthogonl"},
            "field 'initialization' is 'orthogonl', not one of",
        ),
        ({"compile": "yes"}, r"field 'compile' is 'yes', not one of \('auto', 'on', 'off'\)"),
        ({"num_envs": "2"}, "field 'num_envs' is '2': Expected `int`"),
        ({"epochs": 2.0}, r"field 'epochs' is 2\.0: Expected `int`"),
        ({"hide_velocities": 1}, "field 'hide_velocities' is 1: Expected `bool`"),
        (
            {"backbone": "mlp"},
            "must be the settings of a network, .* not 'mlp'",
        ),
        ({"backbone": MLP((4,))}, "must be the settings of a network"),
        (
            {"backbone": replace(mlp(), head=Head(features_dim=HALF))},
            "field 'backbone.head.features_dim' is 2.5",
        ),
        ({"backbone": replace(mlp(), frame=OUTER)}, "field 'backbone.frame' must be"),
    ],
)
def test_values_of_other_types_are_refused_in_python_too(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(get_recipe("ppo/cartpole/mlp"), **changes)


def test_whole_numbers_are_numbers():
    recipe = PPO(env="CartPole-v1", backbone=mlp(), learning_rate=1)
    assert recipe.learning_rate == 1

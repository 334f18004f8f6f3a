"""What every recipe has: fields whose values are of their types."""

import math
from dataclasses import dataclass, replace
from typing import Any

import pytest

from recipes.core.recipe import Recipe
from recipes.core.registry import get_recipe
from recipes.ppo import PPO
from torchrl_tit.networks import MLP
from torchrl_tit.settings import FrameSettings, Head, HistorySettings, Inner, Network, Outer
from torchrl_tit.settings.checks import checked, field_types
from torchrl_tit.settings.networks import mlp

HALF: Any = 2.5
OUTER: Any = Outer()
NO: Any = "no"


@dataclass(frozen=True, kw_only=True)
class Careless(FrameSettings):
    """A part of a user's own that does not call its base class."""

    embed_dim: int = 8

    def __post_init__(self) -> None:
        pass


@dataclass(frozen=True, kw_only=True)
class Careful(FrameSettings):
    scale: float = 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"initialization": "orthogonl"}, "field 'initialization' is 'orthogonl', not one of"),
        ({"compile": "yes"}, r"field 'compile' is 'yes', not one of \('auto', 'on', 'off'\)"),
        ({"num_envs": "2"}, "field 'num_envs' is '2': Expected `int`"),
        ({"epochs": 2.0}, r"field 'epochs' is 2\.0: Expected `int`"),
        ({"hide_velocities": 1}, "field 'hide_velocities' is 1: Expected `bool`"),
        ({"backbone": "mlp"}, "must be the settings of a network, .* not 'mlp'"),
        ({"backbone": MLP((4,))}, "must be the settings of a network"),
        ({"backbone": replace(mlp(), frame=Careless(embed_dim=HALF))}, "'embed_dim' is 2.5"),
        ({"total_steps": 10**30}, "total_steps must be at most 1000000000000, not 10000000"),
        ({"threads": 5000}, "threads must be at most 1024, not 5000"),
        ({"adam_eps": math.inf}, r"adam_eps must be at most 1000000000.0, not inf"),
        ({"entropy_coeff": math.nan}, r"entropy_coeff must be at least -1000000000.0, not nan"),
        ({"reward_scale": math.inf}, "reward_scale must be at most"),
        ({"evaluation_episodes": 999_999_999_999}, "evaluation_episodes must be at most 100000"),
    ],
)
def test_values_of_other_types_are_refused_in_python_too(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(get_recipe("ppo/cartpole/mlp"), **changes)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Head(features_dim=HALF), "field 'features_dim' is 2.5: Expected `int"),
        (lambda: replace(mlp(), frame=OUTER), "field 'frame' must be settings of type FrameSett"),
        (lambda: Inner(position_encoding=NO), "field 'position_encoding' is 'no': Expected `bool`"),
        (lambda: mlp(10**6), "num_frames must be at most 10000, not 1000000"),
        (lambda: Careful(scale=math.nan), "scale must be finite, not nan"),
    ],
)
def test_settings_of_networks_are_checked_where_they_are_made(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_every_number_of_every_recipe_and_part_is_bounded():
    """Each field that takes numbers has a smallest and a largest one."""
    networks = [Network, Head, *FrameSettings.registered.values()]
    networks += HistorySettings.registered.values()
    recipes = [
        kind for kind in Recipe.registered.values() if kind.__module__.startswith("recipes.")
    ]
    for kind in [*networks, *recipes]:
        if kind.__module__.startswith("tests"):
            continue
        for name, type_ in field_types(kind).items():
            for value in (10**40, -(10**40), math.inf, -math.inf, math.nan):
                with pytest.raises(ValueError, match=rf"'?{name}'? (must be|is) "):
                    checked(name, value, type_)


def test_whole_numbers_are_numbers():
    recipe = PPO(env="CartPole-v1", backbone=mlp(), learning_rate=1)
    assert recipe.learning_rate == 1

"""Wrong arguments of public calls fail at once, in one line that names them."""
# mypy: disable-error-code="arg-type, call-arg"

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.data import Bounded, Categorical
from torchrl.modules import MLP as Layers
from torchrl.modules import QValueActor, ValueOperator

from torchrl_tit import Backbone, EnhancedTIT
from torchrl_tit.datasets import (
    HistoryStorage,
    OnlineHistoryStorage,
    SequenceStorage,
    episodes_from_arrays,
    join_episodes,
    load_episodes,
    make_replay_buffer,
    select_episodes,
    task_spaces,
)
from torchrl_tit.envs import make_env
from torchrl_tit.modules import make_actor, make_squashed_actor, make_value
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.objectives import (
    ContinuousCQLLoss,
    DelayedDiscreteCQLLoss,
    LikelihoodBCLoss,
    MaskedDTLoss,
    contrastive_prediction_loss,
)

NAN, INF = float("nan"), float("inf")
SPEC = Bounded(-1, 1, shape=(3,))
STEPS = torch.zeros(2, 3, 6)
MASK = torch.ones(2, 3, dtype=torch.bool)


def episodes(width: int = 2, **changed: Any) -> Any:
    fields = {
        "observations": np.zeros((6, width)),
        "actions": np.zeros((6, 1)),
        "rewards": np.full(6, 1.5),
        "terminals": np.arange(6) % 3 == 2,
    }
    return episodes_from_arrays(**{**fields, **changed})


def cql(**settings: Any) -> ContinuousCQLLoss:
    actor = make_squashed_actor(4, SPEC, in_key="observation")
    critic = ValueOperator(Layers(7, 1), in_keys=["observation", "action"])
    return ContinuousCQLLoss(actor, critic, action_spec=SPEC, **settings)


def discrete_cql(**settings: Any) -> DelayedDiscreteCQLLoss:
    actor = QValueActor(torch.nn.Linear(4, 2), action_space="categorical")
    return DelayedDiscreteCQLLoss(actor, action_space="categorical", **settings)


def contrast(temperature: float = 0.1, mask: torch.Tensor = MASK, width: int = 6) -> torch.Tensor:
    return contrastive_prediction_loss(STEPS, STEPS[..., :width], mask, temperature=temperature)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: episodes(dtype=torch.int64), "dtype is that of floats, such as torch.float32"),
        (lambda: episodes(max_episode_steps=1.5), "'max_episode_steps' is 1.5: Expected"),
        (lambda: episodes(observations=[[1], [2, 3]]), "'observations': is not one array"),
        (lambda: episodes(task="Hopper-v5"), "task must be what task_spaces returns, not 'Hop"),
        (lambda: load_episodes(""), "source must name a file, a folder or a data set, not ''"),
        (lambda: load_episodes("a.hdf5", task=5), "task must be a name, or what task_spaces"),
        (lambda: task_spaces(5), "field 'env_name' is 5: Expected `str`"),
        (lambda: HistoryStorage("x"), "episodes must be Episodes, as of load_episodes, not 'x'"),
        (lambda: SequenceStorage(episodes(), 2, return_scale=INF), "return_scale must be at most"),
        (lambda: OnlineHistoryStorage(1.5), "field 'max_size' is 1.5: Expected `int`"),
        (
            lambda: make_replay_buffer(HistoryStorage(episodes()), 8, slice_length=3),
            "batch of 8 steps cannot be divided into slices of 3",
        ),
        (
            lambda: make_replay_buffer(HistoryStorage(episodes()), 8, seed=-1),
            "seed must be at least 0, not -1",
        ),
        (lambda: select_episodes(episodes(), torch.tensor([7])), "index must be integers from 0"),
        (lambda: join_episodes([]), "there are no data sets to join"),
        (
            lambda: join_episodes([episodes(), episodes(width=5)]),
            r"field 'observation' has the shape \[5\] and torch.float32, but in the data \[2\]",
        ),
        (lambda: make_actor(0, Categorical(2)), "features_dim must be at least 1, not 0"),
        (lambda: make_actor(64, None), "no policy head for the action space None"),
        (lambda: make_value(0), "features_dim must be at least 1, not 0"),
        (lambda: make_squashed_actor(0, SPEC), "features_dim must be at least 1, not 0"),
        (
            lambda: make_squashed_actor(8, Bounded(1, 1, shape=(3,))),
            "each lower bound must be below the upper one",
        ),
        (lambda: cql(alpha_init=NAN), "alpha_init must be positive, not nan"),
        (lambda: cql(target_entropy=NAN), "target_entropy must be at least .*, not nan"),
        (lambda: cql(loss_function="l3"), "'loss_function' is 'l3', not one of"),
        (lambda: discrete_cql(loss_function="l3"), "'loss_function' is 'l3', not one of"),
        (lambda: MaskedDTLoss(torch.nn.Linear(1, 1), reduction="no"), "'reduction' is 'no'"),
        (lambda: LikelihoodBCLoss(5), "actor_network must be a policy with get_dist, not 5"),
        (lambda: contrast(temperature=NAN), "temperature must be positive and finite, not nan"),
        (lambda: contrast(width=5), r"encodings and predictions must be \[N, K, D\]"),
        (lambda: contrast(mask=torch.ones(2, 3)), "mask must be bool, not torch.float32"),
        (lambda: EnhancedTIT(4), "observation_shape 4 is not that of an array"),
        (lambda: EnhancedTIT((4,), patch_size=1000), "patch_size 1000 is larger than the array of"),
        (lambda: EnhancedTIT((4,), position_encoding="no"), "'position_encoding' is 'no': Expec"),
        (
            lambda: HistoryNetwork(5, 5, observation_shape=(4,)),
            "5 is no FrameSettings",
        ),
        (lambda: Backbone(None), "network must be one, such as EnhancedTIT.*, not None"),
        (lambda: make_env("CartPole-v1", seed=-1), "seed must be at least 0, not -1"),
        (lambda: EnhancedTIT((4,), attention_dropout_inner=NAN), "must be a probability in"),
    ],
)
def test_what_is_wrong_is_said_at_once(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert "\n" not in str(error.value)


def test_numpys_numbers_are_numbers() -> None:
    assert make_value(np.int64(4)).module.in_features == 4


def test_python_says_which_arguments_there_are() -> None:
    with pytest.raises(TypeError, match=r"make_value\(\) got an unexpected key"):
        make_value(size=4)

"""Impossible arguments are refused where they are given: with the name, the value and what fits."""
# mypy: disable-error-code="arg-type, call-arg"

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    OneHot,
    Unbounded,
)
from torchrl.modules import MLP as Layers
from torchrl.modules import QValueActor, ValueOperator

from torchrl_tit import Backbone, settings
from torchrl_tit.datasets import (
    ConsecutiveSampler,
    HistoryStorage,
    OnlineHistoryStorage,
    SequenceStorage,
    episodes_from_arrays,
    join_episodes,
    load_episodes,
    make_replay_buffer,
    normalized_score,
    select_episodes,
    task_spaces,
)
from torchrl_tit.envs import AtariGames, make_env
from torchrl_tit.frames import Observation, read_observation, read_observations
from torchrl_tit.histories import HistoryShape
from torchrl_tit.layers import RelativeBias, Rotary, SelfAttention
from torchrl_tit.layers.patches import find_patch_size
from torchrl_tit.modules import make_actor, make_squashed_actor, make_value
from torchrl_tit.networks import (
    D2RL,
    DTTIT,
    MLP,
    DecisionTransformer,
    EnhancedTIT,
    HistoryNetwork,
    OFENet,
)
from torchrl_tit.objectives import (
    ContinuousCQLLoss,
    DelayedDiscreteCQLLoss,
    LikelihoodBCLoss,
    MaskedDTLoss,
    contrastive_prediction_loss,
)
from torchrl_tit.transforms import History, SequenceHistory

STEPS = np.zeros((4, 1), np.float32)
ENDS = np.array([False, True] * 2)
EPISODES = episodes_from_arrays(STEPS, STEPS, STEPS[:, 0], ENDS)
INF, NAN = float("inf"), float("nan")


def of(make: Any, *arguments: Any) -> Callable[..., Any]:
    """A function of named arguments."""
    return lambda **named: make(*arguments, **named)


def network(num_frames: Any) -> HistoryNetwork:
    parts = settings.Linear(), settings.Outer()
    return HistoryNetwork(*parts, observation_shape=(6,), num_frames=num_frames)


def squashed(low: float, high: float) -> Any:
    return make_squashed_actor(8, Bounded(torch.tensor([-1.0, low]), torch.tensor([1.0, high])))


def arrays(**named: Any) -> Any:
    return episodes_from_arrays(STEPS, STEPS, STEPS[:, 0], ENDS, **named)


dt = of(DecisionTransformer, (11,))
AN_ARRAY = r"observation_shape .* is not that of an array \(D,\)"
NOT_READ = "are neither floats nor bytes nor categories"
NO_WIDTH = r"^no squashed policy for actions from \[[^\n]*finite"

# A function, its arguments, and the message.
WRONG: list[tuple[Callable[..., Any], dict[str, Any], str]] = [
    *((network, {"num_frames": n}, "num_frames") for n in (0, -1, True, 2.0, "4")),
    (of(MLP, (5,)), {"hidden_dim": 0}, "hidden_dim must be at least 1, not 0"),
    (of(OFENet, (5,)), {"num_layers": 0}, "num_layers must be at least 1, not 0"),
    (of(D2RL, (5,)), {"activation": "tan"}, "field 'activation' is 'tan', not one of"),
    (dt, {"action_dim": 3, "num_frames": 31, "max_ep_len": 30}, "31 is more than max_ep_len 30"),
    (dt, {"action_dim": 3, "num_frames": 0}, "num_frames must be at least 1, not 0"),
    (dt, {"action_dim": 3, "ffn_dim": 0}, "ffn_dim must be at least 1, not 0"),
    (dt, {"action_dim": 3, "num_heads": 3}, "width 128 cannot be split over 3 attention heads"),
    (dt, {"action_dim": 3, "dropout": 1.0}, r"dropout must be a .* in \[0, 1\), not 1.0"),
    (dt, {"action_dim": 0}, "action_dim must be at least 1, not 0"),
    (dt, {"action_dim": None}, "reads actions and returns beside observations: give action_dim"),
    (of(DecisionTransformer, ()), {"action_dim": 3}, r"observation_shape \(\) is not"),
    (of(DTTIT, (11,)), {"action_dim": 3, "patch_size": 0}, "patch_size must be at least 1, not 0"),
    (settings.Outer, {"temporal_positions": "rope"}, "'temporal_positions' is 'rope', not one of"),
    (
        of(settings.Network),
        {
            "frame": settings.Linear(),
            "history": settings.ChainedOuter(temporal_positions="rotary"),
        },
        "'rotary' tells frames apart, but num_frames is 1",
    ),
    (
        of(settings.Outer(num_heads=2, temporal_positions="rotary").build),
        {"shape": HistoryShape(num_frames=4, num_tokens=1, width=6)},
        "pairs of entries, but a head has 3",
    ),
    *(
        (of(settings.Network), {"frame": settings.Inner(), "history": settings.MLP(), "frames": x},
         "frames")
        for x in ({"image": "inner"}, {3: settings.Inner()})
    ),
    (settings.Inner, {"patch_size": "all"}, "'patch_size' is 'all', not one of"),
    (of(find_patch_size, (97, 64)), {"patch_size": "auto"},
     r"97 x 64 .* divisors \[1\]: resize them .* nature-cnn"),
    (of(SelfAttention, 8, 2), {"positions": "relative", "num_frames": 4},
     "distances to the past: choose causal=True"),
    (of(SelfAttention, 6, 2), {"positions": "rotary", "num_frames": 4},
     "pairs of entries, but a head has 3: choose a width"),
    (of(RelativeBias(2, 4), 5), {}, "5 steps does not fit positions of 4: give it the l"),
    (of(Rotary(4, 4), torch.zeros(5, 4), 5), {}, "5 steps does not fit positions of 4: give it"),
    *((of(settings.Flat().build, shape), {}, AN_ARRAY) for shape in ((), (1, 2, 3, 4), (3, 0), 5)),
    *(
        (of(read, named), {}, prefix + message)
        for spec, message in [
            (Unbounded(3, dtype=torch.int64), f"of torch.int64 {NOT_READ}"),
            (OneHot(4), "give them a MultiCategorical spec"),
            (Categorical(4), NOT_READ),
            (Unbounded(()), r"observation_shape \(\) is not that of an array"),
            (Unbounded((2, 3, 4, 5)), "not that of an array"),
        ]
        for read, named, prefix in [
            (read_observation, spec, ""),
            (read_observations, {"x": spec}, "observation 'x': .*"),
        ]
    ),
    (of(Observation, (3,)), {"categories": (4, 3)},
     r"categories \(4, 3\) are an observation of shape \(2,\)"),
    (of(read_observations, {}), {}, "there are no observations"),
    *(
        (squashed, {"low": low, "high": high}, NO_WIDTH)
        for low, high in [(-INF, INF), (0.0, INF), (-3e38, 3e38), (2e38, 3e38), (NAN, 1.0)]
    ),
    (of(make_actor, 16, Unbounded((2,), dtype=torch.int64)), {}, "no policy head"),
    (of(make_actor, 16, Composite(a=Categorical(2), b=Categorical(2))), {}, "no policy head"),
    (of(make_actor, 16, OneHot(3)), {"batch_dims": 2}, "batch_dims must be at least 0 and at m"),
    (of(make_actor, 16, OneHot(3, shape=(8, 3))), {"batch_dims": 0},
     r"shape \[8, 3\] .* raise batch_dims"),
    (of(make_actor, 16, MultiCategorical(torch.tensor([[2, 3], [1, 4]]))), {},
     "other numbers of options in each row"),
    (of(make_actor, 16, Binary(2)), {"mask_key": "m"}, "no action mask for the action space Bin"),
    (of(HistoryStorage, EPISODES), {"padding": "zeros"}, "'padding' is 'zeros', not one of"),
    (of(HistoryStorage, EPISODES), {"time_limits": "lose"}, "'time_limits' is 'lose', not one"),
    (of(HistoryStorage, EPISODES), {"terminal_observations": "drop"}, "'terminal_observations' i"),
    (of(HistoryStorage, EPISODES), {"unfinished": True}, "unfinished"),
    (of(SequenceStorage, EPISODES), {"num_frames": 0}, "num_frames must be at least 1, not 0"),
    (of(SequenceStorage, EPISODES), {"return_scale": 0.0}, "return_scale must be positive"),
    (of(OnlineHistoryStorage, 30), {"ndim": 3}, "ndim must be 1 .*, not 3"),
    (of(OnlineHistoryStorage, 0), {}, "max_size must be at least 1, not 0"),
    (of(make_replay_buffer, HistoryStorage(EPISODES), 0), {}, "batch_size must be at least 1, not"),
    (of(ConsecutiveSampler, 0), {}, "slice_length must be at least 1, not 0"),
    (arrays, {"max_episode_steps": 0}, "max_episode_steps must be at least 1, not 0"),
    (arrays, {"gaps": "cutt"}, "field 'gaps' is 'cutt', not one of"),
    (of(normalized_score, 1.0, "hopp-v0"), {}, "no reference returns for 'hopp-v0'; a name must"),
    (SequenceHistory, {"num_frames": 0}, "num_frames must be at least 1, not 0"),
    (SequenceHistory, {"return_scale": -1.0}, "return_scale must be positive, not -1.0"),
    (History, {"num_frames": 0}, "num_frames must be at least 1, not 0"),
    (History, {"num_frames": 2.0}, "'num_frames' is 2.0: Expected `int`"),
    (of(History, 2), {"observation_ndim": -1}, "observation_ndim .* -1"),
    (of(History, 2), {"padding": "zeros"}, "'padding' is 'zeros', not one of"),
    (of(History, 2), {"in_keys": [], "out_keys": []}, "at least one"),
    (of(History, 2), {"out_keys": ["observation"]}, "needs a key of its own"),
    (of(History, 2), {"in_keys": [("next", "observation")]},
     "needs one key in out_keys for each in in_keys, and at least one"),
    (of(History, 2), {"in_keys": ["o", ("next", "o")], "out_keys": ["h", "next_h"]},
     "'next_h' of .* cannot be made: .*its history under \"next\" like the one at the root"),
    (of(History, 2), {"in_keys": -2}, "in_keys must be .* -2; .* no dim"),
    (of(make_env, "CartPole-v1"), {"vectorization_mode": "p"}, "'vectorization_mode' is 'p', not"),
    (of(make_env, "Ant-v5"), {"hide_velocities": True}, "not known which observations of 'Ant-v5'"),
    (of(AtariGames, "ping"), {}, "Unknown game 'ping'"),
    (of(AtariGames, "pong"), {"render_mode": "human"}, "'render_mode' is 'human'"),
    (of(AtariGames, "pong", 0), {}, "num_envs must be at least .*, not 0"),
    (of(EnhancedTIT, (4,), 2), {"inner": False, "outer": False}, "inner and outer cannot both be"),
    (of(EnhancedTIT, (4,), 2), {"outer": False, "temporal_positions": "learned"},
     "those of the outer blocks: set them to none"),
]  # fmt: skip

SHAPES: list[tuple[tuple[int, ...], int, dict[str, Any], str]] = [
    ((4,), 0, {}, r"num_frames must be at least 1, not 0"),
    ((1, 2, 3, 4), 1, {}, r"observation_shape \(1, 2, 3, 4\) is not"),
    ((4,), 1, {"num_heads_inner": 3}, r"width 32 cannot be split over 3 attention heads: choose"),
    ((4,), 1, {"num_heads_outer": 5}, r"width 32 cannot be split over 5 attention heads: choose"),
    ((8, 4), 1, {"patch_size": 8}, r"patch_size 8 is larger than the image of 8 x 4"),
    ((3, 8, 18), 1, {"patch_size": 4}, r"4 does not divide the image of 8 x 18 .* \[1, 2\]"),
    ((4,), 1, {"activation_head": "Tanh"}, r"'Tanh', not one of .*'tanh'"),
    *(
        ((4,), 1, {f"{kind}_dropout_{part}": p}, rf"{kind}_dropout .* \[0, 1\), not {p}")
        for kind, part, p in [
            ("attention", "outer", 1.0),
            ("ffn", "inner", float("nan")),
        ]
    ),
    *(
        ((4,), 1, {name: 0}, rf"{field} must be at least 1, not 0")
        for name, field in [
            ("patch_size", "patch_size"),
            ("embed_dim", "embed_dim"),
            ("ffn_expansion_outer", "ffn_expansion"),
            ("features_dim", "features_dim"),
        ]
    ),
]  # fmt: skip
WRONG += [
    (of(EnhancedTIT, shape, num_frames), fields, message)
    for shape, num_frames, fields, message in SHAPES
]


SPEC = Bounded(-1, 1, shape=(3,))


SEQUENCES = torch.zeros(2, 3, 6)


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


def contrast(mask: torch.Tensor = MASK, width: int = 6, **settings: Any) -> torch.Tensor:
    return contrastive_prediction_loss(SEQUENCES, SEQUENCES[..., :width], mask, **settings)


CALLS: list[tuple[Callable[[], object], str]] = [
    (lambda: episodes(dtype=torch.int64), "dtype is that of floats, such as torch.float32"),
    (lambda: episodes(max_episode_steps=1.5), "'max_episode_steps' is 1.5: Expected"),
    (lambda: episodes(observations=[[1], [2, 3]]), "'observations': is not one array"),
    (lambda: episodes(task="Hopper-v5"), "task must be what task_spaces returns, not 'Hop"),
    (lambda: load_episodes(""), "source must name a file, a folder or a data set, not ''"),
    (lambda: load_episodes("a.hdf5", task=5), "task must be a name, or what task_spaces"),
    (lambda: task_spaces(5), "field 'env_name' is 5: Expected `str`"),
    (lambda: task_spaces("torchrl.envs:PendulumEnv"), "makes a TorchRL environment, but data"),
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
    (
        lambda: make_squashed_actor(8, Bounded(1, 1, shape=(3,))),
        "each lower bound must be below the upper one",
    ),
    (lambda: cql(alpha_init=NAN), "alpha_init must be positive, not nan"),
    (lambda: cql(target_entropy=NAN), "target_entropy must be at least .*, not nan"),
    (lambda: cql(num_random=0), "num_random must be"),
    (lambda: cql(over_critics="max"), "'over_critics' is 'max'"),
    (lambda: cql(loss_function="l3"), "'loss_function' is 'l3', not one of"),
    (lambda: discrete_cql(loss_function="l3"), "'loss_function' is 'l3', not one of"),
    (lambda: MaskedDTLoss(torch.nn.Linear(1, 1), reduction="no"), "'reduction' is 'no'"),
    (lambda: LikelihoodBCLoss(5), "actor_network must be a policy with get_dist, not 5"),
    (lambda: contrast(temperature=NAN), "temperature must be positive, not nan"),
    (lambda: contrast(width=5), r"encodings and predictions must be \[N, K, D\]"),
    (lambda: contrast(mask=torch.ones(2, 3)), "mask must be bool, not torch.float32"),
    (
        lambda: contrast(padding=MASK[:, 1:]),
        r"padding must be bool \[2, 3\], not torch.bool \[2, 2",
    ),
    (lambda: EnhancedTIT(4), "observation_shape 4 is not that of an array"),
    (lambda: EnhancedTIT((4,), patch_size=1000), "patch_size 1000 is larger than the array of"),
    (lambda: EnhancedTIT((4,), position_encoding="no"), "'position_encoding' is 'no': Expec"),
    (lambda: HistoryNetwork(5, 5, observation_shape=(4,)), "5 is no FrameSettings"),
    (lambda: Backbone(None), "network must be one, such as EnhancedTIT.*, not None"),
    (lambda: make_env("CartPole-v1", seed=-1), "seed must be at least 0, not -1"),
]


WRONG += [(call, {}, message) for call, message in CALLS]


@pytest.mark.parametrize(("call", "arguments", "message"), WRONG)
def test_refused(call: Callable[..., Any], arguments: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message) as error:
        call(**arguments)
    assert "\n" not in str(error.value)


def test_numpys_numbers_are_numbers() -> None:
    assert make_value(np.int64(4)).module.in_features == 4


def test_python_says_which_arguments_there_are() -> None:
    with pytest.raises(TypeError, match=r"make_value\(\) got an unexpected key"):
        make_value(size=4)

"""What TorchRL's suite asks of each of its losses (`LossModuleTestBase`), asked of ours."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from tensordict import TensorDict, TensorDictBase, assert_close, unravel_key
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictSequential
from torch import nn
from torchrl.data import Bounded, Categorical
from torchrl.modules import MLP, QValueActor, ValueOperator
from torchrl.objectives import LossModule

from torchrl_tit import Backbone, EnhancedTIT
from torchrl_tit.modules import DTHead, make_actor, make_dt_predictor, make_squashed_actor
from torchrl_tit.networks import DecisionTransformer
from torchrl_tit.objectives import (
    ContinuousCQLLoss,
    DelayedDiscreteCQLLoss,
    LikelihoodBCLoss,
    MaskedDTLoss,
)

BATCH, OBSERVATION = 6, 4
OUTCOME = ("reward", "done", "terminated")

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


class Case(NamedTuple):
    loss: LossModule
    batch: TensorDictBase


def backbone(num_frames: int, out_key: str = "features") -> Any:
    network = EnhancedTIT((OBSERVATION,), num_frames, embed_dim=16)
    return Backbone(network, out_keys=[out_key]), network.features_dim


def transitions(action: torch.Tensor, num_frames: int) -> TensorDictBase:
    frames = torch.randn(BATCH, num_frames + 1, OBSERVATION)
    terminated = torch.arange(BATCH).unsqueeze(-1) % 3 == 1
    following = {
        "history": frames[:, 1:],
        "reward": torch.randn(BATCH, 1),
        "done": terminated,
        "terminated": terminated.clone(),
    }
    return TensorDict({"history": frames[:, :-1], "action": action, "next": following}, [BATCH])


def behavior_cloning(**settings: Any) -> Case:
    encoder, size = backbone(num_frames=3)
    actor = ProbabilisticTensorDictSequential(encoder, *make_actor(size, Categorical(3)))
    batch = transitions(torch.randint(3, (BATCH,)), num_frames=3).exclude("next")
    loss = LikelihoodBCLoss(actor, **settings)
    return Case(loss, batch)


def decision_transformer(**settings: Any) -> Case:
    network = DecisionTransformer((OBSERVATION,), action_dim=3, num_frames=5, embed_dim=16)
    predictor = make_dt_predictor(network, DTHead(network.features_dim, 3))
    batch = TensorDict(
        {
            "observation": torch.randn(BATCH, 5, OBSERVATION),
            "action": torch.randn(BATCH, 5, 3),
            "return_to_go": torch.randn(BATCH, 5, 1),
            "timestep": torch.arange(5).expand(BATCH, 5),
            "mask": torch.arange(5).expand(BATCH, 5) > 1,
        },
        [BATCH],
    )
    return Case(MaskedDTLoss(predictor, **settings), batch)


def continuous_cql(actions: int = 2, num_frames: int = 3, **settings: Any) -> Case:
    spec = Bounded(-1, 1, shape=(actions,))
    encoder, size = backbone(num_frames)
    actor = ProbabilisticTensorDictSequential(encoder, *make_squashed_actor(size, spec))
    encoder, size = backbone(num_frames, "critic_features")
    head = ValueOperator(
        MLP(size + actions, 1, num_cells=[8]),
        in_keys=["critic_features", "action"],
        out_keys=["state_action_value"],
    )
    loss = ContinuousCQLLoss(
        actor, TensorDictSequential(encoder, head), action_spec=spec, num_random=2, **settings
    )
    loss.make_value_estimator(gamma=0.9)
    return Case(loss, transitions(torch.rand(BATCH, actions), num_frames))


def continuous_cql_on_single_numbers() -> Case:
    """Every entry of a batch has a second dimension of size 1, which is not a batch dimension."""
    return continuous_cql(actions=1, num_frames=1)


def discrete_cql(**settings: Any) -> Case:
    encoder, size = backbone(num_frames=3)
    head = QValueActor(nn.Linear(size, 3), in_keys=["features"], action_space="categorical")
    network = TensorDictSequential(encoder, head)
    loss = DelayedDiscreteCQLLoss(network, action_space="categorical", **settings)
    loss.make_value_estimator(gamma=0.9)
    return Case(loss, transitions(torch.randint(3, (BATCH,)), num_frames=3))


MAKERS = [behavior_cloning, decision_transformer, continuous_cql, discrete_cql]
each_loss = pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)


def compute(loss: LossModule, *args: Any, **kwargs: Any) -> Any:
    torch.manual_seed(1)
    return loss(*args, **kwargs)


@pytest.mark.parametrize("make", [continuous_cql, discrete_cql], ids=lambda make: make.__name__)
def test_outcomes_are_read_under_the_keys_that_were_set(make: Callable[[], Case]) -> None:
    loss, batch = make()
    expected = compute(loss, batch.clone())
    loss.set_keys(**{key: f"other_{key}" for key in OUTCOME})
    for key in OUTCOME:
        batch["next"].rename_key_(key, f"other_{key}")
    assert_close(compute(loss, batch), expected, rtol=0, atol=0)
    assert set(loss.in_keys) <= set(map(unravel_key, batch.keys(True, True)))


@pytest.mark.parametrize(
    "make", [*MAKERS, continuous_cql_on_single_numbers], ids=lambda make: make.__name__
)
def test_is_called_by_keyword_and_by_position(make: Callable[[], Case]) -> None:
    loss, batch = make()
    assert set(loss.in_keys) == set(map(unravel_key, batch.keys(True, True)))
    terms = compute(loss, batch.clone())
    names = ["_".join(key) if isinstance(key, tuple) else key for key in loss.in_keys]
    values = [batch[key] for key in loss.in_keys]
    expected = [terms[key] for key in loss.out_keys]
    for results in (
        compute(loss, **dict(zip(names, values, strict=True))),
        compute(loss, *values),
        compute(loss, values[0], **dict(zip(names[1:], values[1:], strict=True))),
    ):
        results = [results] if isinstance(results, torch.Tensor) else list(results)
        torch.testing.assert_close(results, expected, rtol=0, atol=0)
    loss.select_out_keys(loss.out_keys[-1])
    torch.testing.assert_close(compute(loss, *values), expected[-1], rtol=0, atol=0)
    assert len(compute(loss, batch.clone()).keys()) == 1


@each_loss
def test_parameters_appear_once_and_all_of_them_train(make: Callable[[], Case]) -> None:
    loss, batch = make()
    for named in (list(loss.named_parameters()), list(loss.named_buffers())):
        assert len({id(tensor) for _, tensor in named}) == len(named)
    terms = compute(loss, batch)
    sum(value.sum() for key, value in terms.items() if key.startswith("loss")).backward()
    assert [name for name, p in loss.named_parameters() if p.grad is None] == []


@each_loss
def test_what_a_batch_holds_is_left_unchanged(make: Callable[[], Case]) -> None:
    loss, batch = make()
    before = batch.clone()
    compute(loss, batch)
    assert_close(batch.select(*before.keys(True, True)), before, rtol=0, atol=0)


@each_loss
def test_reductions(make: Callable[..., Case]) -> None:
    """That of the states or steps, without padding."""
    torch.manual_seed(0)
    first, batch = make()
    losses = {}
    for reduction in (None, "none", "mean", "sum"):
        loss = make(reduction=reduction).loss
        loss.load_state_dict(first.state_dict())
        losses[reduction] = compute(loss, batch.clone())
    for name in (key for key in first.out_keys if key.startswith("loss")):
        each = losses["none"][name]
        assert each.shape[:1] == (BATCH,)
        count = 3 * batch["mask"].sum() if make is decision_transformer else each.numel()
        torch.testing.assert_close(losses["sum"][name], each.sum())
        torch.testing.assert_close(losses["mean"][name], each.sum() / count)
        torch.testing.assert_close(losses[None][name], losses["mean"][name])

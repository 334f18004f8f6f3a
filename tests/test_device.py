"""Everything between a batch and its gradient runs on another device than the CPU.

On "meta", which every machine has, operations compute shapes and no numbers, and a mixture with
tensors on the CPU is refused. ``make test DEVICE=cuda`` runs the same on a GPU, where results are
also compared with the CPU's, and every algorithm trains.
"""

from __future__ import annotations

import copy
import os
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    Unbounded,
)
from torchrl.modules import TanhModule, set_recurrent_mode

from recipes.core import networks, task
from recipes.core.algorithm import to_networks
from recipes.core.recipe import Recipe
from recipes.ppo import PPO, Minibatch
from recipes.replay import _STORED as STORED
from recipes.replay import ReplayAlgorithm
from tests.networks import test_pairs as pairs
from tests.networks.maps import attention_maps
from tests.recipes.small import RECIPES, make_algorithm, train
from torchrl_tit.modules import Backbone, history_keys, make_actor, make_squashed_actor, make_value
from torchrl_tit.networks import EnhancedTIT, masked_predictions
from torchrl_tit.settings import TemporalPositions
from torchrl_tit.windows import find_windows

DEVICE = torch.device(os.environ.get("DEVICE", "meta"))
COMPUTES = DEVICE.type != "meta"
if DEVICE.type == "cuda":
    torch.backends.cudnn.allow_tf32 = False  # three digits only


class NothingOnTheCPU(TorchDispatchMode):
    """Refuses tensors that are made without a device, which a GPU would have to wait for.

    Args:
        numbers: whether single numbers are allowed, which operations on a GPU take as constants.
    """

    def __init__(self, *, numbers: bool = False) -> None:
        super().__init__()
        self.numbers = numbers

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        results = func(*args, **(kwargs or {}))
        for result in results if isinstance(results, list | tuple) else [results]:
            on_cpu = isinstance(result, Tensor) and result.device.type != DEVICE.type
            # PyTorch's attention returns the state of its random numbers.
            numbers = self.numbers or "scaled_dot_product" in str(func)
            assert not on_cpu or (numbers and result.ndim == 0), f"{func} made {result} on the CPU"
        return results


def check(module: nn.Module, result: Tensor, expected: Tensor) -> None:
    """Compares a result with the CPU's, and takes its gradients."""
    assert (result.device.type, result.shape) == (DEVICE.type, expected.shape)
    if COMPUTES:
        torch.testing.assert_close(result.cpu(), expected, rtol=1e-3, atol=1e-4)
    module.zero_grad()
    result.sum().backward()
    gradients = [x.grad for x in module.parameters() if x.grad is not None]
    assert gradients
    assert {gradient.device.type for gradient in gradients} == {DEVICE.type}


def floats(batch: TensorDict) -> TensorDict:
    return batch.apply(lambda x: x.float() if x.is_floating_point() else x)


# How many frames the stored histories have in common depends on the data.
PADDINGS: list[Any] = ["same", "constant"]
READS: list[Any] = ["steps", *PADDINGS, "observations", *(["histories"] if COMPUTES else [])]
FEW_READS: list[Any] = READS if COMPUTES else ["steps", "constant"]
# TorchRL's GRUModule looks whether an episode begins.
MEMORIES = ("lstm", "mingru", "gated-deltanet", "mamba2", *(["gru"] if COMPUTES else []))
CARRIED = [case for case in pairs.APART if case[1] in MEMORIES]


@pairs.apart
def test_networks_read_steps_and_sequences(case: pairs.Pair) -> None:
    network = pairs.build(case)
    there = copy.deepcopy(network).to(DEVICE)
    context = network.history_encoder.context
    keys = [*history_keys(pairs.CASES[case]), *context]
    stored = {padding: floats(pairs.sequences(case, padding)) for padding in PADDINGS}
    for reads in READS if case[0] == "entities" else FEW_READS:
        padding = reads if reads in PADDINGS else None
        batch = stored[padding or "same"]
        if reads == "observations":
            if context:
                continue  # reads the history that goes with them
            batch = batch.exclude(*keys)
        backbones = [Backbone(x, keys, padding=padding) for x in (network, there)]
        with set_recurrent_mode(reads != "steps"):
            expected = backbones[0](batch.clone())["features"]
            batch = batch.to(DEVICE)
            with NothingOnTheCPU():
                result = backbones[1](batch)["features"]
            check(there, result, expected)


@pytest.mark.parametrize("positions", get_args(TemporalPositions))
def test_outer_blocks_read_tables_of_frames(positions: Any) -> None:
    network = EnhancedTIT((6,), 3, embed_dim=8, temporal_positions=positions)
    frames, rows = torch.randn(2 * 5, 6), torch.arange(2 * 5).view(2, 5)
    windows = find_windows(rows, rows[:, :1], 3, "same")._replace(span=5)
    expected = network.encode_windows([frames], windows)
    network.to(DEVICE)
    windows = windows._replace(rows=windows.rows.to(DEVICE))
    frames = frames.to(DEVICE)
    with NothingOnTheCPU():
        result = network.encode_windows([frames], windows)
    check(network, result, expected)


ACTING = [*((case, 3) for case in pairs.APART), *((case, 1) for case in CARRIED)]


@pytest.mark.parametrize(("case", "frames"), ACTING, ids=str)
def test_policies_act(case: pairs.Pair, frames: int) -> None:
    """With kept tokens; with one frame, a recurrent network's state is carried."""
    network = pairs.build(case, num_frames=frames).to(DEVICE)
    context = network.history_encoder.context
    backbone = Backbone(network, [*history_keys(pairs.CASES[case]), *context])
    steps = floats(pairs.sequences(case, "same")).to(DEVICE)
    for key in backbone.history_keys[: len(network.frames)]:
        steps[key] = steps[key][:, :, -frames:]
    with torch.no_grad(), backbone.acting():
        for time in range(2):
            step = steps[:, time].clone()
            for key, shape in backbone.state_shapes.items():
                step[key] = torch.zeros(len(step), *shape, device=DEVICE)
            with NothingOnTheCPU():
                backbone(step)
            assert step["features"].device.type == DEVICE.type


def test_maps_and_masked_predictions() -> None:
    case = ("inner", "coberl")
    network, inputs = pairs.build(case), [x.float() for x in pairs.inputs_of(case, 4)]
    mask = torch.tensor([[True, False, True]]).expand(4, -1)
    expected = masked_predictions(network, inputs, mask)
    network.to(DEVICE)
    targets, predictions = masked_predictions(
        network, [x.to(DEVICE) for x in inputs], mask.to(DEVICE)
    )
    check(network, predictions, expected[1])
    maps = attention_maps(network, *(x.to(DEVICE) for x in inputs))
    assert {x.device.type for x in [*maps.inner, *maps.outer, targets]} == {DEVICE.type}


MASKABLE = [Categorical(3), OneHot(3), MultiCategorical([2, 3]), MultiOneHot([2, 3])]
# Whether a mask allows an action is checked by its values.
HEADS = [(spec, False) for spec in [*MASKABLE, Binary(4), Unbounded((2, 3))]]
HEADS += [(spec, True) for spec in MASKABLE if COMPUTES]


@pytest.mark.parametrize(("spec", "mask"), HEADS, ids=lambda value: type(value).__name__)
def test_heads(spec: Any, mask: bool) -> None:
    actor = make_actor(8, spec, mask_key="action_mask" if mask else None, batch_dims=0)
    steps = TensorDict({"features": torch.randn(5, 8), "action": spec.rand((5,))}, [5])
    options = 5 if isinstance(spec, MultiCategorical | MultiOneHot) else 3
    steps["action_mask"] = torch.ones(5, options).bool()
    expected = actor.get_dist(steps).log_prob(steps["action"])
    actor.to(DEVICE)
    steps = steps.to(DEVICE)
    with NothingOnTheCPU():
        result = actor.get_dist(steps).log_prob(steps["action"])
    check(actor, result, expected)


def test_squashed_actor_and_value() -> None:
    actor, value = make_squashed_actor(8, Bounded(-1, 1, (2,))), make_value(8)
    steps = TensorDict({"features": torch.randn(5, 8)}, [5])
    for module, key in ((actor.module[0], "loc"), (value, "state_value")):
        expected = module(steps.clone())[key]
        check(module, module.to(DEVICE)(steps.to(DEVICE))[key], expected)
    if COMPUTES:  # TorchRL's TanhNormal reads its bounds
        actor.to(DEVICE).get_dist(steps.to(DEVICE)).rsample().sum().backward()


class Agreeing(TorchDispatchMode):
    """Answers what is asked about tensors without numbers: yes, and 1."""

    asked = 0
    """How often a number was read back."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        first = args[0] if args and isinstance(args[0], Tensor) else None
        if first is not None and first.is_meta:
            if func is torch.ops.aten._local_scalar_dense.default:
                self.asked += 1
                return torch.ones((), dtype=first.dtype, device="cpu").item()
            if func is torch.ops.aten.is_set_to.default:
                return False
        return func(*args, **(kwargs or {}))


UNASKED = ("dqn", "bc", "iql", "discrete-cql", "dt")  # TorchRL's TanhNormal asks for its bounds


@pytest.mark.parametrize("name", RECIPES)
def test_updates_of_each_algorithm(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = RECIPES[name](tmp_path)
    if COMPUTES:
        train(replace(recipe, device=str(DEVICE)), tmp_path / "run")
        return
    if name.endswith((", lstm", ", gru")):
        pytest.skip("TorchRL's LSTM and GRU find where episodes begin in sequences by numbers")
    if name == "td3bc":
        pytest.skip("TorchRL's loss asks whether its bounds are wrong")
    batch = batch_of(recipe, tmp_path)
    monkeypatch.setattr(task, "torch_device", lambda _: torch.device("cpu"))  # specs have numbers
    monkeypatch.setattr(networks, "TanhModule", squash)
    for kind in (torch.optim.Adam, torch.optim.AdamW):  # fused ones do not run on "meta"
        plain = partial(optimizer, kind)
        monkeypatch.setattr(torch.optim, kind.__name__, plain)
    with Agreeing() as agreeing:
        algorithm = make_algorithm(replace(recipe, device="meta"))
        algorithm.make_collector = lambda *_, **__: None
        algorithm.prepare(0, tmp_path)
        if isinstance(algorithm, ReplayAlgorithm):
            algorithm.buffer.extend(batch)
            batch = to_networks(algorithm.buffer.sample(), DEVICE)
        elif not isinstance(recipe, PPO):
            batch = next(algorithm.batches())
        if not isinstance(recipe, PPO):  # the data stay on the CPU
            stored = algorithm.buffer.sample()
            assert {x.device.type for x in stored.values(True, True)} == {"cpu"}
        agreeing.asked = 0
        # Numbers are of TorchRL's losses and of optimizers; its TanhNormal compares bounds there.
        with nullcontext() if name.startswith("sac") else NothingOnTheCPU(numbers=True):
            if isinstance(recipe, PPO):
                terms = algorithm._step(batch)
            elif isinstance(algorithm, ReplayAlgorithm):
                terms = algorithm.learn(batch, 0)
            else:
                terms = algorithm.update(batch, 0)
    if name.split(",")[0] in UNASKED:
        assert not agreeing.asked, "a GPU would be waited for"
    terms = {"terms": terms} if isinstance(terms, Tensor) else terms
    assert {x.device.type for x in terms.values() if isinstance(x, Tensor)} == {"meta"}
    assert {x.device.type for x in algorithm.model.parameters()} == {"meta"}


def squash(low: Tensor, high: Tensor, **settings: Any) -> TanhModule:
    """TorchRL's asks, too, but for bounds with numbers."""
    return TanhModule(low=-torch.ones(len(low)), high=torch.ones(len(high)), **settings)


def optimizer(kind: Any, *args: Any, fused: bool = False, **settings: Any) -> Any:
    return kind(*args, foreach=False, **settings)


def batch_of(recipe: Recipe, folder: Path) -> Any:
    """What an update reads, made on the CPU."""
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, folder)
    batch = next(iter(algorithm.batches()))
    if isinstance(algorithm, ReplayAlgorithm):
        return algorithm.collected(batch).select(*STORED, strict=False)
    if isinstance(recipe, PPO):
        with torch.no_grad():
            batch = algorithm.collected(batch)
        rollout = algorithm.rollout(batch)
        algorithm.advantages(batch, rollout)
        steps, frames, windows = next(algorithm.minibatches(batch, rollout))
        windows = windows._replace(rows=windows.rows.to(DEVICE))
        return Minibatch(steps.to(DEVICE), [x.to(DEVICE) for x in frames], windows)
    return batch

"""Features of s and s' with shared frames are those of two separate passes, gradients too."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictParams,
    TensorDictSequential,
    set_skip_existing,
)
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical
from torchrl.modules import MLP, QValueModule, ValueOperator, set_recurrent_mode

from torchrl_tit.datasets import HistoryStorage, episodes_from_arrays
from torchrl_tit.modules import Backbone, make_squashed_actor
from torchrl_tit.networks import TwoTrunks, build_network
from torchrl_tit.objectives import ContinuousCQLLoss, DelayedDiscreteCQLLoss, cql, encode_pairs
from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp, vanilla_tit

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

FRAMES, SIZE, STEPS = 4, 6, 40
SMALL: dict[str, Any] = {"embed_dim": 8, "features_dim": 8}
SPEC = Bounded(-torch.ones(2), torch.ones(2), shape=(2,))


def draw(
    length: int = 1, padding: Any = "same", *, images: bool = False, discrete: bool = False
) -> TensorDictBase:
    """All steps of short episodes; some are terminated, whose last observations are zeros.

    One by one, [STEPS], or in slices that contain ends of episodes, [STEPS / length, length].
    """
    generator = torch.Generator().manual_seed(0)

    def observe() -> Tensor:
        if images:
            shape = (STEPS, 36, 36)
            return torch.randint(0, 256, shape, generator=generator).to(torch.uint8)
        return torch.randn(STEPS, SIZE, generator=generator, dtype=torch.float64)

    ends = torch.arange(STEPS) % 7 == 6
    terminals = ends & (torch.arange(STEPS) % 2 == 0)
    observations, last = observe(), observe()
    following = torch.cat([observations[1:], last[:1]])
    following[ends] = last[ends]
    actions = torch.rand(STEPS, 2, generator=generator) * 2 - 1
    if discrete:
        actions = torch.randint(3, (STEPS,), generator=generator)
    episodes = episodes_from_arrays(
        observations, actions, torch.randn(STEPS), terminals, ends & ~terminals, following
    )
    storage = HistoryStorage(
        episodes,
        FRAMES,
        padding=padding,
        terminal_observations="zero",
        unfinished="keep",
        is_init=length > 1,
    )
    index = torch.arange(STEPS)
    batch = storage[index if length == 1 else index.view(-1, length)]
    return batch.apply(lambda x: x.double() if x.is_floating_point() else x)


def make_backbone(network: Network, shape: tuple[int, ...] = (SIZE,), **settings: Any) -> Backbone:
    torch.manual_seed(0)
    return Backbone(build_network(network, shape, trunks="shared").double(), **settings)


def two_passes(network: Any, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    """As `encode_pairs`, with a pass for s and one for s', of single transitions."""
    here, there = (group.select("history") for group in (tensordict, tensordict["next"]))
    backbone = next(module for module in network.modules() if isinstance(module, Backbone))
    with torch.no_grad():
        there = backbone(there)
    return backbone(here), there


def gradients(loss: Tensor, params: Any) -> list[Tensor]:
    weights = [w for w in params if w.requires_grad]
    return list(torch.autograd.grad(loss, weights, materialize_grads=True))


NETWORKS = {
    "enhanced": enhanced_tit(FRAMES, **SMALL),
    "vanilla": vanilla_tit(FRAMES, **SMALL),
    "positions": enhanced_tit(FRAMES, temporal_positions="learned", **SMALL),
    "lstm": lstm(FRAMES, embed_dim=8, hidden_dim=8, features_dim=8),
}


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("length", [1, 2, 8])
@pytest.mark.parametrize("name", NETWORKS)
def test_features_and_gradients(name: str, length: int, padding: Any) -> None:
    """Of transitions one by one, and of slices that contain ends of episodes."""
    backbone = make_backbone(NETWORKS[name])
    single, slices = draw(1, padding), draw(length, padding)
    assert length == 1 or slices["is_init"][:, 1:].any()
    results = []
    for batch, function in ((single, two_passes), (slices, encode_pairs)):
        here, there = (td["features"].flatten(0, -2) for td in function(backbone, batch))
        assert not there.requires_grad
        weights = torch.linspace(-1, 1, here.numel()).view_as(here)
        results.append((here, there, *gradients((here * weights).sum(), backbone.parameters())))
    assert any(gradient.abs().max() > 1e-3 for gradient in results[0][2:])
    torch.testing.assert_close(results[1], results[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("length", [1, 8])
def test_images_with_functional_weights(length: int) -> None:
    network = enhanced_tit(FRAMES, patch_size=12, **SMALL)
    backbone = make_backbone(network, (36, 36))
    weights = TensorDict.from_module(backbone)
    params = TensorDictParams(weights.apply(lambda weight: weight.detach() + 0.1))
    plain = backbone(draw(images=True))["features"]
    results = []
    with params.to_module(backbone):
        for td, function in (
            (draw(images=True), two_passes),
            (draw(length, images=True), encode_pairs),
        ):
            here, there = (td["features"].flatten(0, -2) for td in function(backbone, td))
            loss = (here * torch.linspace(-1, 1, here.numel()).view_as(here)).sum()
            results.append((here, there, *gradients(loss, params.parameters())))
    torch.testing.assert_close(results[1], results[0], rtol=1e-9, atol=1e-9)
    assert not torch.allclose(results[0][0], plain)  # other weights


@pytest.mark.parametrize("length", [1, 2, 8])
def test_each_frame_is_encoded_once(length: int) -> None:
    backbone = make_backbone(NETWORKS["enhanced"])
    encoded: list[tuple[int, bool]] = []
    backbone.module.frames[0].register_forward_hook(
        lambda _, frames, tokens: encoded.append((len(frames[0]), tokens.requires_grad))
    )
    batch = draw(length)
    encode_pairs(backbone, batch)
    if length == 1:
        assert encoded == [(STEPS * FRAMES, True), (STEPS, False)]
        return
    # The frames of a slice, and K for each episode that begins within it, but for its first step.
    slices, begun = STEPS // length, int(batch["is_init"][:, 1:].sum())
    frames = slices * (FRAMES + length - 1) + begun * (FRAMES - 1)
    assert encoded == [(frames, True), (slices + begun, False)]


def test_two_trunks_and_autocast() -> None:
    trunks = [build_network(NETWORKS["vanilla"], (SIZE,)) for _ in range(2)]
    keys = ["policy", "value"]
    backbone = Backbone(TwoTrunks(*trunks).float(), out_keys=keys, autocast=torch.bfloat16)  # type: ignore[arg-type]
    batch = draw()
    batch = batch.apply(lambda x: x.float() if x.is_floating_point() else x)
    expected = two_passes(backbone, batch)
    for td, other in zip(encode_pairs(backbone, batch), expected, strict=True):
        for key in keys:
            assert td[key].dtype == torch.float32
            torch.testing.assert_close(td[key], other[key], rtol=2e-2, atol=2e-2)


@pytest.mark.parametrize("length", [1, 8])
def test_networks_without_frame_encoders_are_left_alone(length: int) -> None:
    backbone = make_backbone(mlp(FRAMES), observation_keys=["observation"])
    here, there = encode_pairs(backbone, draw(length))
    assert here.get("features", None) is None
    with set_skip_existing(True), set_recurrent_mode(True):
        features = backbone(here)["features"].flatten(0, -2)
    expected = make_backbone(mlp(FRAMES))(draw())["features"]
    torch.testing.assert_close(features, expected, rtol=1e-9, atol=1e-9)
    assert there["history"].shape == here["history"].shape


def make_continuous(network: Network, *, slices: bool) -> ContinuousCQLLoss:
    """Actor and critics, each on a backbone of its own."""
    keys = ["observation"] if slices else None
    backbone = make_backbone(network, observation_keys=keys)
    head = make_squashed_actor(backbone.features_dim, SPEC)
    critics = []
    for _ in range(2):
        trunk = build_network(network, (SIZE,), trunks="shared")
        first = Backbone(trunk, out_keys=["critic_features"], observation_keys=keys)
        q = MLP(trunk.features_dim + 2, 1, num_cells=[8])
        critics.append(
            TensorDictSequential(first, ValueOperator(q, in_keys=["critic_features", "action"]))
        )
    actor = ProbabilisticTensorDictSequential(backbone, *head)
    loss = ContinuousCQLLoss(actor, critics, action_spec=SPEC, deactivate_vmap=True, num_random=3)
    loss.make_value_estimator(gamma=0.9)
    return loss.double()


TERMS = ("loss_actor", "loss_qvalue", "loss_cql", "loss_alpha")


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("length", [1, 4, 8])
@pytest.mark.parametrize("network", [NETWORKS["enhanced"], mlp(FRAMES, hidden_dim=8)])
def test_continuous_cql(
    monkeypatch: pytest.MonkeyPatch, network: Network, length: int, padding: Any
) -> None:
    """The whole loss of slices, and of transitions that share frames, against separate passes."""
    results = []
    for slices in (False, True):
        loss = make_continuous(network, slices=slices and length > 1)
        batch = draw(length if slices else 1, padding)
        with monkeypatch.context() as patch:
            if not slices:
                patch.setattr(cql, "encode_pairs", two_passes)
            torch.manual_seed(1)
            terms = loss(batch)
            total = torch.stack([terms[name] for name in TERMS]).sum()
            got = gradients(total, loss.parameters())
            loss.zero_grad()
            torch.manual_seed(1)
            chunks = loss.critic_gradients(batch, loss.sample_policy(batch), chunk_size=12)
        in_chunks = [
            w.grad for w in loss.qvalue_network_params.values(True, True) if w.requires_grad
        ]
        results.append((*(terms[name] for name in TERMS), *got, *chunks, *in_chunks))
    torch.testing.assert_close(results[1], results[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("length", [4, 8])
def test_discrete_cql(length: int) -> None:
    results = []
    for slices in (False, True):
        keys = ["observation"] if slices else None
        backbone = make_backbone(NETWORKS["enhanced"], observation_keys=keys)
        head = TensorDictModule(nn.Linear(8, 3), ["features"], ["action_value"])
        network = TensorDictSequential(backbone, head, QValueModule(spec=Categorical(3)))
        loss = DelayedDiscreteCQLLoss(network, action_space="categorical")
        loss.make_value_estimator(gamma=0.9)
        for weight in loss.target_value_network_params.values(True, True):
            weight.data.mul_(1.1)
        terms = loss(draw(length if slices else 1, discrete=True))
        total = terms["loss_qvalue"] + terms["loss_cql"]
        results.append((total, terms["pred_value"], *gradients(total, loss.parameters())))
    torch.testing.assert_close(results[1], results[0], rtol=1e-9, atol=1e-9)

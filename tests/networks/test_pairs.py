"""Every frame encoder with every history encoder: a pair works everywhere, or says why not."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.func import functional_call, stack_module_state
from torchrl.modules import set_recurrent_mode

from torchrl_tit import settings
from torchrl_tit.histories import RecurrentEncoder
from torchrl_tit.modules import Backbone
from torchrl_tit.networks import HistoryNetwork, TwoTrunks, build_network, masked_predictions
from torchrl_tit.settings import FrameSettings, HistorySettings

NUM_FRAMES, WIDTH, ACTIONS = 3, 8, 2

SMALL_BLOCKS: dict[str, Any] = {"num_heads": 2, "ffn_expansion": 1}
FRAMES: dict[str, FrameSettings] = {
    "flat": settings.Flat(),
    "linear": settings.Linear(embed_dim=WIDTH, bias=True, activation="tanh"),
    "inner": settings.Inner(patch_size=4, embed_dim=WIDTH, **SMALL_BLOCKS),
    "resnet": settings.ResNetFrames(embed_dim=WIDTH),
    "nature-cnn": settings.NatureCNNFrames(embed_dim=WIDTH),
}
HISTORIES: dict[str, HistorySettings] = {
    "outer": settings.Outer(ffn_expansion=1, temporal_positions="rotary"),
    "paired-outer": settings.PairedOuter(**SMALL_BLOCKS, temporal_positions="learned"),
    "chained-outer": settings.ChainedOuter(**SMALL_BLOCKS, temporal_positions="relative"),
    "stacked-inner": settings.StackedInner(patch_size=4, embed_dim=WIDTH, **SMALL_BLOCKS),
    "stacked-cnn": settings.StackedCNN(),
    "mlp": settings.MLP(hidden_dim=WIDTH),
    "ofenet": settings.OFENet(hidden_dim=WIDTH),
    "d2rl": settings.D2RL(hidden_dim=WIDTH),
    "catformer": settings.Catformer(**SMALL_BLOCKS),
    "coberl": settings.CoBERL(**SMALL_BLOCKS, num_blocks=1, hidden_dim=WIDTH),
    "gtrxl": settings.GTrXL(**SMALL_BLOCKS, num_blocks=1),
    "lstm": settings.LSTM(hidden_dim=WIDTH),
    "gru": settings.GRU(hidden_dim=WIDTH),
    "decision-transformer": settings.DecisionTransformer(
        num_blocks=2, num_heads=2, ffn_dim=WIDTH, max_ep_len=10
    ),
}
Pair = tuple[str, str]
READ_FRAMES = ("stacked-inner", "stacked-cnn")
REFUSED: dict[Pair, str] = {
    (frame, history): "stacks the frames themselves, not tokens: choose flat frames"
    for frame in FRAMES
    for history in READ_FRAMES
    if frame != "flat"
}
PAIRS = [(f, h) for f in FRAMES for h in HISTORIES if (f, h) not in REFUSED]
every_pair = pytest.mark.parametrize("pair", PAIRS, ids="+".join)
# Tracing takes seconds, and the two encoders of a pair are traced apart: each history encoder
# once, on several tokens where it reads tokens (on one in tests/modules/test_sequences.py), and
# each frame encoder once.
TRACED = [p for p in PAIRS if p[0] == ("flat" if p[1] in READ_FRAMES else "inner")]
TRACED += [p for p in PAIRS if p[1] == "outer" and p[0] != "inner"]


def shape_of(pair: Pair) -> tuple[int, ...]:
    """An image for convolutions, as small as they allow, else an array."""
    frame, history = pair
    return (36, 36) if history == "stacked-cnn" or frame in ("resnet", "nature-cnn") else (6,)


def build(pair: Pair, seed: int = 0, num_frames: int = NUM_FRAMES) -> HistoryNetwork:
    frame, history = pair
    torch.manual_seed(seed)
    return HistoryNetwork(
        FRAMES[frame],
        HISTORIES[history],
        observation_shape=shape_of(pair),
        num_frames=num_frames,
        head=settings.Head(features_dim=4),
        action_dim=ACTIONS,
    ).eval()


@cache
def network_of(pair: Pair) -> HistoryNetwork:
    """A network in float64, which tests leave as it is."""
    return build(pair).double()


def inputs_of(pair: Pair, *leading: int) -> list[Tensor]:
    """A history and what the history encoder reads beside, in float64."""
    generator = torch.Generator().manual_seed(1)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*leading, NUM_FRAMES, *shape, generator=generator, dtype=torch.float64)

    context = {
        "action": draw(ACTIONS),
        "return_to_go": draw(1),
        "timestep": torch.arange(NUM_FRAMES).expand(*leading, -1),
        "mask": torch.ones(*leading, NUM_FRAMES, dtype=torch.bool),
    }
    history = draw(*shape_of(pair))
    return [history, *(context[name] for name in network_of(pair).history_encoder.context)]


@pytest.fixture
def _fresh_compiler() -> Iterator[None]:
    torch.compiler.reset()
    yield
    torch.compiler.reset()


def own(registered: dict[str, type[Any]]) -> set[str]:
    """Names of the parts of this library: tests may have registered others."""
    return {name for name, part in registered.items() if part.__module__.startswith("torchrl_tit.")}


def test_all_registered_parts_are_here() -> None:
    assert set(FRAMES) == own(FrameSettings.registered)
    assert set(HISTORIES) == own(HistorySettings.registered)
    assert all(FRAMES[name].name == name for name in FRAMES)
    assert all(HISTORIES[name].name == name for name in HISTORIES)


@pytest.mark.parametrize("pair", REFUSED, ids="+".join)
def test_a_pair_that_cannot_work_says_why(pair: Pair) -> None:
    with pytest.raises(ValueError, match=REFUSED[pair]) as error:
        build(pair)
    assert "\n" not in str(error.value)


@every_pair
def test_values_and_gradients_are_finite(pair: Pair) -> None:
    network = network_of(pair)
    features = network(*inputs_of(pair, 4))
    assert features.shape == (4, network.features_dim) == (4, 4)
    assert features.isfinite().all()
    parameters = dict(network.named_parameters())
    # Of CoBERL, the contrastive loss alone hides frames.
    hidden = {name: parameters.pop(name) for name in list(parameters) if "mask_token" in name}
    probe = torch.linspace(-1, 1, features.numel(), dtype=torch.float64).view_as(features)
    gradients = torch.autograd.grad((features * probe).sum(), list(parameters.values()))
    for name, gradient in zip(parameters, gradients, strict=True):
        assert gradient.isfinite().all(), name
        assert gradient.any(), name
    if hidden:
        mask = torch.tensor([[True, False, True]]).expand(4, -1)
        _, predictions = masked_predictions(network, inputs_of(pair, 4)[0], mask)
        for gradient in torch.autograd.grad(predictions.square().sum(), list(hidden.values())):
            assert gradient.any()


@every_pair
def test_a_frame_changes_its_own_tokens_and_the_features(pair: Pair) -> None:
    network = network_of(pair)
    history, *context = inputs_of(pair, 2)
    with torch.no_grad():
        tokens, features = network.encode_frames(history), network(history, *context)
        for step in range(NUM_FRAMES):
            changed = history.clone()
            changed[:, step] = torch.randn(2, *shape_of(pair))
            same = network.encode_frames(changed) == tokens
            others = [other for other in range(NUM_FRAMES) if other != step]
            assert same[:, others].all()
            assert not same[:, step].all()
            assert not torch.equal(network(changed, *context), features)


@every_pair
def test_acting_with_kept_frames_equals_the_full_pass(pair: Pair) -> None:
    network = network_of(pair)
    names = network.history_encoder.context
    backbone = Backbone(network, ["history", *names], ["features"])
    frames = torch.randn(2, 7, *shape_of(pair), dtype=torch.float64)
    _, *context = inputs_of(pair, 2)
    history = frames[:, :1].expand(-1, NUM_FRAMES, *shape_of(pair)).clone()
    with torch.no_grad(), backbone.acting():
        for step in range(1, 7):
            history = torch.cat([history[:, 1:], frames[:, step : step + 1]], dim=1)
            if step == 4:  # the first environment starts anew
                history[0] = frames[0, step]
            entries = {"history": history, **dict(zip(names, context, strict=True))}
            features = backbone(TensorDict(entries, [2]))["features"]
            torch.testing.assert_close(features, network(history, *context))
    assert backbone.keeps_frames == (pair[0] != "flat")


@every_pair
def test_state_dict_round_trip(pair: Pair) -> None:
    network, fresh, inputs = network_of(pair), build(pair, seed=1).double(), inputs_of(pair, 2)
    assert not torch.equal(fresh(*inputs), network(*inputs))
    file = io.BytesIO()
    torch.save(network.state_dict(), file)
    file.seek(0)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(fresh(*inputs), network(*inputs))


@pytest.mark.parametrize("pair", TRACED, ids="+".join)
def test_export(pair: Pair) -> None:
    network, inputs = network_of(pair), inputs_of(pair, 2)
    exported = torch.export.export(network, tuple(inputs)).module()
    torch.testing.assert_close(exported(*inputs), network(*inputs))


@pytest.mark.parametrize("pair", TRACED, ids="+".join)
@pytest.mark.usefixtures("_fresh_compiler")
def test_compile_in_one_graph(pair: Pair) -> None:
    """The backward pass once for each history encoder: tracing it takes as long again."""
    check_compiled(pair, "aot_eager", backward=pair[0] == "inner" or pair[1] in READ_FRAMES)


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("c++") is None and shutil.which("g++") is None, reason="no C++ compiler"
)
@pytest.mark.parametrize(
    "pair", [("linear", "coberl"), ("linear", "decision-transformer")], ids="+".join
)
@pytest.mark.usefixtures("_fresh_compiler")
def test_real_compilation(pair: Pair) -> None:
    """Enhanced_TIT and its gradients are compiled in tests/recipes/ppo/test_rollout.py."""
    check_compiled(pair, "inductor", backward=pair[1] != "coberl")


def check_compiled(pair: Pair, backend: str, *, backward: bool) -> None:
    network, inputs = network_of(pair), inputs_of(pair, 2)
    compiled = torch.compile(network, fullgraph=True, backend=backend)
    results = []
    for call in (network, compiled):
        inputs[0] = inputs[0].detach().requires_grad_(backward)
        with torch.set_grad_enabled(backward):
            results.append([call(*inputs)])
        if backward:
            weights = [inputs[0], *network.parameters()]
            loss = results[-1][0].square().sum()
            results[-1] += torch.autograd.grad(loss, weights, materialize_grads=True)
    torch.testing.assert_close(results[1], results[0])


# On CPUs, PyTorch's attention kernel runs once per set of parameters, and says so.
@pytest.mark.filterwarnings("ignore:There is a performance drop")
@every_pair
def test_vmap_over_stacked_parameters(pair: Pair) -> None:
    networks, inputs = [network_of(pair), build(pair, seed=1).double()], inputs_of(pair, 2)
    state = stack_module_state(networks)

    def call(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
        return functional_call(networks[0], (parameters, buffers), tuple(inputs))

    expected = torch.stack([network(*inputs) for network in networks])
    torch.testing.assert_close(torch.vmap(call)(*state), expected)


def test_several_observations_stand_side_by_side() -> None:
    """Pixels and a state: two frame encoders, whose tokens one history encoder reads."""
    shapes = {"pixels": (36, 36), "state": (6,)}
    network = HistoryNetwork(
        {"pixels": FRAMES["resnet"], "state": FRAMES["inner"]},
        HISTORIES["paired-outer"],
        observation_shape=shapes,
        num_frames=NUM_FRAMES,
    ).double()
    assert list(network.frame_encoders) == list(shapes)
    pixels, state = (
        torch.randn(2, 9, *shape, dtype=torch.float64, requires_grad=True)
        for shape in shapes.values()
    )
    window = slice(0, NUM_FRAMES)
    tokens = network.encode_frames(pixels[:, window], state[:, window])
    assert tokens.shape == (2, NUM_FRAMES, 1 + 2, WIDTH)
    alone = network.frame_encoders["pixels"](pixels[:, window])
    torch.testing.assert_close(tokens[:, :, :1], alone)
    features = network(pixels[:, window], state[:, window])
    for gradient in torch.autograd.grad(features.square().sum(), [pixels, state]):
        assert gradient[:, window].flatten(2).any(-1).all()

    backbone = Backbone(network, ["pixels", ("nested", "state")], ["features"])
    with torch.no_grad(), backbone.acting():
        for step in range(6):
            window = slice(step, step + NUM_FRAMES)
            entries = {"pixels": pixels[:, window], "nested": {"state": state[:, window]}}
            features = backbone(TensorDict(entries, [2]))["features"]
            torch.testing.assert_close(features, network(pixels[:, window], state[:, window]))


def test_two_trunks_act_apart() -> None:
    system = settings.Network(
        frame=FRAMES["inner"],
        history=HISTORIES["outer"],
        num_frames=NUM_FRAMES,
        trunks="separate",
    )
    network = build_network(system, (6,)).double()
    assert isinstance(network, TwoTrunks)
    frames = torch.randn(2, 9, 6, dtype=torch.float64)
    policy, value = network(frames[:, :NUM_FRAMES])
    assert not torch.allclose(policy, value)
    policy.square().sum().backward()
    assert all(p.grad is not None for p in network.policy.parameters())
    assert all(p.grad is None for p in network.value.parameters())
    assert isinstance(build_network(system, (6,), trunks="shared"), HistoryNetwork)

    backbone = Backbone(network, ["history"], ["policy_features", "value_features"])
    with torch.no_grad(), backbone.acting():
        for step in range(6):
            history = frames[:, step : step + NUM_FRAMES]
            features = backbone(TensorDict({"history": history}, [2]))
            for name, expected in zip(("policy", "value"), network(history), strict=True):
                torch.testing.assert_close(features[f"{name}_features"], expected)


@pytest.mark.parametrize(
    "pair", [*((frame, "lstm") for frame in FRAMES), ("linear", "gru")], ids="+".join
)
def test_a_carried_state_reads_a_sequence_as_single_steps(pair: Pair) -> None:
    """With one frame an LSTM carries its state, whichever frame encoder stands before it."""
    network = build(pair, num_frames=1).double()
    encoder = network.history_encoder
    assert isinstance(encoder, RecurrentEncoder)
    backbone = Backbone(network, ["history"], ["features"])
    assert backbone.is_recurrent
    steps = 5
    is_init = torch.zeros(2, steps, 1, dtype=torch.bool)
    is_init[:, 0] = is_init[0, 3] = True
    sequence = TensorDict(
        {
            "history": torch.randn(2, steps, 1, *shape_of(pair), dtype=torch.float64),
            "is_init": is_init,
            **{
                key: torch.zeros(2, steps, *shape, dtype=torch.float64)
                for key, shape in encoder.state_shapes.items()
            },
        },
        [2, steps],
    )
    with set_recurrent_mode(True):
        expected = backbone(sequence.clone())["features"]
    state = sequence[:, 0].select(*encoder.state_shapes)
    for step in range(steps):
        entries = sequence[:, step].clone().update(state)
        entries = backbone(entries)
        torch.testing.assert_close(entries["features"], expected[:, step])
        state = entries["next"].select(*encoder.state_shapes)


WRONG_PAIRS: dict[str, tuple[Any, Any, Any, str]] = {
    "several observations, stacked": (
        settings.Flat(),
        settings.StackedCNN(),
        {"left": (36, 36), "right": (36, 36)},
        "StackedCNN stacks the frames themselves, not tokens: choose flat frames of one observ",
    ),
    "widths differ": (
        {"pixels": settings.ResNetFrames(embed_dim=8), "state": settings.Linear(embed_dim=16)},
        settings.Outer(),
        {"pixels": (36, 36), "state": (6,)},
        r"tokens of the widths 8 \(pixels\) and 16 \(state\) cannot stand side by side: give both",
    ),
    "an encoder is missing": (
        {"pixels": settings.ResNetFrames()},
        settings.Outer(),
        {"pixels": (36, 36), "state": (6,)},
        "there are frame encoders for pixels, but observations pixels, state: name one for each",
    ),
    "heads do not divide the width of tokens": (
        settings.Linear(embed_dim=10),
        settings.Outer(num_heads=4),
        (6,),
        "the width 10 cannot be split over 4 attention heads",
    ),
    "heads do not divide the width of flat frames": (
        settings.Flat(),
        settings.Catformer(num_heads=5),
        (6,),
        "the width 6 cannot be split over 5 attention heads",
    ),
    "heads do not divide the width of gated blocks": (
        settings.Linear(embed_dim=12),
        settings.CoBERL(num_heads=8),
        (6,),
        "the width 12 cannot be split over 8 attention heads",
    ),
    "stacked images are too small": (
        settings.Flat(),
        settings.StackedCNN(),
        (36, 35),
        "images of 36 x 35 pixels are too small .* must have at least 36",
    ),
    "images are too small": (
        settings.NatureCNNFrames(),
        settings.Outer(),
        (3, 20, 84),
        "images of 20 x 84 pixels are too small .* must have at least 36",
    ),
    "convolutions on arrays": (
        settings.ResNetFrames(),
        settings.Outer(),
        (6,),
        r"observation_shape \(6,\) is that of an array, but this encoder reads images",
    ),
    "stacked convolutions on arrays": (
        settings.Flat(),
        settings.StackedCNN(),
        (6,),
        r"observation_shape \(6,\) is that of an array, but this encoder reads images",
    ),
    "the patch does not divide the image": (
        settings.Inner(patch_size=10),
        settings.Outer(),
        (36, 36),
        "patch_size 10 does not divide the image of 36 x 36 pixels: choose one of",
    ),
    "the patch does not divide the stacked images": (
        settings.Flat(),
        settings.StackedInner(patch_size=10),
        (36, 36),
        "patch_size 10 does not divide the image of 36 x 36 pixels: choose one of",
    ),
    "no actions": (
        settings.Linear(embed_dim=8),
        settings.DecisionTransformer(),
        (6,),
        "Decision Transformer reads actions and returns .*: give action_dim",
    ),
}


@pytest.mark.parametrize("case", WRONG_PAIRS)
def test_parts_that_do_not_fit_each_other_or_the_observation(case: str) -> None:
    frame, history, shape, message = WRONG_PAIRS[case]
    with pytest.raises(ValueError, match=message) as error:
        HistoryNetwork(frame, history, observation_shape=shape, num_frames=NUM_FRAMES)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("num_frames", [0, -1, True, 2.0, "4"])
def test_number_of_frames(num_frames: Any) -> None:
    with pytest.raises(ValueError, match="num_frames is the number K of observations and must be"):
        HistoryNetwork(
            settings.Linear(), settings.Outer(), observation_shape=(6,), num_frames=num_frames
        )


def test_as_many_histories_as_observations() -> None:
    network = network_of(("linear", "mlp"))
    history = inputs_of(("linear", "mlp"), 2)[0]
    with pytest.raises(ValueError, match=r"reads 1 histories \(observation\), not 2"):
        network.encode_frames(history, history)

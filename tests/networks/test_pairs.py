"""Every frame encoder with every history encoder: a pair works everywhere, or says why not.

Arrays and images with all pairs; categories, and several observations at once, with some.
"""

from __future__ import annotations

import copy
import io
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.func import functional_call, stack_module_state
from torchrl.data import Bounded, MultiCategorical, Unbounded
from torchrl.modules import set_recurrent_mode

from tests.networks.reference import randomize
from torchrl_tit import settings
from torchrl_tit.frames import read_observations
from torchrl_tit.modules import Backbone, history_keys
from torchrl_tit.networks import (
    EnhancedTIT,
    HistoryNetwork,
    TwoTrunks,
    build_network,
    masked_predictions,
)
from torchrl_tit.settings import FrameSettings, HistorySettings
from torchrl_tit.settings.choices import Padding

NUM_FRAMES, WIDTH, ACTIONS = 3, 8, 2
N, T = 3, 7
# Episodes begin within the first two sequences; the third lies inside one.
IS_INIT = torch.zeros(N, T, 1, dtype=torch.bool)
IS_INIT[0, 0] = IS_INIT[0, 2] = IS_INIT[0, 3] = IS_INIT[1, 4] = True

BLOCKS: dict[str, Any] = {"num_heads": 2, "ffn_expansion": 1}
FRAMES: dict[str, FrameSettings] = {
    "flat": settings.Flat(),
    "linear": settings.Linear(embed_dim=WIDTH, bias=True, activation="tanh"),
    "inner": settings.Inner(patch_size=4, embed_dim=WIDTH, **BLOCKS),
    "entities": settings.Entities(embed_dim=WIDTH, **BLOCKS),
    "resnet": settings.ResNetFrames(embed_dim=WIDTH),
    "nature-cnn": settings.NatureCNNFrames(embed_dim=WIDTH),
}
HISTORIES: dict[str, HistorySettings] = {
    "outer": settings.Outer(ffn_expansion=1, temporal_positions="rotary"),
    "outer, sliding": settings.Outer(ffn_expansion=1, attention_frames=2),
    "paired-outer": settings.PairedOuter(**BLOCKS, temporal_positions="learned"),
    "chained-outer": settings.ChainedOuter(**BLOCKS, temporal_positions="relative"),
    "stacked-inner": settings.StackedInner(patch_size=4, embed_dim=WIDTH, **BLOCKS),
    "stacked-cnn": settings.StackedCNN(),
    "mlp": settings.MLP(hidden_dim=WIDTH),
    "ofenet": settings.OFENet(hidden_dim=WIDTH),
    "d2rl": settings.D2RL(hidden_dim=WIDTH),
    "catformer": settings.Catformer(**BLOCKS),
    "coberl": settings.CoBERL(**BLOCKS, num_blocks=1, hidden_dim=WIDTH),
    "gtrxl": settings.GTrXL(**BLOCKS, num_blocks=1),
    "lstm": settings.LSTM(hidden_dim=WIDTH),
    "gru": settings.GRU(hidden_dim=WIDTH),
    "mingru": settings.MinGRU(),
    "gated-deltanet": settings.GatedDeltaNet(key_dim=4, value_dim=4),
    "mamba2": settings.Mamba2(key_dim=4, value_dim=4),
    "decision-transformer": settings.DecisionTransformer(
        num_blocks=2, num_heads=2, ffn_dim=WIDTH, max_ep_len=10
    ),
}
STACKED = ("stacked-inner", "stacked-cnn")
REFUSED = [(f, h) for f in FRAMES for h in STACKED if f != "flat"]
ROWS = MultiCategorical([4, 3, 5])
BYTES = Bounded(0, 255, (3, 8, 8), dtype=torch.uint8)
SEVERAL = {"image": BYTES, "arm/left": Unbounded(6, dtype=torch.float64), "row.of": ROWS}


Pair = tuple[str, ...]
"""A frame encoder and a history encoder; and, if they are no arrays and images, what they read."""


def shape_of(pair: Pair) -> tuple[int, ...]:
    """An image for convolutions, as small as they allow; a set of entities; else an array."""
    frame, history = pair
    if frame == "entities":
        return (5, 4)
    return (36, 36) if history == "stacked-cnn" or frame in ("resnet", "nature-cnn") else (6,)


PAIRS: list[Pair] = [(f, h) for f in FRAMES for h in HISTORIES if (f, h) not in REFUSED]
OF_KINDS: dict[Pair, Any] = {
    ("flat", "mlp", "categories"): ROWS,
    ("flat", "stacked-inner", "categories"): ROWS,
    ("linear", "lstm", "categories"): ROWS,
    ("inner", "paired-outer", "categories"): ROWS,
    ("inner", "paired-outer", "several"): SEVERAL,
    ("linear", "coberl", "several"): SEVERAL,
    ("resnet", "mlp", "several"): SEVERAL,
    ("flat", "d2rl", "several"): SEVERAL,
}
CASES: dict[Pair, Any] = {pair: shape_of(pair) for pair in PAIRS} | OF_KINDS
every_case = pytest.mark.parametrize("case", CASES, ids="+".join)
# What concerns the two encoders of a pair apart: each history encoder and each frame encoder once.
APART: list[Pair] = [("flat" if h in STACKED else "inner", h) for h in HISTORIES]
APART += [(f, "outer") for f in FRAMES if f != "inner"]
APART += [("inner", "paired-outer", "categories"), ("resnet", "mlp", "several")]
apart = pytest.mark.parametrize("case", APART, ids="+".join)


def build(case: Pair, seed: int = 0, num_frames: int = NUM_FRAMES, **fields: Any) -> Any:
    frame, history, *_ = case
    torch.manual_seed(seed)
    network = settings.Network(
        frame=FRAMES[frame],
        history=HISTORIES[history],
        head=settings.Head(features_dim=4),
        num_frames=num_frames,
        **fields,
    )
    return build_network(network, CASES[case], action_dim=ACTIONS).eval()


@cache
def network_of(case: Pair) -> HistoryNetwork:
    """A network in float64, which tests leave as it is."""
    return build(case).double()


def frames_of(case: Pair, *leading: int, seed: int = 1) -> list[Tensor]:
    """Observations of each kind, [*leading, *shape], as an environment writes them."""
    generator = torch.Generator().manual_seed(seed)

    def draw(shape: tuple[int, ...], high: int) -> Tensor:
        return torch.randint(high, (*leading, *shape), generator=generator)

    frames = []
    for seen in read_observations(CASES[case]).values():
        if seen.categories is not None:
            frames.append(torch.cat([draw((1,), n) for n in seen.categories], -1))
        elif seen.dtype == torch.uint8:
            frames.append(draw(seen.shape, 256).byte())
        else:
            frames.append(torch.randn(*leading, *seen.shape, generator=generator).double())
    return frames


def context_of(case: Pair, *leading: int) -> list[Tensor]:
    """What the history encoder reads beside tokens."""
    drawn = torch.rand(*leading, NUM_FRAMES, ACTIONS + 1, dtype=torch.float64)
    context = {
        "action": drawn[..., 1:],
        "return_to_go": drawn[..., :1],
        "timestep": torch.arange(NUM_FRAMES).expand(*leading, -1),
        "mask": torch.ones(*leading, NUM_FRAMES, dtype=torch.bool),
    }
    return [context[name] for name in network_of(case).history_encoder.context]


def inputs_of(case: Pair, *leading: int) -> list[Tensor]:
    return [*frames_of(case, *leading, NUM_FRAMES), *context_of(case, *leading)]


@pytest.fixture
def _fresh_compiler() -> Iterator[None]:
    torch.compiler.reset()
    yield
    torch.compiler.reset()


def ours(registered: dict[str, type[Any]]) -> set[str]:
    """Names of the parts of this library: tests may have registered others."""
    return {name for name, part in registered.items() if part.__module__.startswith("torchrl_tit.")}


def test_all_registered_parts_are_here() -> None:
    assert set(FRAMES) == ours(FrameSettings.registered)
    assert {x.partition(",")[0] for x in HISTORIES} == ours(HistorySettings.registered)
    pairs = [*FRAMES.items(), *HISTORIES.items()]
    assert all(part.name == name.partition(",")[0] for name, part in pairs)


@every_case
def test_every_frame_matters_and_gradients_are_finite(case: Pair) -> None:
    network, inputs = network_of(case), inputs_of(case, 4)
    features = network(*inputs)
    assert features.shape == (4, network.features_dim) == (4, 4)
    parameters, outputs = dict(network.named_parameters()), features
    count = len(network.frames)
    if "coberl" in case:  # its contrastive loss alone hides frames
        mask = torch.tensor([[True, False, True]]).expand(4, -1)
        _, predictions = masked_predictions(network, inputs[:count], mask)
        outputs = torch.cat([features, predictions.flatten(1)], 1)
    probe = torch.linspace(-1, 1, outputs.numel(), dtype=torch.float64).view_as(outputs)
    gradients = torch.autograd.grad((outputs * probe).sum(), list(parameters.values()))
    for name, gradient in zip(parameters, gradients, strict=True):
        assert gradient.isfinite().all(), name
        assert gradient.any(), name
    tokens = network.encode_frames(*inputs[:count])
    for number, other in enumerate(frames_of(case, 4, NUM_FRAMES, seed=2)):
        for step in range(NUM_FRAMES):
            changed = [x.clone() for x in inputs]
            changed[number][:, step] = other[:, step]
            assert not torch.equal(network(*changed), features), (number, step)
            # A frame changes its own tokens only.
            same = (network.encode_frames(*changed[:count]) == tokens).flatten(2).all(-1)
            assert same.all(0).tolist() == [k != step for k in range(NUM_FRAMES)]


@apart
@torch.no_grad()
def test_leading_dimensions_are_free(case: Pair) -> None:
    network, inputs = network_of(case), inputs_of(case, 2, 3)
    expected = network(*(x.flatten(0, 1) for x in inputs))
    torch.testing.assert_close(network(*inputs).flatten(0, 1), expected)
    torch.testing.assert_close(network(*(x[1, 2] for x in inputs)), expected[5])
    assert network(*inputs_of(case, 0)).shape == (0, 4)


@pytest.mark.parametrize("case", [case for case in APART if len(case) == 2], ids="+".join)
@torch.no_grad()
def test_bytes_are_divided_by_255(case: Pair) -> None:
    network, (history, *context) = network_of(case), inputs_of(case, 2)
    history = torch.randint(256, history.shape, dtype=torch.uint8)
    expected = network(history.double() / 255, *context)
    torch.testing.assert_close(network(history, *context), expected)


def sequences(case: Pair, padding: Padding) -> TensorDict:
    """What an environment with `History` writes: N sequences of T steps, [N, T]."""
    before = frames_of(case, N, NUM_FRAMES - 1, seed=2)
    entries: dict[Any, Tensor] = {"is_init": IS_INIT}
    for key, past, frames in zip(
        history_keys(CASES[case]), before, frames_of(case, N, T, seed=3), strict=True
    ):
        histories, window = [], torch.cat([past, past[:, :1]], 1)  # the newest is pushed out
        for t in range(T):
            newest = frames[:, t : t + 1]
            window = torch.cat([window[:, 1:] if t else past, newest], 1)
            padded = newest if padding == "same" else torch.zeros_like(newest)
            first = torch.cat([padded] * (NUM_FRAMES - 1) + [newest], 1)
            start = IS_INIT[:, t].view(N, *[1] * (window.ndim - 1))
            window = torch.where(start, first, window)
            histories.append(window)
        own = "observation" if key == "history" else ("observation", *key[1:])
        entries |= {own: frames, key: torch.stack(histories, 1)}
    context = network_of(case).history_encoder.context
    entries |= dict(zip(context, context_of(case, N, T), strict=True))
    sequence = TensorDict({}, [N, T])
    for key, entry in entries.items():
        sequence[key] = entry
    return sequence


@every_case
@torch.no_grad()
def test_acting_with_kept_frames_equals_the_full_pass(case: Pair) -> None:
    network, steps = network_of(case), sequences(case, "same")
    in_keys = [*history_keys(CASES[case]), *network.history_encoder.context]
    backbone = Backbone(network, in_keys, ["features"])
    expected = network(*(steps[key] for key in in_keys))
    with backbone.acting():
        for step in range(T):
            features = backbone(steps[:, step].clone())["features"]
            torch.testing.assert_close(features, expected[:, step])
    # Flat frames of several observations would be of several widths, so others are chosen.
    assert backbone.keeps_frames == ("several" in case or case[0] != "flat")


@apart
@torch.no_grad()
def test_copies_compute_the_same_and_are_apart(case: Pair) -> None:
    network, fresh, inputs = network_of(case), build(case, seed=1).double(), inputs_of(case, 2)
    expected = network(*inputs)
    assert not torch.equal(fresh(*inputs), expected)
    with TensorDict.from_module(fresh).data.clone().to_module(network):  # as TorchRL's losses do
        torch.testing.assert_close(network(*inputs), fresh(*inputs))
    file = io.BytesIO()
    torch.save(network.state_dict(), file)
    file.seek(0)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    for other in (fresh, copy.deepcopy(network)):
        assert torch.equal(other(*inputs), expected)
        randomize(other, seed=3)
    assert torch.equal(network(*inputs), expected)


@apart
@torch.no_grad()
def test_other_float_types_stay_close(case: Pair) -> None:
    network, inputs = network_of(case), inputs_of(case, 8)
    expected = network(*inputs)

    def error(features: Tensor) -> float:
        return ((features.double() - expected).norm() / expected.norm()).item()

    for dtype, most in ((torch.bfloat16, 0.1), (torch.float32, 1e-5)):
        network = build(case).to(dtype)
        features = network(*(x.to(dtype) if x.is_floating_point() else x for x in inputs))
        assert features.dtype == dtype
        assert error(features) < most
    with torch.autocast("cpu", torch.bfloat16):
        features = network(*(x.float() if x.is_floating_point() else x for x in inputs))
    assert 1e-5 < error(features) < 0.1  # it did run in bfloat16


@apart
@torch.no_grad()
def test_export(case: Pair) -> None:
    network, inputs = network_of(case), inputs_of(case, 2)
    exported = torch.export.export(network, tuple(inputs)).module()
    torch.testing.assert_close(exported(*inputs), network(*inputs))


@apart
@pytest.mark.usefixtures("_fresh_compiler")
def test_compile_in_one_graph(case: Pair) -> None:
    """What breaks a graph is found in tracing; `make slow` compiles all backward passes."""
    backward = case == ("linear", "outer")
    check_compiled(case, "aot_eager" if backward else "eager", backward=backward)


@pytest.mark.slow
@apart
@pytest.mark.usefixtures("_fresh_compiler")
def test_compile_with_gradients(case: Pair) -> None:
    check_compiled(case, "aot_eager", backward=True)


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("c++") is None and shutil.which("g++") is None, reason="no C++ compiler"
)
@pytest.mark.parametrize(
    "case", [("linear", "coberl"), ("linear", "decision-transformer")], ids="+".join
)
@pytest.mark.usefixtures("_fresh_compiler")
def test_real_compilation(case: Pair) -> None:
    """Enhanced_TIT and its gradients are compiled in tests/recipes/ppo/test_rollout.py."""
    check_compiled(case, "inductor", backward="coberl" not in case)


def check_compiled(case: Pair, backend: str, *, backward: bool) -> None:
    network, inputs = network_of(case), inputs_of(case, 2)
    compiled = torch.compile(network, fullgraph=True, backend=backend)
    results = []
    for call in (network, compiled):
        with torch.set_grad_enabled(backward):
            results.append([call(*inputs)])
        if backward:
            loss = results[-1][0].square().sum()
            weights = list(network.parameters())
            results[-1] += torch.autograd.grad(loss, weights, materialize_grads=True)
    torch.testing.assert_close(results[1], results[0])


@pytest.mark.usefixtures("_fresh_compiler", "float64")
def test_compile_and_export_with_any_batch_size() -> None:
    module = EnhancedTIT((5,), 3, patch_size=2, temporal_positions="learned").eval()
    graphs = []

    def backend(graph: torch.fx.GraphModule, _: object) -> Callable[..., Any]:
        graphs.append(graph)
        return graph.forward

    compiled = torch.compile(module, fullgraph=True, backend=backend, dynamic=True)
    batch = torch.export.Dim("batch")
    exported = torch.export.export(
        module, (torch.randn(4, 3, 5),), dynamic_shapes={"inputs": ({0: batch},)}
    ).module()
    for size in (7, 4, 9):
        history = torch.randn(size, 3, 5)
        torch.testing.assert_close(compiled(history), module(history))
        torch.testing.assert_close(exported(history), module(history))
    assert len(graphs) == 1


# On CPUs, PyTorch's attention kernel runs once per set of parameters, and says so.
@pytest.mark.filterwarnings("ignore:There is a performance drop")
@every_case
def test_vmap_over_stacked_parameters(case: Pair) -> None:
    networks, inputs = [network_of(case), build(case, seed=1).double()], inputs_of(case, 2)
    state = stack_module_state(networks)

    def call(parameters: dict[str, Tensor], buffers: dict[str, Tensor]) -> Tensor:
        return functional_call(networks[0], (parameters, buffers), tuple(inputs))

    expected = torch.stack([network(*inputs) for network in networks])
    torch.testing.assert_close(torch.vmap(call)(*state), expected)


def test_two_trunks_read_sequences_and_act_apart() -> None:
    case = ("flat", "d2rl", "several")
    network = build(case, trunks="separate").double()
    assert isinstance(network, TwoTrunks)
    keys, steps = history_keys(SEVERAL), sequences(case, "same")
    expected = network(*(steps[key] for key in keys))
    assert not torch.allclose(*expected)
    backbone = Backbone(network, keys, ["policy", "value"], padding="same")
    with set_recurrent_mode(True):
        read = [backbone(steps.clone())]
    with torch.no_grad(), backbone.acting():
        read.append(torch.stack([backbone(steps[:, step].clone()) for step in range(T)], 1))
    for outputs in read:
        for name, features in zip(("policy", "value"), expected, strict=True):
            torch.testing.assert_close(outputs[name], features)
    expected[0].square().sum().backward()
    assert all(p.grad is None for p in network.value.parameters())
    shared = settings.Network(
        frame=FRAMES["linear"], history=HISTORIES["mlp"], trunks="separate", num_frames=2
    )
    assert isinstance(build_network(shared, (6,), trunks="shared"), HistoryNetwork)


PIXELS_AND_STATE = {"pixels": (36, 36), "state": (6,)}
STACKS = "stacks the frames themselves, not tokens: choose flat frames of one observation"
PATCH = "patch_size 10 does not divide the image of 36 x 36 pixels: choose one of"


@pytest.mark.parametrize(
    ("frame", "history", "shape", "message"),
    [
        *((FRAMES[frame], HISTORIES[history], (36, 36), STACKS) for frame, history in REFUSED),
        (settings.Flat(), settings.StackedCNN(), {"left": (36, 36), "right": (36, 36)}, STACKS),
        ({"pixels": settings.ResNetFrames(embed_dim=8), "state": settings.Linear(embed_dim=16)},
         settings.Outer(), PIXELS_AND_STATE, r"tokens of the widths 8 \(pixels\) and 16 \(state\) "
         "cannot stand side by side: give both"),
        ({"pixels": settings.ResNetFrames()}, settings.Outer(), PIXELS_AND_STATE,
         "there are frame encoders for pixels, but observations pixels, state: name one for each"),
        (settings.Linear(embed_dim=10), settings.Outer(num_heads=4), (6,),
         "the width 10 cannot be split over 4 attention heads"),
        (settings.Flat(), settings.Catformer(num_heads=5), (6,),
         "the width 6 cannot be split over 5 attention heads"),
        (settings.Linear(embed_dim=12), settings.CoBERL(num_heads=8), (6,),
         "the width 12 cannot be split over 8 attention heads"),
        (settings.Flat(), settings.StackedCNN(), (36, 35),
         "images of 36 x 35 pixels are too small .* must have at least 36"),
        (settings.NatureCNNFrames(), settings.Outer(), (3, 35, 84),
         "images of 35 x 84 pixels are too small .* must have at least 36"),
        (settings.ResNetFrames(), settings.Outer(), (7, 84),
         "images of 7 x 84 pixels are too small .* must have at least 8"),
        (settings.ResNetFrames(), settings.Outer(), (6,),
         r"resnet frames do not read an array of shape \(6,\): take inner, linear or flat frames"),
        (settings.Flat(), settings.StackedCNN(), (6,),
         r"observation_shape \(6,\) is that of an array, but this encoder reads images"),
        (settings.Inner(patch_size=10), settings.Outer(), (36, 36), PATCH),
        (settings.Flat(), settings.StackedInner(patch_size=10), (36, 36), PATCH),
        (settings.Linear(embed_dim=8), settings.DecisionTransformer(), (6,),
         "Decision Transformer reads actions and returns .*: give action_dim"),
        (torch.nn.Linear(6, 8), settings.Outer(), (6,),
         "a network is built from settings, such as .*, but Linear.* is no FrameSettings"),
    ],
)  # fmt: skip
def test_parts_that_do_not_fit_each_other_or_the_observation(
    frame: Any, history: Any, shape: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message) as error:
        HistoryNetwork(frame, history, observation_shape=shape, num_frames=NUM_FRAMES)
    assert "\n" not in str(error.value)


def test_observations_by_name() -> None:
    case = ("inner", "paired-outer", "several")
    network = network_of(case)
    assert list(network.observations) == list(SEVERAL)
    assert list(network.frame_encoders) == ["image", "arm/left", "row_of"]
    inputs = inputs_of(case, 2)
    tokens = network.encode_frames(*inputs)
    apart = [encoder(x) for encoder, x in zip(network.frames, inputs, strict=True)]
    torch.testing.assert_close(tokens, torch.cat(apart, -2))
    message = r"reads 3 histories \(image, arm/left, row.of\), not 1"
    with pytest.raises(ValueError, match=message):
        network(torch.zeros(1, NUM_FRAMES, 6))


@pytest.mark.parametrize(
    ("observation", "history", "message"),
    [
        (ROWS, torch.zeros(2, 3, 3), r"float32 does not fit a row of categories \(4, 3, 5 values"),
        ((3,), torch.zeros(2, 3, 3).long(), r"build the network with their spec \(MultiCateg"),
        ((3,), torch.zeros(2, 3, 3).double(), "give it torch.float32 or uint8"),
    ],
)
def test_histories_of_another_dtype(observation: Any, history: Tensor, message: str) -> None:
    network = HistoryNetwork(
        FRAMES["linear"], HISTORIES["outer"], observation_shape=observation, num_frames=3
    )
    for call in (network, lambda x: network.check_frames(x.flatten(0, 1))):
        with pytest.raises(TypeError, match=message):
            call(history)

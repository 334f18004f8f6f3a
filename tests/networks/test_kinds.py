"""Networks on categories, and on an image, an array and categories at once: a few pairs.

What holds for every pair on arrays and images is in test_pairs.py.
"""

from __future__ import annotations

import io
from functools import cache
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.func import functional_call, stack_module_state
from torchrl.data import Bounded, MultiCategorical, Unbounded
from torchrl.modules import set_recurrent_mode

from tests.networks.test_pairs import FRAMES, HISTORIES, NUM_FRAMES
from torchrl_tit import settings
from torchrl_tit.frames import read_observations
from torchrl_tit.modules import Backbone, history_keys
from torchrl_tit.networks import HistoryNetwork, TwoTrunks, build_network, masked_predictions
from torchrl_tit.windows import Padding, find_windows

ROWS = MultiCategorical([4, 3, 5])
BYTES = Bounded(0, 255, (3, 8, 8), dtype=torch.uint8)
SEVERAL = {"image": BYTES, "arm/left": Unbounded(6, dtype=torch.float64), "row.of": ROWS}
CASES: dict[str, tuple[str, str, Any]] = {
    "flat+mlp, categories": ("flat", "mlp", ROWS),
    "flat+stacked-inner, categories": ("flat", "stacked-inner", ROWS),
    "linear+lstm, categories": ("linear", "lstm", ROWS),
    "inner+paired-outer, categories": ("inner", "paired-outer", ROWS),
    "inner+paired-outer, several": ("inner", "paired-outer", SEVERAL),
    "linear+coberl, several": ("linear", "coberl", SEVERAL),
    "resnet+mlp, several": ("resnet", "mlp", SEVERAL),
    "flat+d2rl, several": ("flat", "d2rl", SEVERAL),
}
every_case = pytest.mark.parametrize("case", CASES)
two_cases = pytest.mark.parametrize("case", ["flat+mlp, categories", "inner+paired-outer, several"])
Data = dict[str, Tensor]


def build(case: str, seed: int = 0, num_frames: int = NUM_FRAMES, **fields: Any) -> Any:
    frame, history, observation = CASES[case]
    torch.manual_seed(seed)
    network = settings.Network(
        frame=FRAMES[frame],
        history=HISTORIES[history],
        head=settings.Head(features_dim=4),
        num_frames=num_frames,
        **fields,
    )
    return build_network(network, observation).double().eval()


@cache
def network_of(case: str) -> HistoryNetwork:
    """A network in float64, which tests leave as it is."""
    return build(case)


def frames_of(case: str, *leading: int, seed: int = 1) -> list[Tensor]:
    """Observations of each kind, [*leading, *shape], as an environment writes them."""
    generator = torch.Generator().manual_seed(seed)

    def draw(shape: tuple[int, ...], high: int) -> Tensor:
        return torch.randint(high, (*leading, *shape), generator=generator)

    frames = []
    for seen in read_observations(CASES[case][2]).values():
        if seen.categories is not None:
            frames.append(torch.cat([draw((1,), n) for n in seen.categories], -1))
        elif seen.kind == "image":
            frames.append(draw(seen.shape, 256).byte())
        else:
            frames.append(draw(seen.shape, 1000).double() / 500 - 1)
    return frames


def sequences(case: str, count: int, steps: int, padding: Padding) -> TensorDict:
    """Observations and histories of steps, [count, steps]; one episode ends inside."""
    keys = history_keys(CASES[case][2])
    is_init = torch.zeros(count, steps, 1, dtype=torch.bool)
    is_init[:, 0] = is_init[-1, steps // 2] = True
    sequence = TensorDict({"is_init": is_init}, [count, steps])
    start = torch.where(is_init.squeeze(-1), torch.arange(steps), 0).cummax(1).values
    for key, frames in zip(keys, frames_of(case, count, steps), strict=True):
        rows = find_windows(torch.arange(steps).expand(count, -1), start, NUM_FRAMES, padding)
        windows = []
        for number, table in enumerate(frames):
            missing = None if rows.missing is None else rows.missing[number]
            windows.append(type(rows)(rows.rows[number], missing).gather(table))
        own = "observation" if key == "history" else ("observation", *key[1:])
        sequence[own], sequence[key] = frames, torch.stack(windows)
    return sequence


@every_case
def test_every_observation_matters_and_gradients_are_finite(case: str) -> None:
    network = network_of(case)
    histories = frames_of(case, 4, NUM_FRAMES)
    features = network(*histories)
    assert features.shape == (4, 4)
    parameters = dict(network.named_parameters())
    if "coberl" in case:  # its contrastive loss alone hides frames
        mask = torch.tensor([[True, False, True]]).expand(4, -1)
        _, predictions = masked_predictions(network, histories, mask)
        features = torch.cat([features, predictions.flatten(1)], 1)
    probe = torch.linspace(-1, 1, features.numel(), dtype=torch.float64).view_as(features)
    gradients = torch.autograd.grad((features * probe).sum(), list(parameters.values()))
    for name, gradient in zip(parameters, gradients, strict=True):
        assert gradient.isfinite().all(), name
        assert gradient.any(), name
    others = frames_of(case, 4, NUM_FRAMES, seed=2)
    for number, other in enumerate(others):
        for step in range(NUM_FRAMES):
            changed = [x.clone() for x in histories]
            changed[number][:, step] = other[:, step]
            assert not torch.equal(network(*changed), network(*histories)), (number, step)


@every_case
@pytest.mark.parametrize("padding", ["same", "constant"])
def test_sequences_and_acting_equal_single_steps(case: str, padding: Any) -> None:
    network, keys = network_of(case), history_keys(CASES[case][2])
    steps = sequences(case, 2, 6, padding)
    expected = network(*(steps[key] for key in keys))
    with set_recurrent_mode(True):
        for known in (None, padding):
            features = Backbone(network, keys, padding=known)(steps.clone())["features"]
            torch.testing.assert_close(features, expected)
        if padding == "same":
            features = Backbone(network, keys)(steps.exclude("history"))["features"]
            torch.testing.assert_close(features, expected)
    backbone = Backbone(network, keys)
    with torch.no_grad(), backbone.acting():
        for step in range(6):
            features = backbone(steps[:, step].clone())["features"]
            torch.testing.assert_close(features, expected[:, step])


def test_acting_encodes_each_frame_of_each_observation_once() -> None:
    case = "inner+paired-outer, several"
    network, keys = network_of(case), history_keys(SEVERAL)
    steps, counts = sequences(case, 2, 6, "same"), dict.fromkeys(SEVERAL, 0)
    hooks = []
    for name, encoder in zip(SEVERAL, network.frames, strict=True):

        def count(module: Any, inputs: Any, name: str = name) -> None:
            observation_ndim = len(module.observation_shape)
            counts[name] += inputs[0].shape[: inputs[0].ndim - observation_ndim].numel()

        hooks.append(encoder.register_forward_pre_hook(count))
    backbone = Backbone(network, keys)
    with torch.no_grad(), backbone.acting():
        for step in range(6):
            backbone(steps[:, step].clone())
    for hook in hooks:
        hook.remove()
    # Of two environments: six steps, and no more for the padding of the episodes that began.
    assert counts == dict.fromkeys(SEVERAL, 12)


def test_two_trunks_read_several_observations() -> None:
    network = build("flat+d2rl, several", trunks="separate")
    assert isinstance(network, TwoTrunks)
    keys, steps = history_keys(SEVERAL), sequences("flat+d2rl, several", 2, 6, "same")
    expected = network(*(steps[key] for key in keys))
    with set_recurrent_mode(True):
        outputs = Backbone(network, keys, ["policy", "value"], padding="same")(steps)
    torch.testing.assert_close(outputs["policy"], expected[0])
    torch.testing.assert_close(outputs["value"], expected[1])


def test_a_carried_state_reads_categories() -> None:
    case = "linear+lstm, categories"
    backbone = Backbone(build(case, num_frames=1))
    steps = sequences(case, 2, 5, "same").exclude("observation")
    steps["history"] = steps["history"][..., -1:, :]
    for key, shape in backbone.state_shapes.items():
        steps[key] = torch.zeros(2, 5, *shape, dtype=torch.float64)
    with set_recurrent_mode(True):
        expected = backbone(steps.clone())["features"]
    state = steps[:, 0].select(*backbone.state_shapes)
    for step in range(5):
        outputs = backbone(steps[:, step].clone().update(state))
        torch.testing.assert_close(outputs["features"], expected[:, step])
        state = outputs["next"].select(*backbone.state_shapes)


@every_case
def test_state_dict_round_trip(case: str) -> None:
    network, fresh, inputs = network_of(case), build(case, 1), frames_of(case, 2, NUM_FRAMES)
    assert not torch.equal(fresh(*inputs), network(*inputs))
    file = io.BytesIO()
    torch.save(network.state_dict(), file)
    file.seek(0)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(fresh(*inputs), network(*inputs))


@pytest.mark.parametrize("case", ["inner+paired-outer, categories", "resnet+mlp, several"])
@torch.no_grad()  # the backward passes are those of other networks
def test_export_and_compile(case: str) -> None:
    network, inputs = network_of(case), frames_of(case, 2, NUM_FRAMES)
    exported = torch.export.export(network, tuple(inputs)).module()
    torch.testing.assert_close(exported(*inputs), network(*inputs))
    torch.compiler.reset()
    compiled = torch.compile(network, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(*inputs), network(*inputs))
    torch.compiler.reset()


# On CPUs, PyTorch's attention kernel runs once per set of parameters, and says so.
@pytest.mark.filterwarnings("ignore:There is a performance drop")
@two_cases
def test_vmap_over_stacked_parameters(case: str) -> None:
    networks, inputs = [network_of(case), build(case, 1)], frames_of(case, 2, NUM_FRAMES)

    def call(parameters: Data, buffers: Data) -> Tensor:
        return functional_call(networks[0], (parameters, buffers), tuple(inputs))

    expected = torch.stack([network(*inputs) for network in networks])
    torch.testing.assert_close(torch.vmap(call)(*stack_module_state(networks)), expected)


def test_names_of_observations_are_names_of_modules() -> None:
    network = network_of("inner+paired-outer, several")
    assert list(network.observations) == list(SEVERAL)
    assert list(network.frame_encoders) == ["image", "arm/left", "row_of"]
    message = r"reads 3 histories \(image, arm/left, row.of\), not 1"
    with pytest.raises(ValueError, match=message):
        network(torch.zeros(1, NUM_FRAMES, 6))


@pytest.mark.parametrize(
    ("observation", "history", "message"),
    [
        (ROWS, torch.zeros(2, 3, 3), r"float32 does not fit a row of categories \(4, 3, 5 values"),
        ((3,), torch.zeros(2, 3, 3).long(), r"build the network with their spec \(MultiCateg"),
        ((3,), torch.zeros(2, 3, 3).double(), "DoubleToFloat"),
    ],
)
def test_histories_of_another_dtype(observation: Any, history: Tensor, message: str) -> None:
    network = HistoryNetwork(
        FRAMES["linear"], HISTORIES["outer"], observation_shape=observation, num_frames=3
    )
    for call in (network, lambda x: network.check_frames(x.flatten(0, 1))):
        with pytest.raises(TypeError, match=message):
            call(history)

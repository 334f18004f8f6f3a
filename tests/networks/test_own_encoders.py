"""An encoder of a user's own that does not keep its contract is found when it is built."""

from dataclasses import dataclass

import pytest
import torch
from torch import nn
from torchrl.data import MultiCategorical

from torchrl_tit import settings
from torchrl_tit.frames import FrameEncoder
from torchrl_tit.histories import HistoryEncoder
from torchrl_tit.networks import build_network, frames_by_kind
from torchrl_tit.settings import FrameSettings, HistorySettings, Network

CATEGORIES = MultiCategorical([4])


class Own(FrameEncoder):
    """Two tokens of an array; what is wrong with it is a setting."""

    kinds = ("array",)

    def __init__(self, settings, observation_shape):
        super().__init__(observation_shape, num_tokens=2, width=8)
        self.wrong = settings.wrong
        self.linear = nn.Linear(observation_shape[0], 2 * 8)
        self.norm = nn.BatchNorm1d(16)
        self.dropout = nn.Dropout(0.5)
        if self.wrong == "needs numbers":
            self.linear.weight.detach().sum().item()

    def forward(self, observation):
        tokens = self.linear(observation)
        if self.wrong == "shape":
            return tokens
        if self.wrong == "type":
            return [tokens]
        if self.wrong == "leading":
            tokens = tokens.reshape(len(observation), -1)
            return self.norm(tokens).unflatten(-1, (2, 8))
        if self.wrong == "double":
            tokens = tokens.double()
        if self.wrong == "noise":
            tokens = nn.functional.dropout(tokens)  # also in evaluation mode
        if self.wrong == "state":
            self.calls = getattr(self, "calls", 0) + 1
            tokens = tokens + self.calls
        if self.wrong == "batch":
            tokens = tokens - tokens.mean(1, keepdim=True)
        return self.dropout(tokens).unflatten(-1, (2, 8))


class Broken(FrameEncoder):
    """Its constructor is wrong in one way or another."""

    kinds = ("array", "categories")

    def __init__(self, settings, observation_shape):
        if settings.wrong == "layer first":
            self.linear = nn.Linear(4, 8)
        if settings.wrong == "raises":
            raise KeyError("no weights\nfor this")
        if settings.wrong != "no constructor":
            super().__init__(observation_shape, num_tokens=1, width=8)


class OwnPast(HistoryEncoder):
    """A linear layer on the newest token; what is wrong with it is a setting."""

    def __init__(self, settings, shape):
        super().__init__(shape, out_features=9 if settings.wrong == "out_features" else 8)
        self.linear, self.wrong = nn.Linear(shape.width, 8), settings.wrong

    def forward(self, tokens):
        newest = self.linear(tokens[..., -1, 0, :])
        return newest - newest.mean(0) if self.wrong == "batch" else newest


class MeanPast(HistoryEncoder):
    def __init__(self, settings, shape):
        super().__init__(shape, out_features=shape.width)

    def forward(self, tokens):
        return tokens.mean((-3, -2))


class NoEncoder(nn.Module):
    def __init__(self, settings, shape):
        super().__init__()


@dataclass(frozen=True, kw_only=True)
class OwnFrames(FrameSettings, name="tests-own", builds=f"{__name__}:Own"):
    wrong: str = ""


@dataclass(frozen=True, kw_only=True)
class BrokenFrames(FrameSettings, name="tests-broken", builds=f"{__name__}:Broken"):
    wrong: str = ""


@dataclass(frozen=True, kw_only=True)
class OtherFrames(FrameSettings, name="tests-other", builds=f"{__name__}:NoEncoder"):
    pass


@dataclass(frozen=True, kw_only=True)
class OwnHistory(HistorySettings, name="tests-own", builds=f"{__name__}:OwnPast"):
    wrong: str = ""


@dataclass(frozen=True, kw_only=True)
class MeanHistory(HistorySettings, name="tests-mean", builds=f"{__name__}:MeanPast"):
    pass


@dataclass(frozen=True, kw_only=True)
class ForgottenHistory(HistorySettings, name="tests-forgotten", builds=settings.GRU.builds):
    """Does not say that its encoder is recurrent."""

    hidden_dim: int = 8
    num_layers: int = 1


def build(part, observation=(4,)):
    frame = part if isinstance(part, FrameSettings) else settings.Linear()
    history = part if isinstance(part, HistorySettings) else settings.Outer(num_blocks=1)
    return build_network(Network(frame=frame, history=history, num_frames=3), observation)


def test_a_network_without_weights_reads_floats_of_the_default_type():
    head = settings.Head(features_dim=None)
    plain = Network(frame=settings.Flat(), history=MeanHistory(), head=head, num_frames=3)
    network = build_network(plain, (4,))
    history = torch.rand(5, 3, 4)
    assert torch.equal(network(history), history.mean(1))
    assert torch.equal(
        network((255 * history).byte()), (255 * history).byte().float().div(255).mean(1)
    )


@pytest.mark.parametrize("wrong", ["", "needs numbers"])
def test_settings_and_shape_are_enough(wrong):
    state = torch.get_rng_state()
    frame = OwnFrames(wrong=wrong)
    chosen = frames_by_kind(
        Network(frame=frame, history=settings.Outer()), {"arm": (4,), "row": CATEGORIES}
    )
    assert chosen == {"arm": frame, "row": settings.Linear(embed_dim=8, bias=True)}
    assert torch.equal(torch.get_rng_state(), state)
    encoder = build(frame).frames[0]
    assert encoder.training
    assert encoder.dropout.training
    assert not encoder.norm.running_mean.any()
    assert encoder(torch.zeros(5, 3, 4)).shape == (5, 3, 2, 8)
    assert build(OwnHistory()).history_encoder(torch.zeros(5, 3, 1, 32)).shape == (5, 8)


@pytest.mark.parametrize(
    ("part", "observation", "message"),
    [
        (OwnFrames(wrong="shape"), (4,), r"Own maps zeros of shape \(1, 2, 4\) to \(1, 2, 16\), "
         r"not to \(1, 2, 2, 8\): it must map .* to tokens \[..., num_tokens, width\]"),
        (OwnFrames(wrong="type"), (4,), r"Own maps zeros of shape \(1, 2, 4\) to list, not to"),
        (OwnFrames(wrong="leading"), (4,), r"Own fails on zeros of shape \(1, 2, 4\): "),
        (OwnFrames(wrong="double"), (4,), "Own maps zeros .* to torch.float64, not to torch"),
        (OwnFrames(wrong="noise"), (4,), "Own gives the same input another output at the"),
        (OwnFrames(wrong="state"), (4,), "Own gives the same input another output at the"),
        (OwnFrames(wrong="batch"), (4,), "the output of Own for one entry of a batch depends"),
        (OwnHistory(wrong="batch"), (4,), "the output of OwnPast for one entry of a batch depends"),
        (ForgottenHistory(), (4,), "whose is_recurrent is True: write `is_recurrent = True` in"),
        (OwnFrames(), (3, 8, 8), r"tests-own frames do not read an image of shape \(3, 8, 8\)"),
        (OwnFrames(), CATEGORIES, r"do not read a row of categories \(4 values\)"),
        (OtherFrames(), (4,), "builds a NoEncoder, which is no FrameEncoder: derive it from "
         "torchrl_tit.frames.FrameEncoder"),
        (BrokenFrames(wrong="no constructor"), (4,), r"Broken does not call FrameEncoder's "
         r"constructor: call super\(\).__init__\(observation_shape"),
        (BrokenFrames(wrong="layer first"), (4,), r"cannot be built: AttributeError: .* before "
         r"Module.__init__\(\) call"),
        (BrokenFrames(wrong="raises"), (4,), r"frame encoder tests-broken \(.*:Broken\) cannot be "
         r"built: KeyError: 'no weights"),
        (BrokenFrames(), (4,), r"Broken fails on zeros .*: there is no forward, which maps"),
        (BrokenFrames(), CATEGORIES, "an encoder of categories takes them as an argument"),
        (OwnHistory(wrong="out_features"), (4,), r"OwnPast maps zeros of shape \(1, 2, 3, 1, 32\) "
         r"to \(1, 2, 8\), not to \(1, 2, 9\): it must map .* to \[..., out_features\]"),
    ],
)  # fmt: skip
def test_what_does_not_keep_the_contract(part, observation, message):
    with pytest.raises(ValueError, match=message) as error:
        build(part, observation)
    assert "\n" not in str(error.value)


def test_one_that_cannot_be_built_is_not_replaced():
    network = Network(frame=BrokenFrames(wrong="raises"), history=settings.Outer())
    with pytest.raises(ValueError, match=r"tests-broken .* cannot be built: KeyError"):
        frames_by_kind(network, {"arm": (4,), "row": CATEGORIES})

"""A history encoder of a user's own that does not keep the contract is found when it is built."""

from dataclasses import dataclass

import pytest
import torch
from torch import nn

from torchrl_tit import settings
from torchrl_tit.histories import HistoryEncoder
from torchrl_tit.networks import build_network
from torchrl_tit.settings import HistorySettings, Network


class Own(HistoryEncoder):
    """A linear layer on the newest token; what is wrong with it is a setting."""

    def __init__(self, settings, shape):
        if settings.wrong == "raises":
            raise KeyError("no weights")
        if settings.wrong != "no constructor":
            size = 9 if settings.wrong == "out_features" else 8
            super().__init__(shape, out_features=size)
            width = shape.width + (settings.wrong == "width")
            self.linear = nn.Linear(width, 8)

    def forward(self, tokens):
        return self.linear(tokens[..., -1, 0, :])


class NoForward(HistoryEncoder):
    def __init__(self, settings, shape):
        super().__init__(shape, out_features=8)


class NoEncoder(nn.Module):
    def __init__(self, settings, shape):
        super().__init__()


@dataclass(frozen=True, kw_only=True)
class OwnHistory(HistorySettings, name="tests-own", builds=f"{__name__}:Own"):
    wrong: str = ""


@dataclass(frozen=True, kw_only=True)
class NoForwardHistory(HistorySettings, name="tests-silent", builds=f"{__name__}:NoForward"):
    pass


@dataclass(frozen=True, kw_only=True)
class OtherHistory(HistorySettings, name="tests-other", builds=f"{__name__}:NoEncoder"):
    pass


def build(history):
    return build_network(Network(frame=settings.Linear(), history=history, num_frames=3), (4,))


def test_one_that_keeps_it():
    assert build(OwnHistory()).history_encoder(torch.zeros(5, 3, 1, 32)).shape == (5, 8)


@pytest.mark.parametrize(
    ("history", "message"),
    [
        (OwnHistory(wrong="out_features"), r"Own maps zeros of shape \(1, 2, 3, 1, 32\) to "
         r"\(1, 2, 8\), not to \(1, 2, 9\): .* out_features 9 for E"),
        (OwnHistory(wrong="width"), r"Own fails on zeros of shape .*: RuntimeError: "),
        (OwnHistory(wrong="no constructor"), "Own does not call HistoryEncoder's constructor"),
        (OwnHistory(wrong="raises"), r"history encoder tests-own \(.*:Own\) cannot be built: "
         "KeyError: 'no weights'"),
        (NoForwardHistory(), r"NoForward has no forward: implement `forward\(self, tokens\)`"),
        (OtherHistory(), "builds a NoEncoder, which is no HistoryEncoder: derive it from "
         "torchrl_tit.histories.HistoryEncoder"),
    ],
)  # fmt: skip
def test_what_does_not_keep_the_contract(history, message):
    with pytest.raises(ValueError, match=message) as error:
        build(history)
    assert "\n" not in str(error.value)

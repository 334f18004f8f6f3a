"""What is drawn: choices and maps over images."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical
from torchrl.modules import IndependentNormal, MaskedCategorical, OneHotCategorical, TanhNormal

from recipes.tools.results.explained_page import (
    Choice,
    ExplainedStep,
    Page,
    Seen,
    as_picture,
    lay_over,
)
from recipes.tools.results.explanation import describe_choice
from torchrl_tit.modules.distributions import (
    IndependentBernoulli,
    IndependentCategorical,
    IndependentOneHotCategorical,
)


def described(distribution, action, **outputs):
    outputs = TensorDict({"action": torch.as_tensor(action)[None], **outputs}, [1])
    choice = describe_choice(outputs, distribution)
    assert len(choice.labels) == len(choice.heights) == len(choice.chosen)
    return choice


LOGITS = torch.tensor([[0.1, 0.2, 0.7]]).log()


SEVERAL = torch.tensor([[[0.25, 0.75, 0.0], [0.5, 0.25, 0.25]]]).log()
ALLOWED = torch.tensor([[[True, True, False], [True, True, False]]])
OPTIONS = ["0: 0", "0: 1", "1: 0", "1: 1", "1: 2"]
ONE, TWO = [False, True, False], [False, True, True, False, False]


@pytest.mark.parametrize(
    ("distribution", "action", "labels", "heights", "chosen"),
    [
        (Categorical(logits=LOGITS), 1, list("012"), [0.1, 0.2, 0.7], ONE),
        (
            MaskedCategorical(logits=LOGITS, mask=torch.ones(1, 3, dtype=torch.bool)),
            1,
            list("012"),
            [0.1, 0.2, 0.7],
            ONE,
        ),
        (OneHotCategorical(logits=LOGITS), ONE, list("012"), [0.1, 0.2, 0.7], ONE),
        (IndependentCategorical(SEVERAL), [1, 0], OPTIONS, [0.25, 0.75, 0.5, 0.25, 0.25], TWO),
        (
            IndependentOneHotCategorical(SEVERAL, sizes=(2, 3)),
            TWO,
            OPTIONS,
            [0.25, 0.75, 0.5, 0.25, 0.25],
            TWO,
        ),
        (
            IndependentCategorical(SEVERAL, ALLOWED),
            [1, 0],
            OPTIONS,
            [0.25, 0.75, 2 / 3, 1 / 3, 0.0],
            TWO,
        ),
    ],
)
def test_choices_among_options(distribution, action, labels, heights, chosen):
    choice = described(distribution, action)
    assert choice.title == "action probabilities"
    assert choice.labels == labels
    np.testing.assert_allclose(choice.heights, heights, atol=1e-6)
    assert choice.chosen == chosen


def test_switches():
    switches = IndependentBernoulli(torch.tensor([[0.0, 2.0]]))
    choice = described(switches, torch.tensor([0, 1], dtype=torch.int8))
    assert choice.title == "probabilities of on"
    np.testing.assert_allclose(choice.heights, [0.5, 0.880797], atol=1e-5)
    assert choice.chosen == [False, True]


def test_continuous_actions():
    normal = IndependentNormal(torch.tensor([[0.5, -1.0]]), torch.tensor([[0.1, 0.2]]))
    choice = described(normal, [0.5, -1.0])
    np.testing.assert_allclose(choice.heights, [0.5, -1.0])
    np.testing.assert_allclose(choice.spreads, [0.1, 0.2], atol=1e-6)
    squashed = TanhNormal(torch.zeros(1, 2), torch.ones(1, 2))
    assert described(squashed, [0.5, -1.0]).spreads is None  # of no normal distribution
    assert described(None, [0.5, -1.0]).heights.tolist() == [0.5, -1.0]


def test_values_of_actions():
    choice = described(None, 2, action_value=torch.tensor([[1.0, -3.0, 2.0]]))
    assert choice.title == "values of actions"
    assert choice.heights.tolist() == [1.0, -3.0, 2.0]
    assert choice.chosen == [False, False, True]
    forbidden = torch.tensor([[1.0, torch.finfo(torch.float32).min]])  # as TorchRL writes it
    choice = described(None, 0, action_value=forbidden)
    np.testing.assert_array_equal(choice.heights, [1.0, np.nan])
    words = ExplainedStep({}, None, choice, None).describe()
    assert words == "Values of actions: 0 1.00 (chosen), 1 forbidden."


@pytest.mark.parametrize(
    ("frame", "brightest"),
    [
        (np.eye(84, dtype=np.uint8) * 200, 200),
        (np.eye(84) * 0.5, 128),
        (np.eye(84) * 6 - 3, 255),  # of any scale
        (np.eye(84, dtype=np.uint8)[None] * 10, 255),  # symbols
        (np.stack([np.eye(84)] * 2), 255),  # two channels
    ],
)
def test_pictures_of_observations(frame, brightest):
    picture = as_picture(frame)
    assert picture.shape == (84, 84, 3)
    assert picture.dtype == np.uint8
    assert picture[5, 5].tolist() == [brightest] * 3
    assert picture[5, 6].tolist() == [0] * 3


def test_colors_stay_and_small_images_grow():
    frame = np.zeros((3, 7, 7), np.uint8)
    frame[0, 2, 3] = 255
    picture = as_picture(frame)
    assert picture.shape == (84, 84, 3)
    assert picture[24:36, 36:48].reshape(-1, 3).tolist() == [[255, 0, 0]] * 144
    assert picture.sum() == 255 * 144


def test_maps_lie_where_they_should():
    frames = np.full((2, 84, 84), 100, np.uint8)
    maps = np.zeros((2, 7, 7))
    maps[0, 0, 0], maps[1, 6, 3] = 1, 4
    older, newest = lay_over(Seen(frames, maps))
    assert (newest[40] == 100).all()
    assert (newest[80, 42] != 100).any()
    assert np.abs(older[5, 5].astype(int) - 100).sum() > 0
    # Maps of a step share a scale: the older one is fainter.
    assert np.abs(older[5, 5] - 100.0).sum() < np.abs(newest[78, 42] - 100.0).sum()
    plain, marked = lay_over(Seen(frames, maps[1:]))  # one map of all frames
    assert (plain == 100).all()
    assert (marked == newest).all()
    assert all((x == 100).all() for x in lay_over(Seen(frames, 0 * maps)))


@pytest.mark.parametrize("attention", [None, np.full((2, 2, 3), 1 / 3)])
@pytest.mark.parametrize("value", [None, 1.5])
def test_pages_have_what_there_is(attention, value):
    choice = Choice("action", ["0"], np.array([0.5]), None, [True])
    step = ExplainedStep({}, attention, choice, value)
    page = Page(step, "run")
    picture = np.full((50, 60, 3), 120, np.uint8)
    first = page.draw(step, [picture], [value], 0)
    assert first.shape == (432, 768, 3)
    other = ExplainedStep(
        {}, attention, Choice("action", ["0"], -choice.heights, None, [True]), value
    )
    assert (page.draw(other, [picture], [value, value], 1) != first).any()

"""Draws explained steps: what was observed, what mattered, and what was chosen, on one page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch.nn import functional as F

from .explained_step import Choice, ExplainedStep, Seen

_SIZE, _DPI = (9.6, 5.4), 80  # 768 x 432 pixels: films need even sides
_SMALLEST = 84  # images are enlarged to this many pixels per side
_STRIP = (740, 90)  # the frames under a timeline: twice the pixels that they take on the page
_MOST_LABELS = 24
_OPACITY = 0.65
_COLOURS = colormaps["inferno"]


class Page:
    """A page for the steps of an episode, drawn again for each.

    Above, the rendered task, each observation with its map, and the action; below, attention over
    the K steps with the frames under it, and the value so far.

    Args:
        step: a step of the episode, which determines the panels to draw.
        title: title of the page; without one, nothing is written above it.
        dpi: dots per inch; the page is 9.6 x 5.4 inches.
    """

    def __init__(self, step: ExplainedStep, title: str, dpi: int = _DPI) -> None:
        self._figure = Figure(figsize=_SIZE, dpi=dpi, layout="constrained")
        self._canvas = FigureCanvasAgg(self._figure)
        self._title = self._figure.suptitle(title, fontsize=9) if title else None
        self._text = title
        over_time = step.attention is not None and step.attention.shape[-1] > 1
        lower = ["timeline"] * over_time + ["value"] * (step.value is not None)
        number = 2 if lower else 1
        rows = self._figure.subfigures(number, 1, squeeze=False, height_ratios=[3, 2][:number])
        panels = rows[0, 0].subplots(1, 2 + len(step.seen), squeeze=False)[0]
        self._picture = _Picture(panels[0], "task")
        self._seen: dict[str, _Picture | _Bars] = {}
        for axes, (name, seen) in zip(panels[1:-1], step.seen.items(), strict=True):
            title = f"{name}: what matters"
            if not seen.is_image and len(seen.maps) > 1:
                title += "\nnow, and (grey) in earlier steps"
            self._seen[name] = (
                _Picture(axes, title) if seen.is_image else _Bars(axes, title, seen.maps.shape[-1])
            )
        self._choice = _Choices(panels[-1], step.choice)
        self._timeline: _Timeline | None = None
        self._trace: _Trace | None = None
        if lower:
            widths = [3, 2][: len(lower)]
            parts = rows[1, 0].subfigures(1, len(lower), squeeze=False, width_ratios=widths)
            for name, part in zip(lower, parts[0], strict=True):
                if name == "value":
                    self._trace = _Trace(part)
                else:
                    assert step.attention is not None
                    self._timeline = _Timeline(part, step.attention)

    def draw(
        self,
        step: ExplainedStep,
        pictures: Sequence[np.ndarray],
        values: Sequence[float],
        number: int,
    ) -> np.ndarray:
        """Draws a step.

        Args:
            step: the step.
            pictures: the rendered task in the last steps, this one last, uint8 [height, width, 3].
            values: values of all steps so far, if the policy computes them.
            number: number of the step, counted from 0.

        Returns:
            uint8 [432, 768, 3] at 80 dots per inch.
        """
        if self._title is not None:
            self._title.set_text(f"{self._text}, step {number}")
        self._picture.show(pictures[-1])
        strip: list[np.ndarray] = []
        for name, seen in step.seen.items():
            panel = self._seen[name]
            if isinstance(panel, _Picture):
                laid = lay_over(seen)
                panel.show(laid[-1])
                strip = strip or laid
            else:
                panel.show(seen.maps)
        self._choice.show(step.choice)
        if self._timeline is not None:
            assert step.attention is not None
            frames = step.attention.shape[-1]
            # The episode's first picture fills the frames before its first step.
            missing = [pictures[0]] * (frames - len(pictures))
            self._timeline.show(step.attention, strip or [*missing, *pictures[-frames:]])
        if self._trace is not None:
            self._trace.show(values)
        self._canvas.draw()
        self._figure.set_layout_engine("none")  # laid out once
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def lay_over(seen: Seen) -> list[np.ndarray]:
    """Overlays maps on images.

    Args:
        seen: K images and their maps. A single map of all images is laid over the newest one.

    Returns:
        K images, uint8 [H, W, 3], of at least 84 pixels per side.
    """
    images = [as_picture(frame) for frame in seen.frames]
    maps = [np.zeros_like(seen.maps[0])] * (len(images) - len(seen.maps)) + list(seen.maps)
    largest = max(float(x.max()) for x in maps)  # makes frames of a step comparable
    return [
        _blend(image, x / largest if largest > 0 else x)
        for image, x in zip(images, maps, strict=True)
    ]


def as_picture(frame: np.ndarray) -> np.ndarray:
    """Turns an observed image, [H, W] or [C, H, W] of any scale, into uint8 [H', W', 3].

    Three channels are taken as colours; other channels are averaged. Small images are enlarged.
    """
    image = frame if frame.ndim == 3 else frame[None]
    image = image if len(image) == 3 else image.mean(0, keepdims=True).repeat(3, 0)
    image = image.astype(np.float64)
    if frame.dtype == np.uint8:
        # A small range of values means symbols, such as MiniGrid's, not brightness.
        scaled = image / max(image.max(), 1) if image.max() < 32 else image / 255
    elif image.min() >= 0 and image.max() <= 1:
        scaled = image
    else:
        scaled = (image - image.min()) / max(image.max() - image.min(), 1e-12)
    picture = (255 * scaled).round().astype(np.uint8).transpose(1, 2, 0)
    factor = -(-_SMALLEST // min(picture.shape[:2]))
    return picture.repeat(factor, 0).repeat(factor, 1) if factor > 1 else picture


def _blend(picture: np.ndarray, strength: np.ndarray) -> np.ndarray:
    """Colours a picture [H, W, 3] by a map [h, w] from 0 to 1; where it is 0, nothing changes."""
    sides = picture.shape[:2]
    cells = torch.from_numpy(np.ascontiguousarray(strength, dtype=np.float64))[None, None]
    smooth = F.interpolate(cells, sides, mode="bilinear")[0, 0].numpy().clip(0, 1)
    colours = 255 * _COLOURS(smooth)[..., :3]
    opacity = _OPACITY * smooth[..., None]
    return (picture * (1 - opacity) + colours * opacity).round().astype(np.uint8)


class _Picture:
    """A panel with a picture."""

    def __init__(self, axes: Any, title: str) -> None:
        axes.set_title(title, fontsize=8)
        axes.set_axis_off()
        self._axes = axes
        self._image: Any = None

    def show(self, picture: np.ndarray) -> None:
        """Shows another picture, uint8 [H, W, 3]."""
        if self._image is None:
            self._image = self._axes.imshow(picture, interpolation="nearest")
        self._image.set_data(picture)


class _Bars:
    """A panel with bars for each entry of an array: the newest step's, and all earlier steps'."""

    def __init__(self, axes: Any, title: str, entries: int) -> None:
        places = np.arange(entries)
        self._before = axes.barh(places, np.zeros(entries), color="0.75")
        self._newest = axes.barh(places, np.zeros(entries), 0.5, color="C1")
        axes.set_title(title, fontsize=8)
        axes.axvline(0, color="0.3", linewidth=0.8)
        axes.set_yticks(places[:: -(-entries // _MOST_LABELS)])
        axes.invert_yaxis()
        axes.tick_params(labelsize=7)
        self._axes = axes
        self._reach = 1e-9

    def show(self, maps: np.ndarray) -> None:
        """Shows new shares, [K, entries]."""
        newest, before = maps[-1], maps[:-1].sum(0)
        for bars, values in ((self._newest, newest), (self._before, before)):
            for bar, value in zip(bars, values, strict=True):
                bar.set_width(float(value))
        # The scale only grows, so that steps are comparable.
        self._reach = max(self._reach, 1.1 * float(np.abs(np.stack([newest, before])).max()))
        self._axes.set_xlim(-self._reach, self._reach)


class _Choices:
    """A panel with a bar for each option, or for each entry of a continuous action."""

    def __init__(self, axes: Any, choice: Choice) -> None:
        places = np.arange(len(choice.labels))
        self._bars = axes.bar(places, np.zeros(len(places)))
        self._spreads = axes.vlines(places, 0, 0, color="0.2", linewidth=1.5)
        axes.set_title(choice.title, fontsize=8)
        axes.axhline(0, color="0.3", linewidth=0.8)
        shown = places[:: -(-len(places) // _MOST_LABELS)]
        axes.set_xticks(shown, [choice.labels[i] for i in shown])
        axes.tick_params(labelsize=7)
        self._axes = axes
        self._is_probability = "probabilit" in choice.title
        self._low, self._high = (0.0, 1.0) if self._is_probability else (-1e-9, 1e-9)
        axes.set_ylim(self._low, self._high)

    def show(self, choice: Choice) -> None:
        """Shows another choice among the same options."""
        for bar, height, chosen in zip(self._bars, choice.heights, choice.chosen, strict=True):
            bar.set_height(float(height))
            bar.set_color("C1" if chosen else "C0")
        low = high = choice.heights
        if choice.spreads is not None:
            low, high = choice.heights - choice.spreads, choice.heights + choice.spreads
            ends = zip(low, high, strict=True)
            self._spreads.set_segments([[(i, a), (i, b)] for i, (a, b) in enumerate(ends)])
        if not self._is_probability:
            self._low = min(self._low, 1.1 * float(low.min()))
            self._high = max(self._high, 1.1 * float(high.max()))
            self._axes.set_ylim(self._low, self._high)


class _Timeline:
    """Attention over the K steps, a row for each head, with the frames under it."""

    def __init__(self, figure: Any, attention: np.ndarray) -> None:
        blocks, heads, frames = attention.shape
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 2])
        self._image = above.imshow(
            np.zeros((blocks * heads, frames)), aspect="auto", cmap="inferno"
        )
        self._most = 0.0
        above.set_title("what the newest step reads of each step", fontsize=8)
        middles = [(block + 0.5) * heads - 0.5 for block in range(blocks)]
        above.set_yticks(middles, [f"block {block + 1}" for block in range(blocks)])
        for block in range(1, blocks):
            above.axhline(block * heads - 0.5, color="white", linewidth=1)
        above.tick_params(labelsize=7, bottom=False, labelbottom=False)
        figure.colorbar(self._image, ax=above).ax.tick_params(labelsize=6)
        self._axes = below
        self._strip: Any = None
        shown = np.arange(frames)[:: -(-frames // _MOST_LABELS)]
        ages = [str(step - frames + 1) if step < frames - 1 else "now" for step in shown]
        below.set_xticks(shown, ages)
        below.set_yticks([])
        below.tick_params(labelsize=7, length=0)
        for side in below.spines.values():
            side.set_visible(False)

    def show(self, attention: np.ndarray, pictures: list[np.ndarray]) -> None:
        """Shows the attention of another step, [blocks, heads, K], and the K frames."""
        self._image.set_data(attention.reshape(-1, attention.shape[-1]))
        self._most = max(self._most, float(attention.max()))  # so that steps are comparable
        self._image.set_clim(0, self._most)
        slot = (max(_STRIP[0] // len(pictures), 8), _STRIP[1])
        strip = np.concatenate([_thumbnail(picture, slot) for picture in pictures], 1)
        if self._strip is None:
            extent = (-0.5, len(pictures) - 0.5, 0, 1)
            self._strip = self._axes.imshow(strip, extent=extent, aspect="auto")
        self._strip.set_data(strip)


class _Trace:
    """The values of an episode so far."""

    def __init__(self, figure: Any) -> None:
        axes = figure.subplots()
        axes.set_title("value", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
        (self._line,) = axes.plot([], [], color="C0", linewidth=1.5)
        (self._newest,) = axes.plot([], [], "o", color="C1", markersize=4)
        self._axes = axes

    def show(self, values: Sequence[float]) -> None:
        """Shows the values of the steps so far."""
        self._line.set_data(range(len(values)), values)
        self._newest.set_data([len(values) - 1], [values[-1]])
        self._axes.relim()
        self._axes.autoscale_view()


def _thumbnail(picture: np.ndarray, slot: tuple[int, int]) -> np.ndarray:
    """A small copy of a picture, centred in a white rectangle of this width and height."""
    scale = min((slot[0] - 2) / picture.shape[1], (slot[1] - 2) / picture.shape[0], 1)
    height, width = (max(1, round(side * scale)) for side in picture.shape[:2])
    pixels = torch.tensor(picture).permute(2, 0, 1).unsqueeze(0).float()
    small = F.interpolate(pixels, (height, width), mode="area")[0].permute(1, 2, 0)
    rectangle = np.full((slot[1], slot[0], 3), 255, np.uint8)
    left, top = (slot[0] - width) // 2, (slot[1] - height) // 2
    rectangle[top : top + height, left : left + width] = small.round().byte().numpy()
    return rectangle

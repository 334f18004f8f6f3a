"""Draws explained steps: what was observed, what mattered, and what was chosen, on one page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch.nn import functional as F

_SIZE = (9.6, 5.4)  # at 80 dots per inch 768 x 432 pixels: films need even sides
_SMALLEST = 84  # images are enlarged to this many pixels per side
_STRIP = (740, 90)  # the frames under a timeline: twice the pixels that they take on the page
_MOST_LABELS = 24
_OPACITY = 0.65
_COLORS = colormaps["inferno"]


@dataclass(frozen=True)
class Choice:
    """An action, and what it was chosen from."""

    title: str
    """The meaning of the heights."""
    labels: list[str]
    heights: np.ndarray
    """Probabilities of the options, or values, NaN where forbidden, or the entries of a continuous
    action, [n]."""
    spreads: np.ndarray | None
    """The standard deviations of these entries, if the policy samples them, [n]."""
    chosen: list[bool]
    """Which were chosen; all entries of a continuous action."""


@dataclass(frozen=True)
class Seen:
    """An observation of the K steps, and how much each part of it matters."""

    frames: np.ndarray
    """The K observations, the oldest first: images [K, H, W] or [K, C, H, W], or arrays [K, D]."""
    maps: np.ndarray
    """What matters in them: of images [K, h, w], or [1, h, w] of all together; of arrays [K, D]."""

    @property
    def is_image(self) -> bool:
        """Whether it is an image."""
        return self.frames.ndim > 2


@dataclass(frozen=True)
class ExplainedStep:
    """What a policy looked at in one step, and what it chose."""

    seen: dict[str, Seen]
    """By the name of the observation; observations without a map are left out."""
    attention: np.ndarray | None
    """Attention of the newest step to each step, [blocks, heads, K], if there is attention."""
    choice: Choice
    value: float | None
    """The value of the state, or of the action, if the policy computes one."""

    def describe(self) -> str:
        """Says in words what was chosen and what was read most, for those who cannot see it."""
        choice = self.choice
        options = ", ".join(
            f"{label} {'forbidden' if np.isnan(height) else f'{height:.2f}'}"
            f"{' (chosen)' if chosen else ''}"
            for label, height, chosen in zip(
                choice.labels, choice.heights, choice.chosen, strict=True
            )
        )
        parts = [f"{choice.title[0].upper()}{choice.title[1:]}: {options}"]
        for name, seen in self.seen.items():
            newest = seen.maps[-1]
            place = np.unravel_index(int(np.abs(newest).argmax()), newest.shape)
            which = "part" if seen.is_image else "entry"
            parts.append(f"Of {name}, {which} {', '.join(map(str, place))} matters most")
        if self.attention is not None and self.attention.shape[-1] > 1:
            shares = self.attention.mean((0, 1))
            ago = len(shares) - 1 - int(shares.argmax())
            parts.append(f"Attention over time reads most of {ago} steps ago ({shares.max():.0%})")
        if self.value is not None:
            parts.append(f"The value is {self.value:.3g}")
        return ". ".join(parts) + "."


class Page:
    """A page for the steps of an episode, drawn again for each.

    Above, the rendered task, each observation with its map, and the action; below, attention over
    the K steps with the frames under it, and the value so far. Scales only grow, so that steps are
    comparable.

    Args:
        step: a step of the episode, which determines the panels to draw.
        title: title of the page; without one, nothing is written above it.
        dpi: dots per inch; the page is 9.6 x 5.4 inches.
    """

    def __init__(self, step: ExplainedStep, title: str, dpi: int = 80) -> None:
        self._figure = Figure(figsize=_SIZE, dpi=dpi, layout="constrained")
        self._canvas = FigureCanvasAgg(self._figure)
        self._title = title
        self._limits: dict[Any, tuple[float, float]] = {}
        over_time = step.attention is not None and step.attention.shape[-1] > 1
        lower = [3] * over_time + [2] * (step.value is not None)
        heights = [3, 2] if lower else [3]
        rows = self._figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
        self._task, *self._seen, self._choice = rows[0].subplots(1, 2 + len(step.seen))
        self._timeline: Any = None
        self._trace: Any = None
        if lower:
            parts = rows[1].subfigures(1, len(lower), squeeze=False, width_ratios=lower)[0]
            if over_time:
                self._timeline = parts[0].subplots(2, 1, sharex=True, height_ratios=[3, 2])
            if step.value is not None:
                self._trace = parts[-1].subplots()

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
        for axes in self._figure.axes:
            axes.clear()
            axes.tick_params(labelsize=7)
        if self._title:
            self._figure.suptitle(f"{self._title}, step {number}", fontsize=9)
        _draw_picture(self._task, pictures[-1], "task")
        strip: list[np.ndarray] = []
        for axes, (name, seen) in zip(self._seen, step.seen.items(), strict=True):
            title = f"{name}: what matters"
            if seen.is_image:
                laid = lay_over(seen)
                _draw_picture(axes, laid[-1], title)
                strip = strip or laid
            else:
                self._draw_entries(axes, seen.maps, title)
        self._draw_choice(step.choice)
        if self._timeline is not None:
            assert step.attention is not None
            frames = step.attention.shape[-1]
            # The episode's first picture fills the frames before its first step.
            missing = [pictures[0]] * (frames - len(pictures))
            self._draw_timeline(step.attention, strip or [*missing, *pictures[-frames:]])
        if self._trace is not None:
            self._trace.set_title("value", fontsize=8)
            self._trace.grid(alpha=0.3)
            self._trace.plot(values, c="C0", lw=1.5)
            self._trace.plot(len(values) - 1, values[-1], "o", c="C1", ms=4)
        self._canvas.draw()
        self._figure.set_layout_engine("none")  # laid out once
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _grown(self, panel: Any, low: float, high: float) -> tuple[float, float]:
        """The limits that hold these numbers and all that a panel has shown before."""
        before = self._limits.get(panel, (-1e-9, 1e-9))
        self._limits[panel] = min(low, before[0]), max(high, before[1])
        return self._limits[panel]

    def _draw_entries(self, axes: Any, maps: np.ndarray, title: str) -> None:
        """Draws bars for the entries of an array: the newest step's, and all earlier steps'."""
        newest, before = maps[-1], maps[:-1].sum(0)
        places = np.arange(len(newest))
        earlier = "\nnow, and (gray) in earlier steps" if len(maps) > 1 else ""
        axes.set_title(title + earlier, fontsize=8)
        axes.barh(places, before, color="0.75")
        axes.barh(places, newest, 0.5, color="C1")
        axes.axvline(0, c="0.3", lw=0.8)
        axes.set_yticks(places[:: -(-len(places) // _MOST_LABELS)])
        axes.invert_yaxis()
        reach = 1.1 * float(np.abs([newest, before]).max())
        axes.set_xlim(self._grown(axes, -reach, reach))

    def _draw_choice(self, choice: Choice) -> None:
        """Draws bars for the options, or the entries of a continuous action, with spreads."""
        axes, places = self._choice, np.arange(len(choice.heights))
        colors = ["C1" if chosen else "C0" for chosen in choice.chosen]
        axes.bar(places, choice.heights, color=colors, yerr=choice.spreads, ecolor="0.2")
        axes.axhline(0, c="0.3", lw=0.8)
        axes.set_title(choice.title, fontsize=8)
        shown = places[:: -(-len(places) // _MOST_LABELS)]
        axes.set_xticks(shown, [choice.labels[i] for i in shown])
        spreads = 0 if choice.spreads is None else choice.spreads
        low, high = np.nanmin(choice.heights - spreads), np.nanmax(choice.heights + spreads)
        is_share = "probabilit" in choice.title
        axes.set_ylim((0, 1) if is_share else self._grown(axes, 1.1 * low, 1.1 * high))

    def _draw_timeline(self, attention: np.ndarray, pictures: list[np.ndarray]) -> None:
        """Draws attention over the K steps, a row for each head, with the frames under it."""
        above, below = self._timeline
        blocks, heads, frames = attention.shape
        _, most = self._grown(above, 0, float(attention.max()))
        rows = attention.reshape(-1, frames)
        above.imshow(rows, vmin=0, vmax=most, aspect="auto", cmap=_COLORS)
        above.set_title(
            f"what the newest step reads of each step (brightest: {most:.0%})", fontsize=8
        )
        middles = [(block + 0.5) * heads - 0.5 for block in range(blocks)]
        above.set_yticks(middles, [f"block {block + 1}" for block in range(blocks)])
        for block in range(1, blocks):
            above.axhline(block * heads - 0.5, c="white", lw=1)
        above.tick_params(bottom=False, labelbottom=False)
        slot = (max(_STRIP[0] // len(pictures), 8), _STRIP[1])
        strip = np.concatenate([_thumbnail(picture, slot) for picture in pictures], 1)
        below.imshow(strip, extent=(-0.5, frames - 0.5, 0, 1), aspect="auto")
        shown = np.arange(frames)[:: -(-frames // _MOST_LABELS)]
        below.set_xticks(shown, [str(i - frames + 1) if i < frames - 1 else "now" for i in shown])
        below.set_yticks([])
        below.tick_params(length=0)
        below.set_frame_on(False)


def _draw_picture(axes: Any, picture: np.ndarray, title: str) -> None:
    axes.imshow(picture, interpolation="nearest")
    axes.set_title(title, fontsize=8)
    axes.set_axis_off()


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

    Three channels are taken as colors; other channels are averaged. Small images are enlarged.
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
    """Colors a picture [H, W, 3] by a map [h, w] from 0 to 1; where it is 0, nothing changes."""
    sides = picture.shape[:2]
    cells = torch.from_numpy(np.ascontiguousarray(strength, dtype=np.float64))[None, None]
    smooth = F.interpolate(cells, sides, mode="bilinear")[0, 0].numpy().clip(0, 1)
    colors = 255 * _COLORS(smooth)[..., :3]
    opacity = _OPACITY * smooth[..., None]
    return (picture * (1 - opacity) + colors * opacity).round().astype(np.uint8)


def _thumbnail(picture: np.ndarray, slot: tuple[int, int]) -> np.ndarray:
    """A small copy of a picture, centered in a white rectangle of this width and height."""
    scale = min((slot[0] - 2) / picture.shape[1], (slot[1] - 2) / picture.shape[0], 1)
    height, width = (max(1, round(side * scale)) for side in picture.shape[:2])
    pixels = torch.tensor(picture).permute(2, 0, 1).unsqueeze(0).float()
    small = F.interpolate(pixels, (height, width), mode="area")[0].permute(1, 2, 0)
    rectangle = np.full((slot[1], slot[0], 3), 255, np.uint8)
    left, top = (slot[0] - width) // 2, (slot[1] - height) // 2
    rectangle[top : top + height, left : left + width] = small.round().byte().numpy()
    return rectangle

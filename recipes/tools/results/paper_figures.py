"""The paper's figures of attention: maps of several agents on the same frames, and weights.

arXiv 2212.14538, figures 3 and 6 (Grad-CAM) and 7 (attention weights).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tit.agents import TrainedAgent
from torchrl_tit.analysis import Target, inner_attention, outer_weights
from torchrl_tit.analysis.layers import patch_grid
from torchrl_tit.analysis.targets import find_network, histories_of
from torchrl_tit.files import whole_or_not_at_all
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.networks.building import evaluating

from .explained_page import Seen, as_picture, lay_over
from .explanation import Explainer, MapKind, play_steps
from .plot import new_figure

Panel: TypeAlias = tuple[str, np.ndarray] | None
"""A title and what is drawn below it; None stays empty."""

_MOST_FRAMES = 8  # of which the weights over patches are drawn, the newest


def compare_maps(
    agents: Sequence[TrainedAgent],
    out: Path,
    *,
    steps: Sequence[int] = (0,),
    seed: int = 0,
    target: Target = "action",
    kind: MapKind | None = None,
    layer: str | None = None,
) -> None:
    """Draws what several agents look at in the same frames: a row for each step.

    The first agent plays. The others are asked in each state what they would do, and what matters
    for it; then the first one's action is taken.

    Args:
        agents: the agents, all of one task, which read images.
        out: the PNG to write, which must not exist yet.
        steps: the steps of the episode, counted from 0.
        seed: seed of the episode.
        target: what is explained.
        kind: kind of maps; by default Grad-CAM.
        layer: name of a layer for Grad-CAM, which all agents have.

    Raises:
        ValueError: if an agent reads no image or other frames, or the episode has no such step.
    """
    shown: list[list[Seen]] = []
    actions: list[Tensor] = []
    for agent in agents:
        explainer = Explainer(agent.policy, target=target, kind=kind or "grad-cam", layer=layer)
        found: list[Seen] = []

        def look(
            number: int,
            acted: TensorDictBase,
            explainer: Explainer = explainer,
            found: list[Seen] = found,
        ) -> None:
            images = [seen for seen in explainer.explain(acted).seen.values() if seen.is_image]
            if not images:
                raise ValueError("these maps are laid over images, and the task has none")
            found.append(images[0])

        actions = _play(agent, steps, seed, look, actions)
        shown.append(found)
        for step, mine, first in zip(sorted({*steps}), found, shown[0], strict=True):
            if not np.array_equal(mine.frames[-1], first.frames[-1]):
                raise ValueError(
                    f"{agent.name} and {agents[0].name} see different frames in step {step}: "
                    "choose agents of one task with the same settings"
                )
    rows = [
        [as_picture(row[0].frames[-1]), *(lay_over(seen)[-1] for seen in row)]
        for row in zip(*shown, strict=True)
    ]
    titles = ["observation", *(Path(agent.name).name for agent in agents)]
    labels = [f"step {step}" for step in sorted({*steps})]
    figure, grid = _grid(len(rows), len(titles))
    for panels, pictures in zip(grid, rows, strict=True):
        for axes, picture in zip(panels, pictures, strict=True):
            axes.imshow(picture, interpolation="nearest")
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, fontsize=9)
    for axes, label in zip(grid[:, 0], labels, strict=True):
        axes.set_ylabel(label, fontsize=9)
    _save(figure, out)


def draw_weights(
    agent: TrainedAgent, out: Path, *, step: int = 0, seed: int = 0, target: Target = "action"
) -> None:
    """Draws the attention weights of an agent in one step: a row for each block.

    On the left, unless the observation is one patch, the weights with which an inner block's class
    token reads the patches of each of the last frames, averaged over its heads and without its
    weight for itself. On the right, the K x K weights of each head of the outer block, rows
    (queries) and columns (keys) from the oldest step to the newest.

    Args:
        agent: the agent.
        out: the PNG to write, which must not exist yet.
        step: the step of the episode, counted from 0.
        seed: seed of the episode.
        target: which network is drawn, if policy and value have one each.

    Raises:
        ValueError: if the network has no attention, or the episode has no such step.
    """
    panels: list[list[Panel]] = []

    def look(number: int, acted: TensorDictBase) -> None:
        network = find_network(agent.policy, target)
        with evaluating(agent.policy), torch.no_grad():
            histories = histories_of(agent.policy, acted.detach())
            panels.extend(_weights(network, histories))

    _play(agent, [step], seed, look, [])
    figure, grid = _grid(len(panels), max(map(len, panels)))
    for row, found in zip(grid, panels, strict=True):
        for axes, panel in zip(row, [*found, *[None] * (len(row) - len(found))], strict=True):
            if panel is None:
                axes.set_axis_off()
                continue
            title, values = panel
            axes.set_title(title, fontsize=7)
            axes.imshow(values, cmap="inferno", interpolation="nearest", vmin=0)
    figure.suptitle(f"{Path(agent.name).name}, step {step}", fontsize=9)
    _save(figure, out)


def _weights(network: HistoryNetwork, histories: Sequence[Tensor]) -> list[list[Panel]]:
    """The panels of :func:`draw_weights`: the frames, then a row for each block."""
    inner: dict[str, list[Tensor]] = {}
    outer: Tensor | None = None
    with suppress(ValueError):  # there is none
        inner = inner_attention(network, *histories)
    inner = {name: blocks for name, blocks in inner.items() if blocks[0].shape[-1] > 2}  # patches
    with suppress(ValueError):
        outer = outer_weights(network, *histories)[0]
    if not inner and outer is None:
        raise ValueError(
            "this network has no attention over several patches or steps: inner and outer "
            "transformers, Catformer, GTrXL, CoBERL and Decision Transformer have"
        )
    rows: list[list[Panel]] = []
    frames = dict(zip(network.observations, histories, strict=False))
    for name, blocks in inner.items():
        newest = frames[name][0, -_MOST_FRAMES:]
        ago = [f"t-{i}" if i else "t" for i in reversed(range(len(newest)))]
        if network.observations[name].kind == "image":
            pictures = [as_picture(frame.cpu().numpy()) for frame in newest]
            rows.append([(f"{name}, {at}", x) for at, x in zip(ago, pictures, strict=True)])
        for number, block in enumerate(blocks, 1):
            of_frames = block[0, -_MOST_FRAMES:].mean(-3)[..., 0, 1:]
            maps = of_frames.unflatten(-1, patch_grid(network, name)).cpu().numpy()
            when = ago if len(maps) == len(ago) else ["all frames"]
            rows.append(
                [(f"inner block {number}, {at}", x) for at, x in zip(when, maps, strict=True)]
            )
    if outer is None:
        return rows
    # With one observation, the matrices stand beside the inner block of the same number.
    first = len(rows) - len(*inner.values()) if len(inner) == 1 else 0
    width = max(map(len, rows), default=0)
    rows += [[] for _ in range(first + len(outer) - len(rows))]
    for number, (row, heads) in enumerate(zip(rows[first:], outer, strict=False), 1):
        row += [None] * (width - len(row))
        row += [
            (f"outer block {number}, head {head}", weights.cpu().numpy())
            for head, weights in enumerate(heads, 1)
        ]
    return rows


def _play(
    agent: TrainedAgent, steps: Sequence[int], seed: int, look: Any, actions: Sequence[Tensor]
) -> list[Tensor]:
    """Plays an episode up to the last of some steps, and looks at these steps.

    Args:
        agent: acts, unless there are actions.
        steps: counted from 0.
        seed: seed of the episode.
        look: called with the number of each step and what the agent wrote.
        actions: those to take instead of the agent's.

    Returns:
        The actions that were taken.

    Raises:
        ValueError: if the episode has no such step.
    """

    def at_steps(number: int, acted: TensorDictBase) -> None:
        if number in steps:
            look(number, acted)

    last = max(steps)
    with closing(agent.make_env(1)) as env:
        return play_steps(
            env, agent.policy, last, last, at_steps, seed=seed, actions=actions or None
        )


def _grid(rows: int, columns: int) -> tuple[Figure, Any]:
    figure = new_figure((1.6 * columns, 1.7 * rows + 0.4))
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in figure.axes:
        axes.set_xticks([])
        axes.set_yticks([])
    return figure, grid


def _save(figure: Figure, out: Path) -> None:
    if out.suffix != ".png":
        raise ValueError(f"the figure is a picture (.png), not {out.name!r}")
    with whole_or_not_at_all(out) as hidden:
        figure.savefig(hidden, format="png")

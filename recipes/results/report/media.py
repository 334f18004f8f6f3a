"""Films and explained steps of a run's agent, as the bytes of their files."""

from __future__ import annotations

import io
from collections import deque
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio.v3 as imageio
import numpy as np
from tensordict import TensorDictBase

from torchrl_tit.agents import TrainedAgent
from torchrl_tit.evaluation import evaluate

from ..explained_page import Page
from ..explained_step import ExplainedStep, Explainer, read_value
from ..film import film_policy, make_rendered, take_picture
from .run_data import RunData

_MOST_PICTURES = 1500  # per film: half a minute of CartPole, and a few megabytes at most
_FEWEST_PICTURES, _MOST_EPISODES = 100, 10  # more episodes make a short film longer
_SHARP = 160  # dots per inch of explained steps


class _Enough(Exception):
    """All steps are drawn."""


@dataclass(frozen=True)
class Film:
    """Episodes as an MP4 film."""

    video: bytes
    poster: bytes
    """A picture from its middle, PNG."""
    seed: int
    """Seed of the first episode."""
    first_steps: int
    """Steps of the first episode."""
    steps: int
    """Steps of all episodes; the film shows the first 1,500 at most."""
    shown: int
    returns: list[float]


@dataclass(frozen=True)
class Explained:
    """What an agent looked at in one step."""

    step: int
    picture: bytes
    alt: str


@dataclass
class Media:
    """Films and explanations of each group, and the reasons for missing ones."""

    films: dict[int, Film] = field(default_factory=dict)
    explained: dict[int, list[Explained]] = field(default_factory=dict)
    runs: dict[int, RunData] = field(default_factory=dict)
    """The run whose agent is shown."""
    parameters: dict[int, int] = field(default_factory=dict)
    """Number of weights of the policy."""
    notes: list[str] = field(default_factory=list)


def film_episodes(agent: TrainedAgent) -> Film:
    """Films the first episode of an agent's evaluation, and the next ones if it is short.

    Raises:
        ValueError: if its task cannot be rendered, or a package that rendering needs is missing.
    """
    with TemporaryDirectory() as folder:
        video = Path(folder, "episodes.mp4")
        returns, first_steps = _film(agent, video, 1)
        steps, more = first_steps, min(_MOST_EPISODES, -(-_FEWEST_PICTURES // first_steps))
        if more > 1:
            video.unlink()
            returns, steps = _film(agent, video, more)
        shown = min(steps, _MOST_PICTURES)
        middle = imageio.imread(video, index=shown // 2, plugin="FFMPEG")
        content = video.read_bytes()
    return Film(content, _png(middle), agent.first_seed, first_steps, steps, shown, returns)


def _film(agent: TrainedAgent, video: Path, episodes: int) -> tuple[list[float], int]:
    """Writes a film; returns the returns of its episodes and the number of all their steps."""
    steps = 0

    def counted(tensordict: TensorDictBase) -> TensorDictBase:
        nonlocal steps
        steps += 1
        return agent.policy(tensordict)

    returns = film_policy(
        agent.make_env,
        counted,
        agent.name,
        video,
        episodes,
        agent.first_seed,
        max_pictures=_MOST_PICTURES,
    )
    return returns, steps


def explain_steps(agent: TrainedAgent, steps: list[int]) -> list[Explained]:
    """Draws what an agent looks at in some steps of the same episode.

    Args:
        agent: the agent.
        steps: the steps, counted from 0; those after the episode's end are left out.

    Raises:
        ValueError: if its task cannot be rendered, or there are no maps for its network.
    """
    explainer = Explainer(agent.policy)
    found: list[Explained] = []
    values: list[Any] = []
    recent: deque[np.ndarray] = deque(maxlen=explainer.network.num_frames)
    page: Page | None = None
    with closing(make_rendered(agent.make_env, agent.name)) as env:
        base: Any = env.base_env

        def explained(tensordict: TensorDictBase) -> TensorDictBase:
            nonlocal page
            number = len(values)
            acted = agent.policy(tensordict)
            values.append(read_value(acted))
            recent.append(np.asarray(take_picture(base, agent.name)))
            if number in steps:
                step = explainer.explain(acted)
                page = page or Page(step, "", dpi=_SHARP)
                picture = page.draw(step, [*recent], values, number)
                found.append(Explained(number, _png(picture), _in_words(step, number)))
            if number >= max(steps):
                raise _Enough
            return acted

        with suppress(_Enough):
            evaluate(env, explained, 1, seed=agent.first_seed)
    return found


def _in_words(step: ExplainedStep, number: int) -> str:
    choice = step.choice
    options = ", ".join(
        f"{label} {height:.2f}{' (chosen)' if chosen else ''}"
        for label, height, chosen in zip(choice.labels, choice.heights, choice.chosen, strict=True)
    )
    parts = [f"Step {number}. {choice.title[0].upper()}{choice.title[1:]}: {options}"]
    for name, seen in step.seen.items():
        if not seen.is_image:
            shares = seen.maps[-1]
            most = int(np.abs(shares).argmax())
            parts.append(f"Of {name}, entry {most} matters most now ({shares[most]:+.2g})")
        else:
            row, column = np.unravel_index(int(seen.maps[-1].argmax()), seen.maps[-1].shape)
            height, width = seen.maps[-1].shape
            parts.append(
                f"Of {name}, what matters most lies {round(100 * float(column + 0.5) / width)}% "
                f"from the left and {round(100 * float(row + 0.5) / height)}% from the top"
            )
    if step.attention is not None and step.attention.shape[-1] > 1:
        shares = step.attention.mean((0, 1))
        most = len(shares) - 1 - int(shares.argmax())
        when = "the newest step" if most == 0 else f"the step {most} before the newest"
        parts.append(f"Attention over time reads {when} most ({shares.max():.0%})")
    if step.value is not None:
        parts.append(f"The value is {step.value:.3g}")
    return ". ".join(parts) + "."


def _png(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    imageio.imwrite(buffer, picture, extension=".png")
    return buffer.getvalue()

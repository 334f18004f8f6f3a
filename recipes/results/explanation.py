"""Films and pictures of what a trained agent looks at."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio.v2 as imageio
import numpy as np
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_tit.evaluation import evaluate
from torchrl_tit.files import whole_or_not_at_all

from .explained_page import Page
from .explained_step import Explainer, read_value
from .film import make_rendered, open_film, take_picture

_FILMS = (".gif", ".mp4")
_SUFFIXES = (*_FILMS, ".png")


class _Enough(Exception):
    """Everything that was requested is drawn."""


def explain_policy(
    make_env: Callable[..., EnvBase],
    policy: TensorDictModuleBase,
    name: str | Path,
    out: Path,
    *,
    seed: int = 0,
    step: int | None = None,
    max_steps: int | None = None,
    title: str | None = None,
    **explanation: Any,
) -> int:
    """Shows what a policy looks at while it plays an episode with its most likely actions.

    Args:
        make_env: makes the task, given the number of copies and ``render_mode``.
        policy: the policy.
        name: name of the policy in messages.
        out: the file to write, which must not exist yet: a film (GIF or MP4) of the episode, or a
            picture (PNG) of one step.
        seed: seed of the episode.
        step: for a picture, the step to show, counted from 0, which is the default.
        max_steps: for a film, the maximum number of steps to show; by default the whole episode.
        title: name of the policy on the page; by default ``name``.
        **explanation: arguments of :class:`~recipes.results.explained_step.Explainer`.

    Returns:
        The number of steps that are shown.

    Raises:
        FileExistsError: if there is such a file already.
        ValueError: if the file is of another kind, the episode ends before the step, the task
            cannot be rendered, or there are no such maps for the network.
    """
    check_explanation(out, step, max_steps)
    explainer = Explainer(policy, **explanation)
    first = 0 if step is None else step
    last = first if out.suffix == ".png" else None if max_steps is None else max_steps - 1
    env = make_rendered(make_env, name)
    base: Any = env.base_env  # transforms have no pictures
    count = shown = 0
    page: Page | None = None
    values: list[Any] = []
    recent: deque[np.ndarray] = deque(maxlen=explainer.network.num_frames)
    try:
        with (
            whole_or_not_at_all(out) as hidden,
            # The writer infers the format from the suffix, which the hidden name lacks.
            TemporaryDirectory(prefix=".", dir=out.absolute().parent) as folder,
        ):
            reel = Path(folder, out.name)
            with _open(reel, base.render_fps) as pictures:

                def explained(tensordict: TensorDictBase) -> TensorDictBase:
                    nonlocal count, shown, page
                    number, count = count, count + 1
                    acted = policy(tensordict)
                    values.append(read_value(acted))
                    if number > first - explainer.network.num_frames:
                        recent.append(np.asarray(take_picture(base, name)))
                    if number < first:
                        return acted
                    step = explainer.explain(acted)
                    page = page or Page(step, title or str(name))
                    pictures.append_data(page.draw(step, [*recent], values, number))
                    shown += 1
                    if number == last:
                        raise _Enough
                    return acted

                with suppress(_Enough):
                    evaluate(env, explained, 1, seed=seed)
                if not shown:
                    raise ValueError(
                        f"the episode of seed {seed} has {count} steps, so there is no step "
                        f"{first}: choose one below {count}"
                    )
            reel.rename(hidden)
    finally:
        env.close()
    return shown


def check_explanation(out: Path, step: int | None, max_steps: int | None) -> None:
    """Raises ValueError if a file, or the steps to show in it, are invalid."""
    if out.suffix not in _SUFFIXES:
        raise ValueError(
            f"an explanation is a film (.gif, .mp4) or a picture of one step (.png), not "
            f"{out.name!r}"
        )
    if step is not None and out.suffix in _FILMS:
        raise ValueError(f"step {step} is one step, so it is a picture: write it to a .png")
    if max_steps is not None and out.suffix not in _FILMS:
        raise ValueError(f"max_steps {max_steps} is the length of a film, not of a .png: use step")
    if step is not None and step < 0:
        raise ValueError(f"steps are counted from 0, so there is no step {step}")
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, not {max_steps}")


def _open(file: Path, fps: float) -> Any:
    """Opens a film, or a picture, which holds only one frame."""
    if file.suffix == ".png":
        return imageio.get_writer(file, format="PNG-PIL", mode="i")
    return open_film(file, fps)

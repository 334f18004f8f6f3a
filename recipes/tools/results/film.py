"""Films of trained agents."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio.v2 as imageio
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, Transform

from torchrl_tit.evaluation import evaluate
from torchrl_tit.extras import install
from torchrl_tit.files import whole_or_not_at_all

FILMS = (".gif", ".mp4")


def check_film(video: Path) -> None:
    """Raises ValueError if a file is neither a GIF nor an MP4."""
    if video.suffix not in FILMS:
        raise ValueError(f"a film is one of {', '.join(FILMS)}, not {video.name!r}")


def film_policy(
    make_env: Callable[..., EnvBase],
    policy: Callable[[TensorDictBase], TensorDictBase],
    name: str | Path,
    video: Path,
    episodes: int = 1,
    seed: int = 0,
    max_pictures: int | None = None,
) -> list[float]:
    """Films a policy while it plays with its most likely actions.

    There is a picture before each step, and one of how the episode ends.

    Args:
        make_env: makes the task, given the number of copies and ``render_mode``.
        policy: the policy.
        name: name of the policy in messages.
        video: the GIF or MP4 file to write, which must not exist yet.
        episodes: number of episodes, shown one after another in one film.
        seed: seed of the first episode; episode i begins from ``seed + i``.
        max_pictures: length of the film, after which the policy plays on without being filmed; by
            default, everything is shown.

    Returns:
        The return of each episode.

    Raises:
        FileExistsError: if there is such a file already.
        ValueError: if the file is of another kind, ``episodes`` is less than 1, the task cannot be
            rendered, or something that rendering needs is missing: a package, or OpenGL for a
            MuJoCo task.
    """
    check_film(video)
    left = math.inf if max_pictures is None else max_pictures
    with (
        closing(make_rendered(make_env, name)) as env,
        new_film(video, env.base_env.render_fps) as pictures,
    ):

        def show() -> None:
            nonlocal left
            if left > 0:
                pictures.append_data(take_picture(env, name))
                left -= 1

        def filmed(tensordict: TensorDictBase) -> TensorDictBase:
            show()
            return policy(tensordict)

        env.append_transform(_AtTheEnd(show))
        return evaluate(env, filmed, episodes, seed=seed).tolist()


class _AtTheEnd(Transform):
    """Calls a function at the end of each episode, before the next one begins."""

    def __init__(self, function: Callable[[], None]) -> None:
        super().__init__()
        self._function = function

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if next_tensordict["done"].any():
            self._function()
        return next_tensordict


def make_rendered(make_env: Callable[..., EnvBase], name: str | Path) -> Any:
    """Makes one copy of a task that can be rendered; raises ValueError if it cannot."""
    try:
        return make_env(1, render_mode="rgb_array")
    except ValueError as error:  # the task has no such setting
        raise ValueError(f"{name} cannot be rendered: {error}") from error


def take_picture(env: Any, name: str | Path) -> Any:
    """Renders a task, uint8 [height, width, 3]; raises ValueError if it cannot be rendered."""
    try:
        return env.base_env.render()[0]  # transforms have no pictures
    except Exception as error:  # each task has its own renderer, with its own errors
        hint = (
            "; for MuJoCo without a screen, set the environment variable MUJOCO_GL to egl or osmesa"
        )
        ours = isinstance(error, ValueError)  # there is nothing to render
        reason = f"{str(error).rstrip('.')}{'' if ours else hint}"
        raise ValueError(f"{name} cannot be rendered: {reason}") from error


@contextmanager
def new_film(out: Path, fps: float) -> Iterator[Any]:
    """Opens a new GIF, MP4 or PNG, which takes pictures one by one: long films need no memory.

    If anything is raised meanwhile, no file is left behind.
    """
    with (
        whole_or_not_at_all(out) as hidden,
        # The writer infers the format from the suffix, which the hidden name lacks.
        TemporaryDirectory(prefix=".", dir=out.absolute().parent) as folder,
    ):
        reel = Path(folder, out.name)
        with _open(reel, fps) as pictures:
            yield pictures
        reel.rename(hidden)


def _open(video: Path, fps: float) -> Any:
    if video.suffix == ".png":
        return imageio.get_writer(video, format="PNG-PIL", mode="i")
    if video.suffix == ".gif":
        return imageio.get_writer(video, format="GIF", mode="I", duration=1000 / fps, loop=0)
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ValueError(f"MP4 needs imageio-ffmpeg: {install('imageio_ffmpeg')}; or use .gif")
    # The codec needs even sizes, not multiples of 16.
    return imageio.get_writer(video, format="FFMPEG", mode="I", fps=fps, macro_block_size=2)

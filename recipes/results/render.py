"""What `render` does on the command line: film a trained agent."""

from __future__ import annotations

import argparse
import importlib.util
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium
import imageio.v2 as imageio
from tensordict import TensorDictBase

from torchrl_tit.evaluation import evaluate
from torchrl_tit.files import whole_or_not_at_all

from ..recipe import Recipe
from ..run import Run

_SUFFIXES = (".gif", ".mp4")


def add_render_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `render` to the command line.

    Args:
        parser: What reads the words after `render`; its options then go to :func:`run_render`.
    """
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--out", type=Path, required=True, help="new file: .gif or .mp4")
    parser.add_argument("--episodes", type=int, default=1, help="episodes, or whole Atari games")
    parser.add_argument(
        "--seed", type=int, help="seed of the first episode; the evaluation's if missing"
    )


def run_render(options: argparse.Namespace) -> None:
    """Films the agent of a run folder and prints the returns.

    Args:
        options: What the parser read.

    Raises:
        FileNotFoundError: If there is no run, or it has no checkpoint.
        ValueError: If the file's kind, the episodes or the task do not allow it.
    """
    run = Run.open(options.run)
    recipe = run.recipe
    if options.seed is not None:
        recipe = replace(recipe, evaluation_seed=options.seed)
    returns = render(recipe, run, options.out, options.episodes)
    print(f"returns {', '.join(f'{value:g}' for value in returns)}\nwritten to {options.out}")


def render(recipe: Recipe, run: Run, video: Path, episodes: int = 1) -> list[float]:
    """Films a run's newest agent while it plays as in the evaluation.

    Args:
        recipe: The run's recipe; episode i begins from its ``evaluation_seed + i``.
        run: A run folder with a checkpoint.
        video: The GIF or MP4 file to write, where none is yet.
        episodes: Number of episodes, one after the other in one film.

    Returns:
        The return of each episode.

    Raises:
        FileExistsError: If there is such a file already.
        FileNotFoundError: If there is no checkpoint.
        ValueError: If the file is of another kind, ``episodes`` is less than 1, or a package that
            the pictures or the film need is missing.
    """
    if video.suffix not in _SUFFIXES:
        raise ValueError(f"a film is one of {', '.join(_SUFFIXES)}, not {video.name!r}")
    policy, env = recipe.load_player(run, render_mode="rgb_array")
    base = env.base_env  # transforms have no pictures
    try:
        with (
            whole_or_not_at_all(video) as hidden,
            # The writer goes by the name's ending, which the hidden name has not.
            TemporaryDirectory(prefix=".", dir=video.absolute().parent) as folder,
        ):
            reel = Path(folder, video.name)
            with _writer(reel, base.render_fps) as film:

                def filmed(tensordict: TensorDictBase) -> TensorDictBase:
                    film.append_data(base.render()[0])
                    return policy(tensordict)

                returns = evaluate(env, filmed, episodes, seed=recipe.evaluation_seed)
            reel.rename(hidden)
    except gymnasium.error.DependencyNotInstalled as error:
        raise ValueError(f"{run.folder} cannot be rendered: {error}") from error
    finally:
        env.close()
    return returns.tolist()


def _writer(video: Path, fps: int) -> Any:
    """Takes pictures one by one, so that a long film needs no memory."""
    if video.suffix == ".gif":
        return imageio.get_writer(video, format="GIF", mode="I", duration=1000 / fps, loop=0)
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ValueError("MP4 needs imageio-ffmpeg: pip install 'torchrl-tit[render]'; or use .gif")
    # The codec needs even sizes, not multiples of 16.
    return imageio.get_writer(video, format="FFMPEG", mode="I", fps=fps, macro_block_size=2)

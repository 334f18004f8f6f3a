"""The paper's claims about its pictures as numbers: ``python -m benchmarks.figure_claims RUN ...``.

The runs must be trained on images, with several seeds of each recipe; see docs/analysis.md.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from recipes.core.run import Run
from recipes.core.runner import load_trained
from recipes.tools.results.experiments import group_runs
from recipes.tools.results.interval import interval_of
from torchrl_tit.analysis import Target, grad_cam, outer_attention
from torchrl_tit.analysis.layers import image_layers
from torchrl_tit.analysis.targets import find_network, histories_of
from torchrl_tit.evaluation import evaluate

from .map_measures import Background, find_objects, map_change, share_on_objects
from .measuring import folder, publish, table

_BATCH = 32
_MAPS = {
    "share_on_objects": "share of the map on objects",
    "area_of_objects": "objects' share of the area",
    "change": "change to the next frame",
    "change_of_any": "change between any frames",
    "empty_maps": "empty maps",
}


@dataclass(frozen=True)
class FigureClaims:
    """What the paper reads from its pictures, measured on one run (arXiv 2212.14538, appendix)."""

    share_on_objects: float
    """Share of the newest frame's Grad-CAM map that lies on objects, mean over steps."""
    area_of_objects: float
    """The same share for a uniform map, mean over the same steps."""
    change: float
    """Share of the map that lies elsewhere in the next frame of the episode, mean over steps."""
    change_of_any: float
    """The same between random pairs of frames, mean: the change of a map that follows nothing."""
    empty_maps: float
    """Share of the steps whose map is 0 everywhere, which the other means leave out."""
    attention: list[float] | None
    """Attention of the newest step to each of the K steps, the oldest first: mean over steps,
    blocks and heads; None without attention over time, or with one frame."""


def measure_figure_claims(
    run: Run,
    *,
    steps: int = 500,
    background: Background = "place",
    target: Target = "action",
) -> FigureClaims:
    """Measures the paper's claims about its pictures on a trained run.

    The agent plays episodes with its most likely actions until there are enough steps. Objects are
    everything that differs from the background of these frames.

    Args:
        run: a run on a task whose observation, or one of them, is an image.
        steps: number of steps to look at.
        background: see :func:`~benchmarks.map_measures.find_objects`.
        target: what maps explain; see :data:`~torchrl_tit.analysis.targets.Target`.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        ValueError: if the network reads no image that Grad-CAM can map, or ``steps`` is less than
            2.
    """
    if steps < 2:
        raise ValueError(f"steps must be at least 2, not {steps}: change needs a next frame")
    _, algorithm, _ = load_trained(run)
    policy = algorithm.policy
    network = find_network(policy, target)
    image = next(iter(image_layers(network)), None)
    if image is None:
        raise ValueError(f"{run.folder}: its network reads no image that Grad-CAM can map")
    index = list(network.observations).index(image)
    states: list[TensorDictBase] = []
    numbers: list[int] = []
    with closing(algorithm.make_env(1)) as env:
        played = enumerate(play_episodes(env, policy, run.recipe.evaluation_seed))
        while len(states) < steps:
            number, (found, _) = next(played)
            states += found
            numbers += [number] * len(found)
    episode = torch.tensor(numbers[:steps])
    maps, frames, shares = [], [], []
    for start in range(0, steps, _BATCH):
        batch = torch.cat(states[start : min(start + _BATCH, steps)])
        histories = histories_of(policy, batch)
        maps.append(grad_cam(policy, batch, target=target)[image][:, -1])
        frames.append(histories[index][:, -1])
        with suppress(ValueError):  # no attention over time
            shares.append(outer_attention(network, *histories).mean((1, 2)))
    seen = torch.cat(maps).double()
    objects = find_objects(torch.cat(frames), background=background)
    on_objects, area = share_on_objects(seen, objects)
    mapped = seen.flatten(1).any(1)
    return FigureClaims(
        share_on_objects=float(on_objects[mapped].mean()),
        area_of_objects=float(area[mapped].mean()),
        change=float(map_change(seen)[episode.diff() == 0].nanmean()),
        change_of_any=float(map_change(seen[_shuffled(len(seen))]).nanmean()),
        empty_maps=float((~mapped).double().mean()),
        attention=_attention(shares, episode, network.num_frames),
    )


def to_markdown(groups: dict[str, list[FigureClaims]]) -> str:
    """Writes the measurements as Markdown: a table of maps, and one of attention over time."""
    rows = [
        [name, len(claims), *(interval_of([asdict(x)[field] for x in claims]) for field in _MAPS)]
        for name, claims in groups.items()
    ]
    text = table(["recipe", "runs", *_MAPS.values()], rows)
    attentive = [
        (name, [claim.attention for claim in claims if claim.attention is not None])
        for name, claims in groups.items()
    ]
    for count in sorted({len(shares) for _, found in attentive for shares in found}):
        rows = []
        for name, found in attentive:
            if shares := [one for one in found if len(one) == count]:
                rows.append([name, len(shares), *map(interval_of, zip(*shares, strict=True))])
        ages = [f"{step - count + 1} steps" for step in range(count - 1)]
        text += "\n" + table(["recipe", "runs", *ages, "newest"], rows)
    return text


def play_episodes(
    env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], seed: int
) -> Iterator[tuple[list[TensorDictBase], float]]:
    """Plays one episode after another with the most likely actions, seeded with ``seed + i``.

    Yields:
        What the policy read and wrote in each step, [1] each, and the return.
    """
    states: list[TensorDictBase] = []

    def acted(tensordict: TensorDictBase) -> TensorDictBase:
        outputs = policy(tensordict)
        states.append(outputs.clone())
        return outputs

    for number in itertools.count(seed):
        states.clear()
        outcome = evaluate(env, acted, 1, seed=number)
        yield [*states], outcome.item()


def _attention(shares: list[Tensor], episode: Tensor, num_frames: int) -> list[float] | None:
    """The mean attention to each of the K steps, of windows that lie within their episode."""
    if not shares or num_frames == 1:
        return None
    # Earlier windows are padded with the episode's first observation or zeros.
    within = torch.zeros(len(episode), dtype=torch.bool)
    within[num_frames - 1 :] = episode[num_frames - 1 :] == episode[: len(episode) - num_frames + 1]
    if not within.any():
        return None
    return torch.cat(shares)[within].double().mean(0).tolist()


def _shuffled(count: int) -> Tensor:
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))


def main(arguments: list[str] | None = None) -> None:
    """Measures runs, prints Markdown, and writes it and the numbers as JSON."""
    parser = argparse.ArgumentParser("python -m benchmarks.figure_claims")
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of trained runs")
    parser.add_argument("--steps", type=int, default=500, help="steps of each run to look at")
    parser.add_argument("--out", type=folder, help="folder for figure_claims.md and .json")
    options = parser.parse_args(arguments)
    try:
        groups: dict[str, list[FigureClaims]] = {
            one.label: [measure_figure_claims(run, steps=options.steps) for run in one.runs]
            for one in group_runs(Run.open(folder) for folder in options.runs)
        }
    except (ValueError, OSError, RuntimeError) as error:
        parser.error(" ".join(str(error).split()))
    found = {name: [asdict(claims) for claims in found] for name, found in groups.items()}
    command = f"python -m benchmarks.figure_claims RUN ... --steps {options.steps}"
    numbers = {"steps": options.steps, "runs": found}
    publish("figure_claims", to_markdown(groups), numbers, options.out, command)


if __name__ == "__main__":
    main()

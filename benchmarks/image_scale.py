"""How images must be scaled for a network to compare what it sees with what it saw earlier.

``python -m benchmarks.image_scale``: in MiniGrid-Memory S7 a script looks at the cue, walks to the
junction and looks at one of the two objects there. A network learns from these episodes,
supervised, whether that object is the cue. A row has the number of gradient steps until it is right
in 97% of the episodes that it was not trained on. The rows of a network and a seed differ only in
the scale of the pixels.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from minigrid.wrappers import ImgObsWrapper, RGBImgPartialObsWrapper
from torch import Tensor, nn
from torch.nn import functional as F

from recipes.presets.ppo_memory import memory_networks
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.layers.initialization import init_orthogonal_
from torchrl_tit.networks import HistoryNetwork, build_network
from torchrl_tit.settings import Flat, Network

from .measuring import add_missing_rows

COLUMNS = ["network", "pixels", "seed", "gradient_steps", "accuracy"]
NUM_FRAMES = 16
EPISODES, HELD_OUT, LIMIT = 5512, 512, 3000
"""The scripted episodes, those that are not trained on, and the gradient steps of a row."""
_SIZE, _TILE = 7, 8
_LEFT, _RIGHT, _FORWARD, _WAIT = 0, 1, 2, 6
_EAST, _NORTH = 0, 3


def _normalized(pictures: Tensor) -> Tensor:
    frames = NormalizedFrames(Flat().build(pictures.shape[1:]))
    frames.update(pictures)
    return frames.normalize(pictures)


PIXELS: dict[str, Callable[[Tensor], Tensor]] = {
    "0 to 1": lambda pictures: pictures,
    "0 to 4": lambda pictures: 4 * pictures,
    "-1 to 1": lambda pictures: 2 * pictures - 1,
    "without their mean": lambda pictures: pictures - pictures.mean(0),
    "normalised by pixel": _normalized,
}
"""The transforms of images [N, 3, H, W] from 0 to 1; the last is ``normalize_observations``."""


class Episodes:
    """Scripted episodes that end in front of an object.

    Args:
        count: number of episodes.
        seed: seed of the tasks and the script.
    """

    def __init__(self, count: int, seed: int = 0) -> None:
        task = gymnasium.make(f"MiniGrid-MemoryS{_SIZE}-v0", agent_view_size=3, max_steps=500)
        self._task = ImgObsWrapper(RGBImgPartialObsWrapper(task, tile_size=_TILE))
        self._rng = np.random.default_rng(seed)
        histories, matches = zip(*(self._episode() for _ in range(count)), strict=True)
        pictures, places = np.unique(np.concatenate(histories), axis=0, return_inverse=True)
        self.pictures = torch.tensor(pictures).permute(0, 3, 1, 2).float() / 255
        """The distinct images of all episodes, float [N, 3, H, W] from 0 to 1."""
        self.histories = torch.tensor(places).view(count, NUM_FRAMES)
        """The index of each image of an episode among these, int64 [E, K]."""
        self.matches = torch.tensor(matches, dtype=torch.float32)
        """Whether the object at the end is the cue, 0 or 1, [E]."""

    def _episode(self) -> tuple[np.ndarray, bool]:
        """The last K images of an episode, and whether the object at its end is the cue."""
        self._task.reset(seed=int(self._rng.integers(2**31)))
        maze: Any = self._task.unwrapped
        maze.agent_pos, maze.agent_dir = np.array((1, _SIZE // 2)), int(self._rng.integers(4))
        seen = [self._step(_WAIT)]
        seen += [self._step(int(turn)) for turn in self._rng.integers(2, size=3)]
        for direction in (_NORTH, _EAST):  # the cue is in the north
            while maze.agent_dir != direction:
                seen.append(self._step(_RIGHT))
        while maze.agent_pos[0] < _SIZE - 2:
            seen.append(self._step(_FORWARD))
        left = bool(self._rng.integers(2))
        seen.append(self._step(_LEFT if left else _RIGHT))
        cue = maze.grid.get(1, _SIZE // 2 - 1)
        target = maze.grid.get(_SIZE - 2, _SIZE // 2 + (-2 if left else 2))
        padding = [seen[0]] * (NUM_FRAMES - len(seen))
        return np.stack(padding + seen)[-NUM_FRAMES:], cue.type == target.type

    def _step(self, action: int) -> np.ndarray:
        return self._task.step(action)[0]


def gradient_steps(
    settings: Network,
    pixels: Callable[[Tensor], Tensor],
    episodes: Episodes,
    *,
    seed: int,
    limit: int = LIMIT,
    held_out: int = HELD_OUT,
) -> tuple[int, float]:
    """Trains a network; returns the number of gradient steps and the final accuracy."""
    torch.manual_seed(seed)
    pictures = pixels(episodes.pictures)
    network = build_network(replace(settings, num_frames=NUM_FRAMES), pictures.shape[1:])
    assert isinstance(network, HistoryNetwork)
    init_orthogonal_(network)
    head = nn.Linear(network.features_dim, 1)
    optimizer = torch.optim.Adam([*network.parameters(), *head.parameters()], lr=3e-4)
    train = len(episodes.matches) - held_out
    accuracy = 0.0

    def logits(chosen: Tensor) -> Tensor:
        tokens = network.frames[0](pictures)  # each image is encoded once
        return head(network.encode_history(tokens[episodes.histories[chosen]])).squeeze(-1)

    for step in range(1, limit + 1):
        chosen = torch.randint(train, (64,))
        loss = F.binary_cross_entropy_with_logits(logits(chosen), episodes.matches[chosen])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 50 == 0 or step == limit:
            others = torch.arange(train, train + held_out)
            with torch.no_grad():
                right = (logits(others) > 0) == episodes.matches[others].bool()
            accuracy = right.float().mean().item()
            if accuracy >= 0.97:
                break
    return step, accuracy


def main(arguments: list[str] | None = None) -> None:
    """Trains every network with every scale, and writes a row for each."""
    parser = argparse.ArgumentParser("python -m benchmarks.image_scale")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--out", type=Path, required=True, help="CSV that rows are added to")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    episodes = Episodes(EPISODES)
    networks = memory_networks(NUM_FRAMES, patch_size=_TILE)

    def measure(name: str, scale: str, seed: int) -> list[object]:
        steps, accuracy = gradient_steps(networks[name], PIXELS[scale], episodes, seed=seed)
        return [name, scale, seed, steps, round(accuracy, 3)]

    runs = product(("lstm", "gtrxl", "enhanced-tit"), PIXELS, options.seeds)
    add_missing_rows(options.out, COLUMNS, runs, measure)


if __name__ == "__main__":
    main()

"""Peak memory of PPO on images, from K = 4 to 64: frames kept once, compared with histories.

Eight environments with random 84 x 84 images, 2,048 steps per batch, a linear frame encoder with an
outer transformer. Each program runs in its own process, at the present commit and at the last one
whose rollouts held histories. The peak is that of resident memory, in MB: once the networks are
built, and after a batch is collected and trained on.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from .earlier import CLONE, COMMIT, earlier_tree
from .report import publish, table

FRAMES = (4, 16, 64)

_COMMON = """
import json, resource, sys, tempfile
from pathlib import Path
import gymnasium, numpy as np, torch
from recipes.ppo import PPO

torch.set_num_threads(1)


class Images(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 255, (84, 84), np.uint8)
    action_space = gymnasium.spaces.Discrete(3)

    def image(self):
        return self.np_random.integers(0, 256, (84, 84), np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.image(), {}

    def step(self, action):
        return self.image(), float(action), bool(self.np_random.random() < 0.01), False, {}


def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


gymnasium.register("Images-v0", Images)
frames = int(sys.argv[1])
settings = dict(
    env="Images-v0",
    num_envs=8,
    total_steps=2048,
    steps_per_batch=2048,
    minibatch_size=64,
    epochs=1,
    compile="off",
    checkpoint_interval=10**9,
)
sizes = dict(inner=False, embed_dim=16, features_dim=16)
"""

_EARLIER = """
from recipes.ppo.agent import Agent
from recipes.ppo.collector import make_collector
from recipes.ppo.training import PPOUpdate
from torchrl_tit.modules import while_acting
from torchrl_tit.networks import EnhancedTITConfig

recipe = PPO(**settings, history=frames, backbone=EnhancedTITConfig(**sizes, patch_size=84))
env = recipe.make_env(8, 0, vectorization_mode="sync")
agent = Agent(recipe, env).eval()
built = peak()
update = PPOUpdate(recipe, agent, None)
collector = make_collector(recipe, env, agent, 0, None)
update(next(iter(while_acting(agent.policy, collector))), 2048, 0)
"""

_PRESENT = """
from recipes.ppo.algorithm import PPOAlgorithm
from torchrl_tit.settings.networks import enhanced_tit

algorithm = PPOAlgorithm(PPO(**settings, backbone=enhanced_tit(frames, **sizes)))
built = peak()
algorithm.prepare(0, Path(tempfile.mkdtemp()))
algorithm.update(next(iter(algorithm.batches())), 0)
"""

_REPORT = """
print("peak", json.dumps([built, peak()]), flush=True)
"""


def peaks(tree: Path, program: str, num_frames: int) -> tuple[float, float]:
    """Returns the peak memory in MB once the networks are built, and at the end."""
    result = subprocess.run(
        [sys.executable, "-c", _COMMON + program + _REPORT, str(num_frames)],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree)},
        check=True,
        capture_output=True,
        text=True,
    )
    (line,) = (line for line in result.stdout.splitlines() if line.startswith("peak "))
    built, end = json.loads(line.removeprefix("peak "))
    return built, end


def main(out: Path | None) -> None:
    """Measures each number of frames in both trees, and reports."""
    rows: list[list[str]] = []
    numbers: dict[str, Any] = {}
    with earlier_tree() as tree:
        for num_frames in FRAMES:
            before = peaks(tree, _EARLIER, num_frames)
            now = peaks(CLONE, _PRESENT, num_frames)
            cells = [f"{value:.0f}" for pair in (before, now) for value in pair]
            rows.append([str(num_frames), *cells, f"{before[1] - before[0]:.0f}"])
            rows[-1].append(f"{now[1] - now[0]:.0f}")
            numbers[f"K = {num_frames}"] = {"earlier": before, "now": now}
    markdown = (
        "# Memory of a PPO batch of images\n\nPeak resident memory in MB of a process that "
        "collects 2,048 steps of 84 x 84 images and trains on them.\n\n"
        + table(
            [
                "K",
                f"commit {COMMIT}: networks built",
                "at the end",
                "now: networks built",
                "at the end",
                f"added at {COMMIT}",
                "added now",
            ],
            rows,
        )
    )
    publish("rollouts", markdown, numbers, out)

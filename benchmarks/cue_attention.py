"""Attention of agents to a cue when they decide: ``python -m benchmarks.cue_attention RUN ...``.

The runs must be trained on MiniGrid-Memory, such as ppo/memory-s7/enhanced-tit, or on a task whose
first observation is the cue, such as ppo/tmaze-10/enhanced-tit.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from statistics import mean

import numpy as np
from gymnasium.vector import SyncVectorEnv
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv

from recipes.core.run import Run
from recipes.core.runner import load_trained
from recipes.tools.results.plot import new_figure, save_figure
from torchrl_tit.analysis import outer_attention
from torchrl_tit.analysis.targets import find_network, histories_of

from .figure_claims import play_episodes
from .measuring import folder, publish, table


@dataclass(frozen=True)
class Decision:
    """The last step of an episode, at which the agent decides."""

    right: bool
    """Whether the episode's return is positive."""
    attention: list[list[float]]
    """Attention of each outer block to each of the K frames, the oldest first; mean over heads."""
    cue: list[bool]
    """Which of the K frames show the cue."""

    @property
    def shares(self) -> list[float]:
        """Attention of each outer block to the frames that show the cue."""
        return [float(np.array(block)[self.cue].sum()) for block in self.attention]

    @property
    def even(self) -> float:
        """These frames' share of all K."""
        return sum(self.cue) / len(self.cue)


def measure_decisions(run: Run, *, episodes: int = 100) -> list[Decision]:
    """Plays episodes and measures what the agent reads of the cue in their last step.

    In MiniGrid-Memory the cue is the object in the room where the agent starts, whenever it is in
    view; in other tasks it is the first observation. The frames before an episode's first
    observation are copies of it, and show what it shows.

    Args:
        run: a run on MiniGrid-Memory, or on a task whose first observation is the cue, such as
            TMaze-v0.
        episodes: number of episodes.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        ValueError: if ``episodes`` is less than 1, the network has no attention over time, or
            histories begin with zeros.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, not {episodes}")
    _, algorithm, _ = load_trained(run)
    if getattr(run.recipe, "padding", "same") != "same":
        raise ValueError(f"{run.folder}: histories begin with zeros, not with the cue")
    policy = algorithm.policy
    network = find_network(policy)
    found = []
    shown: list[bool] = []
    with closing(algorithm.make_env(1)) as env:
        shows_cue = _cue_of(run.recipe.env, env)

        def watched(tensordict: TensorDictBase) -> TensorDictBase:
            shown.append(shows_cue(len(shown)))
            return policy(tensordict)

        played = play_episodes(env, watched, run.recipe.evaluation_seed)
        for states, outcome in islice(played, episodes):
            attention = outer_attention(network, *histories_of(policy, states[-1]))
            copies = max(network.num_frames - len(shown), 0)
            cue = [shown[0]] * copies + shown[-network.num_frames :]
            found.append(Decision(outcome > 0, attention[0].mean(1).tolist(), cue))
            shown.clear()
    return found


def to_markdown(groups: dict[str, list[Decision]]) -> str:
    """Writes a table of means: a row each for the right and the wrong decisions of a run."""
    rows = []
    for name, decisions in groups.items():
        for right, word in ((True, "right"), (False, "wrong")):
            if chosen := [decision for decision in decisions if decision.right == right]:
                blocks = zip(*(decision.shares for decision in chosen), strict=True)
                each = ", ".join(f"{mean(shares):.2f}" for shares in blocks)
                most = mean(max(decision.shares) for decision in chosen)
                even = mean(decision.even for decision in chosen)
                rows.append([name, word, len(chosen), each, f"{most:.2f}", f"{even:.2f}"])
    header = ["run", "decisions", "episodes", "each block reads of the cue"]
    return table([*header, "the block that reads most of it", "an even share"], rows)


def plot_decisions(groups: dict[str, list[Decision]]) -> Figure:
    """Draws a panel for each run: a row an episode, a column a frame, dots on those with the cue.

    Attention is that of the block that reads most of the cue. Wrong decisions are the rows below
    the line.
    """
    figure = new_figure((7.5, 3.6 * len(groups)))
    panels = figure.subplots(len(groups), squeeze=False)[:, 0]
    for axes, (name, decisions) in zip(panels, groups.items(), strict=True):
        rows = sorted(decisions, key=lambda decision: (not decision.right, decision.cue[::-1]))
        read = np.array([row.attention[int(np.argmax(row.shares))] for row in rows])
        num_frames = read.shape[1]
        cue = np.array([row.cue for row in rows])
        extent = (0.5 - num_frames, 0.5, len(rows), 0)
        image = axes.imshow(read, cmap="viridis", vmin=0, vmax=1, aspect="auto", extent=extent)
        episode, frame = cue.nonzero()
        axes.scatter(frame - num_frames + 1, episode + 0.5, s=2, c="C3")
        right = sum(row.right for row in rows)
        if 0 < right < len(rows):
            axes.axhline(right, c="white", lw=1)
        axes.set(title=name, xlabel="step, 0 is the decision", ylabel="episode")
        figure.colorbar(image, ax=axes, label="attention")
    return figure


def _cue_of(name: str, env: EnvBase) -> Callable[[int], bool]:
    """Returns what says, given the number of steps, whether the observation shows the cue."""
    if not name.startswith("MiniGrid-Memory"):
        return lambda steps: steps == 0
    while isinstance(env, TransformedEnv):
        env = env.base_env
    tasks: SyncVectorEnv = env._env

    def in_view(_: int) -> bool:
        [height] = tasks.get_attr("height")
        [seen] = tasks.call("agent_sees", 1, height // 2 - 1)
        return bool(seen)

    return in_view


def main(arguments: list[str] | None = None) -> None:
    """Measures runs, prints Markdown, and writes it, the numbers as JSON, and a picture."""
    parser = argparse.ArgumentParser("python -m benchmarks.cue_attention")
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of trained runs")
    parser.add_argument("--episodes", type=int, default=100, help="episodes of each run")
    parser.add_argument("--out", type=folder, help="folder for cue_attention.md, .json and .png")
    options = parser.parse_args(arguments)
    try:
        groups: dict[str, list[Decision]] = {}
        for run in map(Run.open, options.runs):
            name = f"{run.recipe.name}, seed {run.recipe.seed}"
            name += f" ({run.folder})" if name in groups else ""
            groups[name] = measure_decisions(run, episodes=options.episodes)
    except (ValueError, OSError, RuntimeError) as error:
        parser.error(" ".join(str(error).split()))
    numbers = {
        name: [{"right": one.right, "shares": one.shares, "even": one.even} for one in found]
        for name, found in groups.items()
    }
    command = f"python -m benchmarks.cue_attention RUN ... --episodes {options.episodes}"
    publish("cue_attention", to_markdown(groups), {"runs": numbers}, options.out, command)
    if options.out is not None:
        save_figure(plot_decisions(groups), options.out / "cue_attention.png")


if __name__ == "__main__":
    main()

"""How much attention a trained agent pays to the observation that tells it what to do."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from statistics import mean

from tensordict import TensorDictBase

from torchrl_tit.analysis import outer_attention
from torchrl_tit.analysis.targets import find_network, histories_of
from torchrl_tit.evaluation import evaluate

from ..run import Run
from ..runner import load_trained


@dataclass(frozen=True)
class Decision:
    """The last step of an episode, at which the agent decides."""

    right: bool
    """Whether the episode's return is positive."""
    shares: list[float]
    """Attention of each outer block to the frames that show the cue, mean over heads."""
    even: float
    """These frames' share of all K."""


def measure_decisions(run: Run, *, episodes: int = 100, seed: int | None = None) -> list[Decision]:
    """Plays episodes whose first observation is the cue, and measures attention in their last step.

    The frames before an episode's first observation are copies of it, and count as the cue.

    Args:
        run: a run on a task whose first observation is the cue, such as TMaze-v0.
        episodes: number of episodes.
        seed: seed of the first episode; by default the evaluation's.

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
    first = run.recipe.evaluation_seed if seed is None else seed
    found = []
    with closing(algorithm.make_env(1)) as env:
        for number in range(episodes):
            states: list[TensorDictBase] = []

            def acted(
                tensordict: TensorDictBase, states: list[TensorDictBase] = states
            ) -> TensorDictBase:
                outputs = policy(tensordict)
                states.append(outputs.clone())
                return outputs

            outcome = evaluate(env, acted, 1, seed=first + number)
            attention = outer_attention(network, *histories_of(policy, states[-1]))
            read = attention[0].mean(1)  # [blocks, K]
            cue = max(network.num_frames - len(states) + 1, 0)  # the first of the K frames
            shares = read[:, :cue].sum(-1).tolist()
            found.append(Decision(outcome.item() > 0, shares, cue / network.num_frames))
    return found


def to_markdown(groups: dict[str, list[Decision]]) -> str:
    """Writes a table of means: a row each for the right and the wrong decisions of a run."""
    lines = [
        "| run | decisions | episodes | each block reads of the cue "
        "| the block that reads most of it | an even share |",
        "|---|---|---|---|---|---|",
    ]
    for name, decisions in groups.items():
        for right, word in ((True, "right"), (False, "wrong")):
            chosen = [decision for decision in decisions if decision.right == right]
            if not chosen:
                continue
            blocks = zip(*(decision.shares for decision in chosen), strict=True)
            cells = [
                ", ".join(f"{mean(shares):.2f}" for shares in blocks),
                f"{mean(max(decision.shares) for decision in chosen):.2f}",
                f"{mean(decision.even for decision in chosen):.2f}",
            ]
            lines.append(f"| {name} | {word} | {len(chosen)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"

"""`export`: writes a trained agent to a file that runs without this package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl_tit.settings.literals import parse_assignments

from .arguments import Parser, program, say


def export(arguments: list[str]) -> None:
    """Exports an agent's policy as a PyTorch or ONNX program."""
    parser = Parser(
        f"{program()} export",
        description="Write an agent's policy, with its normalisation, to a file that acts without "
        "torchrl-tit and TorchRL, and check it against the agent on 100 observations.",
    )
    parser.add_argument(
        "agent",
        metavar="AGENT",
        help="run folder, or what `play` takes: name, folder of an agent, hf:user/name",
    )
    parser.add_argument("--out", type=Path, required=True, help="new file: .pt2 or .onnx")
    parser.add_argument(
        "--format",
        choices=["pt2", "onnx"],
        help="torch.export's program or ONNX; default: as FILE ends",
    )
    parser.add_argument(
        "--step-by-step",
        action="store_true",
        help="read one observation and the tokens of those before it, so that each is encoded "
        "once, instead of the last K observations",
    )
    parser.add_argument(
        "--sample",
        action="store_true",
        help="draw actions, from noise that is an input, instead of taking the most likely",
    )
    options = parser.parse_args(arguments)
    from torchrl_tit import load_agent  # not at the top: help needs no PyTorch
    from torchrl_tit.export import export_policy
    from torchrl_tit.export.formats import find_format

    find_format(options.out, options.format).check_installed()  # before an agent is loaded
    agent = load_agent(options.agent)
    facts = export_policy(
        agent.policy,
        agent.make_env,
        options.out,
        format=options.format,
        step_by_step=options.step_by_step,
        sample=options.sample,
        facts=_facts(agent.recipe, agent.steps),
    )
    say(
        f"{agent.name}: {', '.join(facts['inputs'])} -> {', '.join(facts['outputs'])}; differs by "
        f"{facts['difference']:.0e} at most\nwritten to {options.out}"
    )


def _facts(recipe: Any, steps: int) -> dict[str, Any]:
    """Further facts about an agent: its task, as `gymnasium.make` takes it, and its origin."""
    return {
        "task": {"id": recipe["env"], **parse_assignments(recipe["env_settings"])},
        "wrappers": list(recipe["wrappers"]),
        "recipe": recipe["name"],
        "steps": steps,
    }

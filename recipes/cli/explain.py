"""`explain`: what a trained agent looks at."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .arguments import Parser, check_seed, fail, program, say

_MAPS = ("grad-cam", "integrated-gradients", "attention")


def explain(arguments: list[str]) -> None:
    """Films what a trained agent looks at, or draws one step of it."""
    parser = Parser(f"{program()} explain")
    parser.add_argument(
        "agent",
        metavar="AGENT",
        help="run folder, or what `play` takes: name, folder of an agent, hf:user/name",
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="new file: a film (.gif, .mp4) or a picture (.png)"
    )
    parser.add_argument("--seed", type=int, help="seed of the episode; default: the evaluation's")
    parser.add_argument("--dataset", help="data set whose recorded episode is shown to the agent")
    parser.add_argument("--episode", type=int, help="of the data: which one; default: 0, the first")
    parser.add_argument("--step", type=int, help="of a picture: which step; default: 0, the first")
    parser.add_argument("--max-steps", type=int, help="of a film: stop after so many steps")
    parser.add_argument(
        "--target",
        choices=["action", "value"],
        default="action",
        help="what is explained: the chosen action, or the value; default: action",
    )
    parser.add_argument(
        "--map",
        choices=_MAPS,
        help="how; default: grad-cam of images, integrated-gradients of arrays",
    )
    parser.add_argument(
        "--layer", help="layer of grad-cam; default: the last that is laid out over the image"
    )
    options = parser.parse_args(arguments)
    check_seed(options.seed)
    if options.dataset is None and options.episode is not None:
        fail("--episode is one of a data set: name it with --dataset FILE")
    if options.dataset is not None and options.seed is not None:
        fail("--seed is that of an episode that is played: leave it out with --dataset")
    import torch  # not at the top: help needs no PyTorch

    from torchrl_tit import load_agent
    from torchrl_tit.agents.acting import make_given_env
    from torchrl_tit.datasets import load_episodes

    from ..tools.results.explanation import check_explanation, explain_policy
    from ..tools.results.recorded import Recording

    check_explanation(options.out, options.step, options.max_steps)
    agent = load_agent(options.agent)
    torch.set_num_threads(agent.recipe["threads"])
    seed = agent.first_seed if options.seed is None else options.seed
    make_env: Any = agent.make_env
    actions, which = None, f"the episode of seed {seed}"
    if options.dataset is not None:
        own = {k: agent.recipe[k] for k in ("max_episode_steps", "gaps") if k in agent.recipe}
        episodes = load_episodes(options.dataset, **own)
        recording = Recording(episodes, options.episode or 0)
        actions, which = recording.actions, f"episode {options.episode or 0} of {options.dataset}"

        def make_env(copies: int, **settings: Any) -> Any:
            return make_given_env(agent.make_env, recording, copies)

    shown = explain_policy(
        make_env,
        agent.policy,
        agent.name,
        options.out,
        seed=seed,
        step=options.step,
        max_steps=options.max_steps,
        title=agent.recipe["name"],
        target=options.target,
        kind=options.map,
        layer=options.layer,
        actions=actions,
    )
    steps = f"{shown} steps" if shown > 1 else "1 step"
    say(f"{steps} of {which}\nwritten to {options.out}")

"""`play`, `explain`, `export`, `share`: what is done with a trained agent."""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from torchrl_tit.settings.checks import checked
from torchrl_tit.settings.literals import parse_assignments
from torchrl_tit.settings.numbers import Episodes, Seed, Steps, StepsOrNone, Threads

from ..core.numbers import number, plus_minus
from .arguments import Parser, add_agent, add_best, check_numbers, fail, say

_EPISODES = 10
_MAPS = ("grad-cam", "integrated-gradients", "attention", "weights")


def play(arguments: list[str]) -> None:
    """Lets a trained agent play, or lists the agents that come with this package."""
    parser = Parser(
        "play",
        "Let a trained agent play whole episodes; without AGENT, list those that come with "
        "torchrl-tit.",
    )
    add_agent(parser, nargs="?")
    parser.add_argument("--episodes", type=int, help=f"default: {_EPISODES}, or 1 in a film")
    parser.add_argument("--seed", type=int, help="seed of the first; default: the evaluation's")
    parser.add_argument("--out", type=Path, help="film them: a new file, .gif or .mp4")
    parser.add_argument("--device", default="cpu", help="such as cuda:1, or auto; default: cpu")
    parser.add_argument("--threads", type=int, default=1, help="default: 1")
    options = parser.parse_args(arguments)
    check_numbers(options, episodes=Episodes, seed=Seed, threads=Threads)
    if options.agent is None:
        _list()
        return
    import torch  # not at the top: help needs no PyTorch

    from torchrl_tit import load_agent

    from ..tools.results.film import check_film, film_policy

    if options.out is not None:
        check_film(options.out)
    torch.set_num_threads(options.threads)
    agent = load_agent(options.agent, device=options.device, best=options.best)
    if options.out is None:
        returns = agent.evaluate(options.episodes or _EPISODES, seed=options.seed)
    else:
        seed = agent.first_seed if options.seed is None else options.seed
        episodes = options.episodes or 1
        played = film_policy(agent.make_env, agent.policy, agent.name, options.out, episodes, seed)
        returns = torch.tensor(played, dtype=torch.float64)
    known = agent.evaluation
    before = (
        f"; its evaluation: {plus_minus(known['mean'], known['std'])} over {known['episodes']}"
        if known
        else ""
    )
    mean, spread = returns.mean().item(), returns.std(correction=0).item()
    now = plus_minus(mean, spread) if len(returns) > 1 else number(mean)
    say(
        f"{agent.name}: return {now} over "
        f"{len(returns)} episode{'s' * (len(returns) > 1)} of {agent.recipe['env']}{before}"
    )
    if options.out is not None:
        say(f"written to {options.out}")


def _list() -> None:
    from torchrl_tit.agents import agent_names
    from torchrl_tit.agents.folder import read_agent
    from torchrl_tit.agents.loading import find_agent

    names = agent_names()
    if not names:
        fail("no agents come with this copy of torchrl-tit: name a folder or hf:user/name")
    for name in names:
        evaluation = read_agent(find_agent(name)).evaluation
        returned = plus_minus(evaluation["mean"], evaluation["std"])
        say(
            f"{name}: {evaluation['env']}, return {returned} over {evaluation['episodes']} episodes"
        )


def explain(arguments: list[str]) -> None:
    """Films what a trained agent looks at, or draws steps of one or several agents."""
    parser = Parser(
        "explain",
        "Film what a trained agent looks at, or draw steps of it. Several agents, which read "
        "images, are drawn side by side while the first one plays.",
    )
    add_agent(parser, nargs="+")
    parser.add_argument(
        "--out", type=Path, required=True, help="new file: a film (.gif, .mp4) or a picture (.png)"
    )
    parser.add_argument("--seed", type=int, help="seed of the episode; default: the evaluation's")
    parser.add_argument("--dataset", help="data set whose recorded episode is shown to the agent")
    parser.add_argument("--episode", type=int, help="of the data: which one; default: 0, the first")
    parser.add_argument(
        "--step",
        type=int,
        nargs="+",
        help="of a picture: which step; default: 0, the first. Several are rows of one picture",
    )
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
        help="how; default: grad-cam of images, integrated-gradients of arrays. weights: a grid of "
        "the weights of all inner and outer blocks in one step",
    )
    parser.add_argument(
        "--layer", help="layer of grad-cam; default: the last that is laid out over the image"
    )
    options = parser.parse_args(arguments)
    check_numbers(options, seed=Seed, max_steps=Steps)
    for step in options.step or ():
        checked("--step", step, StepsOrNone)
    if options.dataset is None and options.episode is not None:
        fail("--episode is one of a data set: name it with --dataset FILE")
    if options.dataset is not None and options.seed is not None:
        fail("--seed is that of an episode that is played: leave it out with --dataset")
    import torch  # not at the top: help needs no PyTorch

    from torchrl_tit import load_agent

    from ..tools.results.explanation import check_explanation, explain_policy

    steps = options.step or [None]
    check_explanation(options.out, steps[0], options.max_steps)
    agents = [load_agent(name, best=options.best) for name in options.agent]
    agent = agents[0]
    torch.set_num_threads(agent.recipe["threads"])
    seed = agent.first_seed if options.seed is None else options.seed
    if options.map == "weights" or len(agents) > 1 or len(steps) > 1:
        if options.dataset is not None:
            fail("--dataset shows its episode to one agent, in one step or a film: leave it out")
        _draw_figure(agents, steps if options.step else [0], seed, options)
        return
    make_env: Any = agent.make_env
    actions, which = None, f"the episode of seed {seed}"
    if options.dataset is not None:
        from torchrl_tit.agents.acting import make_given_env

        from ..core.recipe import DatasetRecipe
        from ..core.recipe_json import recipe_from_json
        from ..offline import load_data, read_data
        from ..tools.results.recorded import Recording

        recipe = recipe_from_json(json.dumps(agent.recipe), agent.name)
        if getattr(recipe, "mask_actions", False):
            fail(f"{agent.name} reads which actions are allowed, which data do not say")
        if isinstance(recipe, DatasetRecipe):
            episodes = read_data(replace(recipe, dataset=options.dataset))
        else:
            episodes = load_data(recipe, options.dataset)
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
        step=steps[0],
        max_steps=options.max_steps,
        title=agent.recipe["name"],
        target=options.target,
        kind=options.map,
        layer=options.layer,
        actions=actions,
    )
    count = f"{shown} steps" if shown > 1 else "1 step"
    say(f"{count} of {which}\nwritten to {options.out}")


def _draw_figure(agents: list[Any], steps: list[int], seed: int, options: Namespace) -> None:
    """Draws one of the paper's figures of attention."""
    from ..tools.results.paper_figures import compare_maps, draw_weights

    if options.out.suffix != ".png":
        fail(f"several agents or steps, and weights, are a picture (.png), not {options.out.name}")
    if options.map != "weights":
        compare_maps(
            agents,
            options.out,
            steps=steps,
            seed=seed,
            target=options.target,
            kind=options.map,
            layer=options.layer,
        )
    elif len(agents) > 1 or len(steps) > 1 or options.layer:
        fail("--map weights draws one step of one agent: leave the other agents and steps out")
    else:
        draw_weights(agents[0], options.out, step=steps[0], seed=seed, target=options.target)
    say(f"written to {options.out}")


def export(arguments: list[str]) -> None:
    """Exports an agent's policy as a PyTorch or ONNX program."""
    parser = Parser(
        "export",
        "Write an agent's policy, with its normalization, to a file that acts without torchrl-tit "
        "and TorchRL, and check it against the agent on 100 observations.",
    )
    add_agent(parser)
    parser.add_argument(
        "--out", type=Path, required=True, help="new file: .pt2 (torch.export) or .onnx"
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

    find_format(options.out).check_installed()  # before an agent is loaded
    agent = load_agent(options.agent, best=options.best)
    recipe: Any = agent.recipe
    facts = export_policy(
        agent.policy,
        agent.make_env,
        options.out,
        step_by_step=options.step_by_step,
        sample=options.sample,
        facts={
            "task": {"id": recipe["env"], **parse_assignments(recipe["env_settings"])},
            "wrappers": list(recipe["wrappers"]),
            "recipe": recipe["name"],
            "steps": agent.steps,
        },
    )
    say(
        f"{agent.name}: {', '.join(facts['inputs'])} -> {', '.join(facts['outputs'])}; differs by "
        f"{facts['difference']:.0e} at most\nwritten to {options.out}"
    )


def share(arguments: list[str]) -> None:
    """Turns a run into an agent, in a folder or on the Hugging Face Hub."""
    parser = Parser(
        "share",
        "Make an agent of a run: its weights, recipe, evaluation, versions and a model card. "
        "Upload it to the Hugging Face Hub, write it to a folder, or both.",
    )
    parser.add_argument("run", metavar="RUN", help="run folder that is evaluated, or an agent")
    parser.add_argument("repository", nargs="?", metavar="REPO", help="user/name on the Hub")
    add_best(parser)
    parser.add_argument("--out", type=Path, help="folder to make for the agent")
    parser.add_argument("--name", help="name on the card; default: that of REPO or of the folder")
    parser.add_argument("--license", help="license on the card, such as mit; default: none")
    parser.add_argument("--private", action="store_true", help="make a new REPO private")
    options = parser.parse_args(arguments)
    if options.repository is None and options.out is None:
        fail("share needs REPO, such as me/cartpole, or --out FOLDER")
    if options.private and options.repository is None:
        fail("--private is for REPO on the Hub: name it, such as me/cartpole")
    # Not at the top: help needs no PyTorch.
    from torchrl_tit.agents.folder import is_agent, write_agent
    from torchrl_tit.agents.hub import PREFIX, check_repository
    from torchrl_tit.agents.loading import find_agent

    repository, found = options.repository, find_agent(options.run)
    if repository is not None:
        check_repository(repository)
    if is_agent(found):
        others = (options.out, options.name, options.license, options.best or None)
        if repository is None or any(other is not None for other in others):
            fail(f"{options.run} is an agent already: share it as REPO, without other options")
        _upload(found, repository, options.private)
        return
    from ..tools.agents import pack

    source = f"{PREFIX}{repository}" if repository is not None else options.out.name
    name = options.name or source.rpartition("/")[2]
    files, steps = pack(found, name, source=source, license=options.license, best=options.best)
    with TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary, name)
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_agent(folder, files, steps)
        if options.out is not None:
            size = sum(map(len, files.values()))
            say(f"written to {folder}: {size / 1e6:.2f} MB")
        if repository is not None:
            _upload(folder, repository, options.private)


def _upload(folder: Path, repository: str, private: bool) -> None:
    from torchrl_tit.agents.folder import read_agent
    from torchrl_tit.agents.hub import PREFIX, upload

    read_agent(folder)  # only complete, unmodified agents are uploaded
    address = upload(folder, repository, private=private)
    say(f"uploaded to {address}\nload_agent({PREFIX + repository!r}) loads it")

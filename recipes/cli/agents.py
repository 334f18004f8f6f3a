"""`play` and `share`: let trained agents act, and turn runs into agents that others can load."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from .arguments import Parser, check_seed, fail, program, say

_EPISODES = 10
_MOST = 1_000_000


def play(arguments: list[str]) -> None:
    """Lets a trained agent play, or lists the agents that come with this package."""
    parser = Parser(
        f"{program()} play",
        description="Let a trained agent play whole episodes; without AGENT, list those that come "
        "with torchrl-tit.",
    )
    parser.add_argument(
        "agent",
        nargs="?",
        metavar="AGENT",
        help="name, folder of an agent or of a run, or hf:user/name on the Hugging Face Hub",
    )
    parser.add_argument("--episodes", type=int, help=f"default: {_EPISODES}, or 1 in a film")
    parser.add_argument("--seed", type=int, help="seed of the first; default: the evaluation's")
    parser.add_argument("--out", type=Path, help="film them: a new file, .gif or .mp4")
    parser.add_argument("--device", choices=["cpu", "cuda", "auto"], default="cpu")
    parser.add_argument("--threads", type=int, default=1, help="default: 1")
    options = parser.parse_args(arguments)
    for name in ("episodes", "threads"):
        if (value := getattr(options, name)) is not None and value < 1:
            fail(f"--{name} must be at least 1, not {value}")
        if value is not None and value > _MOST:
            fail(f"--{name} must be at most {_MOST}, not {value}")
    check_seed(options.seed)
    if options.agent is None:
        _list()
        return
    import torch  # not at the top: help needs no PyTorch

    from torchrl_tit import load_agent

    from ..tools.results.film import check_film, film_policy

    if options.out is not None:
        check_film(options.out)
    torch.set_num_threads(options.threads)
    agent = load_agent(options.agent, device=options.device)
    if options.out is None:
        returns = agent.evaluate(options.episodes or _EPISODES, seed=options.seed)
    else:
        seed = agent.first_seed if options.seed is None else options.seed
        episodes = options.episodes or 1
        played = film_policy(agent.make_env, agent.policy, agent.name, options.out, episodes, seed)
        returns = torch.tensor(played, dtype=torch.float64)
    known = agent.evaluation
    before = (
        f"; its evaluation: {known['mean']:.1f} ± {known['std']:.1f} over {known['episodes']}"
        if known
        else ""
    )
    say(
        f"{agent.name}: return {returns.mean():.1f} ± {returns.std(correction=0):.1f} over "
        f"{len(returns)} episode{'s' * (len(returns) > 1)} of {agent.recipe['env']}{before}"
    )
    if options.out is not None:
        say(f"written to {options.out}")


def share(arguments: list[str]) -> None:
    """Turns a run into an agent, in a folder or on the Hugging Face Hub."""
    parser = Parser(
        f"{program()} share",
        description="Make an agent of a run: its weights, recipe, evaluation, versions and a model "
        "card. Upload it to the Hugging Face Hub, write it to a folder, or both.",
    )
    parser.add_argument("run", metavar="RUN", help="run folder that is evaluated, or an agent")
    parser.add_argument("repository", nargs="?", metavar="REPO", help="user/name on the Hub")
    parser.add_argument("--out", type=Path, help="folder to make for the agent")
    parser.add_argument("--name", help="name on the card; default: that of REPO or of the folder")
    parser.add_argument("--license", help="licence on the card, such as mit; default: none")
    parser.add_argument("--private", action="store_true", help="make a new REPO private")
    options = parser.parse_args(arguments)
    if options.repository is None and options.out is None:
        fail("share needs REPO, such as me/cartpole, or --out FOLDER")
    # Not at the top: help needs no PyTorch.
    from torchrl_tit.agents.folder import is_agent, write_agent
    from torchrl_tit.agents.hub import PREFIX, check_repository
    from torchrl_tit.agents.loading import find_agent

    repository, found = options.repository, find_agent(options.run)
    if repository is not None:
        check_repository(repository)
    if is_agent(found):
        if repository is None or (options.out, options.name, options.license) != (None, None, None):
            fail(f"{options.run} is an agent already: share it as REPO, without other options")
        _upload(found, repository, options.private)
        return
    from ..tools.agents import pack

    source = f"{PREFIX}{repository}" if repository is not None else options.out.name
    name = options.name or source.rpartition("/")[2]
    files, steps = pack(found, name, source=source, license=options.license)
    with TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary, name)
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


def _list() -> None:
    from torchrl_tit.agents import agent_names
    from torchrl_tit.agents.folder import read_agent
    from torchrl_tit.agents.loading import find_agent

    names = agent_names()
    if not names:
        fail("no agents come with this copy of torchrl-tit: name a folder or hf:user/name")
    for name in names:
        evaluation = read_agent(find_agent(name)).evaluation
        say(
            f"{name}: {evaluation['env']}, return {evaluation['mean']:.1f} ± "
            f"{evaluation['std']:.1f} over {evaluation['episodes']} episodes"
        )

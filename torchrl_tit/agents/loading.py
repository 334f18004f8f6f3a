"""Trained agents by name, from a folder, or from the Hugging Face Hub."""

from __future__ import annotations

import importlib
import importlib.util
import os
from pathlib import Path
from typing import Any, Literal

from torchrl_tit.agents.folder import AgentError, is_agent, read_agent
from torchrl_tit.agents.hub import PREFIX, download
from torchrl_tit.agents.trained_agent import TrainedAgent
from torchrl_tit.settings import resolve
from torchrl_tit.settings.checks import nearest

_PACKAGED = Path(__file__).parent


def agent_names() -> list[str]:
    """Lists the agents that come with this package.

    Example:
        >>> "cartpole" in agent_names()
        True
    """
    return sorted(path.name for path in _PACKAGED.iterdir() if is_agent(path))


def load_agent(
    source: str | os.PathLike[str], *, device: Literal["cpu", "cuda", "auto"] = "cpu"
) -> TrainedAgent:
    """Loads a trained agent. Nothing in its files is executed.

    Args:
        source: the name of an agent that comes with this package (:func:`agent_names`); the folder
            of an agent; a run folder of ``train``, whose newest checkpoint is loaded; or
            ``"hf:user/name"``, a repository of the Hugging Face Hub, where
            ``"hf:user/name@revision"`` names a branch, a tag or a commit.
        device: device of the policy and of the environments; ``"auto"`` is the GPU if there is one.

    Returns:
        The policy, its task and its transforms.

    Raises:
        AgentError: if there is no such agent, one of its files was changed after it was written, or
            its weights do not fit its recipe.
        FileNotFoundError: if the run has no checkpoint.
        ValueError: if its task or a part of its network cannot be built here, for example because a
            package is missing, or because the user did not import a module that the recipe names.

    Example:
        >>> agent = load_agent("cartpole")
        >>> env = agent.make_env(8, seed=0)
        >>> env.rollout(20, agent.policy, break_when_any_done=False)["action"].shape
        torch.Size([8, 20])
        >>> load_agent("cart-pole")
        Traceback (most recent call last):
        ...
        torchrl_tit.agents.folder.AgentError: there is no agent or folder 'cart-pole': did you...
    """
    folder = find_agent(source)
    if is_agent(folder):
        return _recipes("agent_from_files")(read_agent(folder), str(source), device)
    return _recipes("agent_from_run")(folder, device)


def find_agent(source: str | os.PathLike[str]) -> Path:
    """Finds the folder of an agent or of a run, and downloads it if it is on the Hub.

    Args:
        source: see :func:`load_agent`.

    Raises:
        AgentError: if there is no such agent.

    Example:
        >>> find_agent("cartpole").name
        'cartpole'
    """
    name, folder = os.fspath(source), Path(source)
    if name.startswith(PREFIX):
        return download(name)
    names = agent_names()
    if name in names:
        return _PACKAGED / name
    if not folder.is_dir():
        raise AgentError(
            f"there is no agent or folder {name!r}: "
            f"{nearest(name, names) if names else 'this package holds no agents'}"
        )
    if not is_agent(folder) and not (folder / "recipe.json").is_file():
        raise AgentError(
            f"{folder} is neither an agent nor a run: it holds no agent.json and no recipe.json"
        )
    return folder


def _recipes(name: str) -> Any:
    """Returns a function of the recipes package, which builds networks and tasks from recipes.

    It is found by name, because this library does not depend on that package, which comes with it.
    """
    if importlib.util.find_spec("torchrl_tit.recipes") is None:  # a clone that is not installed
        importlib.import_module("recipes")  # available under both names once imported
    return resolve(f"torchrl_tit.recipes.agents:{name}")

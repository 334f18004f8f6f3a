"""Agents in repositories of the Hugging Face Hub."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

from torchrl_tit.agents.folder import CONTENTS, MANIFEST, AgentError, is_agent
from torchrl_tit.extras import install

PREFIX = "hf:"
"""Prefix of the names of agents on the Hub."""

_FILES = [*CONTENTS, MANIFEST]
_REPOSITORY = re.compile(r"\w[\w.-]*/\w[\w.-]*")


def download(source: str) -> Path:
    """Downloads an agent's files into huggingface_hub's cache, unless they are already there.

    All files come from one commit. Other files of the repository are not downloaded.

    Args:
        source: ``"hf:user/name"`` or ``"hf:user/name@revision"``.

    Returns:
        The folder of the files, which are not checked yet.

    Raises:
        AgentError: if the name has another form; if the repository or revision does not exist or
            holds no agent; if the Hub cannot be reached; or if huggingface_hub is missing.
    """
    repository, _, revision = source.removeprefix(PREFIX).partition("@")
    check_repository(repository)
    hub = import_hub()
    with _in_one_line(hub, repository, revision):
        folder = Path(
            hub.snapshot_download(repository, revision=revision or None, allow_patterns=_FILES)
        )
    if not is_agent(folder):
        raise AgentError(f"{source} is not an agent: the repository holds no {MANIFEST}")
    return folder


def upload(folder: Path, repository: str, *, private: bool = False) -> str:
    """Uploads an agent's folder in one commit; creates the repository if it does not exist.

    Args:
        folder: the folder, whose files have been checked.
        repository: ``"user/name"``.
        private: whether a new repository is private.

    Returns:
        The address of the commit.

    Raises:
        AgentError: if the name has another form, the Hub rejects it or cannot be reached, the user
            is not logged in, or huggingface_hub is missing.
    """
    check_repository(repository)
    hub = import_hub()
    with _in_one_line(hub, repository):
        api = hub.HfApi()
        api.create_repo(repository, private=private, exist_ok=True)
        commit = api.upload_folder(
            repo_id=repository,
            folder_path=folder,
            allow_patterns=_FILES,
            commit_message="Upload a trained agent of torchrl-tit",
        )
    return str(commit.commit_url)


def check_repository(name: str) -> None:
    """Raises AgentError if a name is not of the form ``user/name``.

    Example:
        >>> check_repository("me/cartpole")
        >>> check_repository("cartpole")
        Traceback (most recent call last):
        ...
        torchrl_tit.agents.folder.AgentError: 'cartpole' is not the name of a repository of the...
    """
    if not _REPOSITORY.fullmatch(name):
        raise AgentError(
            f"{name!r} is not the name of a repository of the Hugging Face Hub: expected user/name"
        )


def import_hub() -> ModuleType:
    """Imports huggingface_hub.

    Raises:
        AgentError: if it is missing.
    """
    try:
        import huggingface_hub.errors  # an optional extra
    except ImportError as error:
        raise AgentError(
            "model cards and the Hugging Face Hub need huggingface_hub: "
            f"{install('huggingface_hub')}"
        ) from error
    return huggingface_hub


@contextmanager
def _in_one_line(hub: ModuleType, repository: str, revision: str = "") -> Iterator[None]:
    """Turns errors of the Hub into messages of one line."""
    errors, name = hub.errors, f"{PREFIX}{repository}"
    known = {
        errors.RevisionNotFoundError: f"{name} has no revision {revision!r}",
        errors.RepositoryNotFoundError: f"there is no repository {repository!r} on the Hugging "
        "Face Hub, or you may not see it: check the name, or log in with `hf auth login`",
        errors.LocalEntryNotFoundError: f"{name} is not on this machine yet, and the Hugging Face "
        "Hub cannot be reached: check the connection",
    }
    try:
        yield
    except Exception as error:  # also the HTTP client's errors, which differ between versions
        reason = " ".join(str(error).split()) or type(error).__name__
        unknown = f"the request to the Hugging Face Hub for {name} failed: {reason}"
        messages = (text for kind, text in known.items() if isinstance(error, kind))
        raise AgentError(next(messages, unknown)) from error

"""A stand-in for the Hugging Face Hub, on the disk."""

import inspect
from fnmatch import fnmatchcase
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import huggingface_hub
import pytest
from huggingface_hub import errors


class LocalHub:
    """Answers what :mod:`torchrl_tit.agents.hub` calls, as huggingface_hub does.

    Every call has to fit the signature of the function that it stands for.

    Args:
        root: folder of the repositories and of the cache.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.commits: dict[str, list[dict[str, bytes]]] = {}
        """The files of each commit, by repository."""
        self.private: dict[str, bool] = {}
        self.failure: Exception | None = None
        """What the next calls raise, if anything."""

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Takes the place of huggingface_hub's functions."""
        api = huggingface_hub.HfApi
        stand_in = SimpleNamespace(
            create_repo=_checked(api.create_repo, self._create, bound=True),
            upload_folder=_checked(api.upload_folder, self._upload, bound=True),
        )
        download = _checked(huggingface_hub.snapshot_download, self._download)
        patch.setattr(huggingface_hub, "HfApi", lambda: stand_in)
        patch.setattr(huggingface_hub, "snapshot_download", download)

    def _create(self, repo_id: str, private: bool, exist_ok: bool) -> None:
        self._fail()
        if repo_id in self.commits and not exist_ok:
            raise _http_error(errors.HfHubHTTPError, "409 Client Error: Conflict")
        self.private.setdefault(repo_id, private)
        self.commits.setdefault(repo_id, [{".gitattributes": b"*.safetensors filter=lfs"}])

    def _upload(
        self, repo_id: str, folder_path: Path, allow_patterns: list[str], commit_message: str
    ) -> Any:
        self._fail()
        assert commit_message
        files = {
            path.name: path.read_bytes()
            for path in sorted(folder_path.iterdir())
            if any(fnmatchcase(path.name, pattern) for pattern in allow_patterns)
        }
        commits = self.commits[repo_id]
        commits.append({**commits[-1], **files})
        return SimpleNamespace(commit_url=f"https://hub/{repo_id}/commit/{len(commits) - 1}")

    def _download(self, repo_id: str, revision: str | None, allow_patterns: list[str]) -> str:
        """Links files of one commit into a folder, as in huggingface_hub's cache."""
        self._fail()
        if repo_id not in self.commits:
            raise _http_error(errors.RepositoryNotFoundError, "401 Client Error.\n\nNot found")
        commits = self.commits[repo_id]
        number = len(commits) - 1 if revision is None else int(revision)
        if number >= len(commits):
            raise _http_error(errors.RevisionNotFoundError, "404 Client Error.\n\nNot found")
        folder = self.root / repo_id / "snapshots" / str(number)
        blobs = self.root / repo_id / "blobs" / str(number)
        for path in (folder, blobs):
            path.mkdir(parents=True, exist_ok=True)
        for name, content in commits[number].items():
            if any(fnmatchcase(name, pattern) for pattern in allow_patterns):
                (blobs / name).write_bytes(content)
                (folder / name).unlink(missing_ok=True)
                (folder / name).symlink_to(blobs / name)
        return str(folder)

    def _fail(self) -> None:
        if self.failure is not None:
            raise self.failure


def _checked(real: Any, stand_in: Any, *, bound: bool = False) -> Any:
    """A function whose arguments have to fit the real one's."""
    signature = inspect.signature(real)

    def call(*args: Any, **kwargs: Any) -> Any:
        given = signature.bind(*([None] if bound else []), *args, **kwargs).arguments
        given.pop("self", None)
        return stand_in(**given)

    return call


def _http_error(kind: Any, message: str) -> Exception:
    return kind(message, response=SimpleNamespace(headers={}, request=None))

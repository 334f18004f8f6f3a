"""D4RL's files are downloaded once, atomically, and verified by checksum."""

import io
import threading
from collections.abc import Iterator
from email.message import Message
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar
from urllib.response import addinfourl

import h5py
import numpy as np
import pytest
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from tests.datasets.rollouts import Transitions, write
from torchrl_tit.datasets import DatasetError, download_d4rl, load_episodes
from torchrl_tit.datasets.sources import address

NAME = "hopper-medium-replay-v0"


class Server(SimpleHTTPRequestHandler):
    """Serves a folder; states a wrong length for files named "short"."""

    requests: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        self.requests.append(self.path)
        if "short" not in self.path:
            return super().do_GET()
        content = Path(self.translate_path(self.path)).read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(content) + 1000))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def site(tmp_path: Path, rolled: Transitions, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A local server of data files, and D4RL's name pointing there."""
    folder = tmp_path / "site"
    folder.mkdir()
    for name in ("whole", "short"):
        write(folder / f"{name}.hdf5", rolled)
    (folder / "page.hdf5").write_text("<html>gone</html>")
    monkeypatch.setattr(Server, "requests", [])
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Server, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}"
    monkeypatch.setitem(D4RL_DATASETS, NAME, f"{address}/whole.hdf5")
    yield address
    server.shutdown()
    server.server_close()


def test_a_name_is_downloaded_once(site: str, tmp_path: Path, rolled: Transitions) -> None:
    for _ in range(2):
        episodes = load_episodes(NAME, task="Hopper-v5", cache_dir=tmp_path / "cache")
        observations = episodes.rows["observation"][episodes.step_rows]
        np.testing.assert_array_equal(observations.numpy(), rolled["observations"])
    assert Server.requests == ["/whole.hdf5"]
    assert sorted(p.name for p in (tmp_path / "cache").iterdir()) == [
        f"{NAME}.hdf5",
        f"{NAME}.json",
    ]


def test_cache_is_the_users(site: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert download_d4rl(NAME) == tmp_path / "xdg" / "torchrl-tit" / "d4rl" / f"{NAME}.hdf5"


@pytest.mark.parametrize(
    ("file", "error", "message"),
    [
        ("short.hdf5", OSError, "received only|cannot be downloaded"),
        ("page.hdf5", DatasetError, "is not a whole HDF5 file"),
        ("missing.hdf5", OSError, "cannot be downloaded: HTTP Error 404"),
    ],
)
def test_a_failed_download_leaves_nothing(
    site: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    error: type[Exception],
    message: str,
) -> None:
    monkeypatch.setitem(D4RL_DATASETS, NAME, f"{site}/{file}")
    with pytest.raises(error, match=message):
        download_d4rl(NAME, tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_changed_file_is_refused(site: str, tmp_path: Path) -> None:
    path = download_d4rl(NAME, tmp_path)
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(DatasetError, match="has changed since it was downloaded; delete it"):
        load_episodes(NAME, cache_dir=tmp_path)
    path.unlink()
    assert download_d4rl(NAME, tmp_path).read_bytes() != content


def test_a_second_download_must_be_the_first_again(
    site: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = download_d4rl(NAME, tmp_path / "cache")
    content = path.read_bytes()
    path.unlink()
    with h5py.File(tmp_path / "site" / "other.hdf5", "w") as file:
        file["rewards"] = np.zeros(3)
    monkeypatch.setitem(D4RL_DATASETS, NAME, f"{site}/other.hdf5")
    with pytest.raises(
        DatasetError, match=r"other\.hdf5: sends another file than before; delete .*"
    ):
        download_d4rl(NAME, tmp_path / "cache")
    assert not path.exists()
    path.with_suffix(".json").unlink()  # as the message says
    assert download_d4rl(NAME, tmp_path / "cache").read_bytes() != content


def test_a_damaged_record_is_named(site: str, tmp_path: Path) -> None:
    record = download_d4rl(NAME, tmp_path).with_suffix(".json")
    record.write_text("[]")
    with pytest.raises(DatasetError, match=r"v0\.json: is damaged .*; delete it"):
        download_d4rl(NAME, tmp_path)


def test_all_come_over_https_and_never_leave_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert all(
        address(name).startswith("https://rail.eecs.berkeley.edu/") for name in D4RL_DATASETS
    )
    asked = []

    def redirected(url: str, timeout: float) -> addinfourl:
        asked.append(url)
        return addinfourl(io.BytesIO(b""), Message(), url.replace("https", "http"))

    monkeypatch.setattr("urllib.request.urlopen", redirected)
    with pytest.raises(OSError, match=r"redirected to http://rail.* which is not https"):
        download_d4rl(NAME, tmp_path)
    assert asked == [address(NAME)]
    assert list(tmp_path.iterdir()) == []


def test_a_kill_before_the_checksum_does_no_harm(site: str, tmp_path: Path) -> None:
    download_d4rl(NAME, tmp_path).with_suffix(".json").unlink()
    download_d4rl(NAME, tmp_path)
    assert len(Server.requests) == 1


@pytest.mark.parametrize("version", ["v0", "v2"])
@pytest.mark.parametrize("kind", ["medium", "medium-replay"])
@pytest.mark.parametrize("task", ["halfcheetah", "hopper", "walker2d"])
def test_the_papers_data_sets_are_known(task: str, kind: str, version: str) -> None:
    assert f"{task}-{kind}-{version}" in D4RL_DATASETS

"""D4RL's files are downloaded once, atomically, and verified by checksum; and its scores."""

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
import torch
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from tests.datasets.rollouts import Transitions, write
from torchrl_tit.datasets import (
    DatasetError,
    download_d4rl,
    has_reference,
    load_episodes,
    normalized_score,
    normalized_spread,
)
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


def test_a_name_is_downloaded_once(
    site: str, tmp_path: Path, rolled: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for _ in range(2):
        episodes = load_episodes(NAME, task="Hopper-v5")
        observations = episodes.rows["observation"][episodes.step_rows]
        np.testing.assert_array_equal(observations.numpy(), rolled["observations"])
    assert Server.requests == ["/whole.hdf5"]
    names = sorted(path.name for path in (tmp_path / "cache/torchrl-tit/d4rl").iterdir())
    assert names == [f"{NAME}.hdf5", f"{NAME}.json"]


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


def test_a_file_must_stay_as_it_was_downloaded_first(
    site: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = download_d4rl(NAME, tmp_path / "cache")
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(DatasetError, match="has changed since it was downloaded; delete it"):
        load_episodes(NAME, cache_dir=tmp_path / "cache")
    path.unlink()
    assert download_d4rl(NAME, tmp_path / "cache").read_bytes() == content
    path.unlink()  # and now the server sends another file
    with h5py.File(tmp_path / "site" / "other.hdf5", "w") as file:
        file["rewards"] = np.zeros(3)
    monkeypatch.setitem(D4RL_DATASETS, NAME, f"{site}/other.hdf5")
    message = r"other\.hdf5: sends another file than before; delete .*"
    with pytest.raises(DatasetError, match=message):
        download_d4rl(NAME, tmp_path / "cache")
    assert not path.exists()
    record = path.with_suffix(".json")
    record.write_text("[]")
    with pytest.raises(DatasetError, match=r"v0\.json: is damaged .*; delete it"):
        download_d4rl(NAME, tmp_path / "cache")
    record.unlink()  # as the messages say
    assert download_d4rl(NAME, tmp_path / "cache").read_bytes() != content
    record.unlink()  # a kill before the record was written
    requests = len(Server.requests)
    download_d4rl(NAME, tmp_path / "cache")
    assert len(Server.requests) == requests
    assert record.exists()


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


@pytest.mark.parametrize(
    ("name", "random", "expert"),
    [
        ("halfcheetah-medium-replay-v0", -280.178953, 12135.0),
        ("mujoco/hopper/medium-v0", -20.272305, 3234.3),
        ("Walker2d-v5", 1.629008, 4592.3),
    ],
)
def test_scores(name: str, random: float, expert: float) -> None:
    returns = torch.tensor([random, expert, (random + expert) / 2], dtype=torch.float64)
    expected = torch.tensor([0.0, 100.0, 50.0], dtype=torch.float64)
    torch.testing.assert_close(normalized_score(returns, name), expected)
    np.testing.assert_allclose(normalized_score(returns.numpy(), name), expected, atol=1e-12)
    # The standard deviation of scores is the score of a standard deviation, without the offset.
    spread = normalized_spread(returns.std(), name)
    torch.testing.assert_close(spread, normalized_score(returns, name).std())
    assert not has_reference("CartPole-v1")

"""`data info` and `data convert`, as they are typed."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from recipes.cli import main
from tests.datasets.rollouts import Transitions, roll, spans, write
from torchrl_tit.datasets import normalized_score


@pytest.fixture(scope="module")
def rolled() -> Transitions:
    return roll()


def test_info(tmp_path: Path, rolled: Transitions, capsys: pytest.CaptureFixture[str]) -> None:
    unfinished = {name: array[:-1] for name, array in rolled.items()}
    path = write(tmp_path / "hopper-random.hdf5", unfinished, policy="random")

    main(["data", "info", str(path), "--env", "Hopper-v5"])

    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    finished = spans(rolled)[:-1]
    terminated = sum(bool(rolled["terminals"][stop - 1]) for _, stop in finished)
    returns = np.array([rolled["rewards"][a:b].sum(dtype=np.float64) for a, b in finished])
    scores = normalized_score(returns, "hopper")
    assert lines["source"] == str(path)
    assert lines["transitions"] == str(len(rolled["rewards"]) - 1)
    assert lines["episodes"] == (
        f"{len(finished) + 1} ({terminated} terminated, "
        f"{len(finished) - terminated} truncated, 1 unfinished)"
    )
    for name, values in (("return", returns), ("score", scores)):
        low, mean, high = values.min(), values.mean(), values.max()
        assert lines[name] == f"min {low:.3f}, mean {mean:.3f}, max {high:.3f}"
    assert lines["observation"] == "[11] float32"
    assert lines["policy"] == "random"


@pytest.mark.parametrize(
    ("file", "task", "scored"),
    [
        ("hopper/a.hdf5", None, False),
        ("hopper/a.hdf5", "CartPole-v1", False),
        ("walker2d/a.hdf5", "Hopper-v5", True),
        ("hopper_medium-v2.hdf5", None, True),
    ],
)
def test_the_recorded_task_or_the_file_says_how_returns_are_scored(
    tmp_path: Path,
    rolled: Transitions,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    task: str | None,
    scored: bool,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path(file).parent.mkdir(exist_ok=True)
    write(Path(file), rolled, **({"env_id": task} if task else {}))
    main(["data", "info", file])
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    returns = np.array([rolled["rewards"][a:b].sum(dtype=np.float64) for a, b in spans(rolled)])
    expected = f"mean {normalized_score(returns, 'hopper').mean():.3f}"
    assert (expected in lines["score"]) == scored
    assert scored or lines["score"] == "no reference returns for this task"


def test_parts_of_an_episode_have_no_score(
    tmp_path: Path, rolled: Transitions, capsys: pytest.CaptureFixture[str]
) -> None:
    start, stop = max(spans(rolled), key=lambda span: span[1] - span[0])
    episode = {name: array[start:stop].copy() for name, array in rolled.items()}
    episode["next_observations"][0] += 1
    path = write(tmp_path / "a.hdf5", episode, env_id="Hopper-v5")
    main(["data", "info", str(path), "--gaps", "cut"])
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["return"] == lines["score"] == "no episode is whole"


def test_text_of_a_file_does_not_control_the_terminal(
    tmp_path: Path, rolled: Transitions, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "a.hdf5", rolled, policy="a\x1b[2J\nscore  100")
    main(["data", "info", str(path)])
    assert "policy        a\\x1b[2J\\nscore  100\n" in capsys.readouterr().out


def test_parts_that_gaps_cut_are_counted(
    tmp_path: Path, rolled: Transitions, capsys: pytest.CaptureFixture[str]
) -> None:
    start, _ = max(spans(rolled), key=lambda span: span[1] - span[0])
    following = rolled["next_observations"].copy()
    following[start] += 1
    path = write(tmp_path / "a.hdf5", {**rolled, "next_observations": following})
    main(["data", "info", str(path), "--gaps", "cut"])
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["episodes"].endswith("unfinished; 2 are parts of others, cut at gaps)")
    whole = [rolled["rewards"][a:b].sum(dtype=np.float64) for a, b in spans(rolled) if a != start]
    assert lines["return"].endswith(f"mean {np.mean(whole):.3f}, max {max(whole):.3f}")
    main(["data", "convert", str(path), str(tmp_path / "b.hdf5"), "--gaps", "cut"])
    assert "; 2 are parts of others, cut at gaps\n" in capsys.readouterr().out
    main(["data", "info", str(tmp_path / "b.hdf5")])
    again = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert again["return"] == lines["return"]


def test_convert_there_and_back(
    tmp_path: Path, rolled: Transitions, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "a.hdf5", {**rolled, "infos/qpos": rolled["rewards"]})

    main(["data", "convert", str(path), str(tmp_path / "hopper-v0"), "--env", "Hopper-v5"])
    assert "not converted: infos/qpos" in capsys.readouterr().out
    main(["data", "convert", str(tmp_path / "hopper-v0"), str(tmp_path / "new" / "b.hdf5")])

    with h5py.File(tmp_path / "new" / "b.hdf5") as file:
        assert set(file) == set(rolled)
        for name, array in rolled.items():
            np.testing.assert_array_equal(file[name][:], array)

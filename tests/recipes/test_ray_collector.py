"""Collectors on a Ray cluster: two machines, which are both this one."""

import os
import signal
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from recipes.core.algorithm import make_algorithm
from recipes.core.callback import Callback
from recipes.core.ray_collector import _check_own_name
from recipes.core.run import Run
from recipes.core.runner import evaluate, train
from recipes.core.task import seed_copies
from recipes.sac import SAC, SACAlgorithm
from tests.numerics import assert_near
from tests.recipes.ppo import test_collector
from torchrl_tit.checkpoint import checkpoint_steps
from torchrl_tit.rollout import FrameCollector, Rollout
from torchrl_tit.settings.imports import import_allowed
from torchrl_tit.settings.networks import enhanced_tit

BACKBONE = enhanced_tit(2, embed_dim=8, features_dim=8)
RECIPE = replace(test_collector.RECIPE, env="Noted-v0")
SAC_RECIPE = SAC(
    env="Pendulum-v1",
    backbone=BACKBONE,
    num_envs=4,
    collectors=2,
    ray="auto",
    total_steps=96,
    random_steps=32,
    steps_per_batch=32,
    updates_per_step=1 / 32,
    buffer_size=96,
    batch_size=8,
    critic_hidden=(8,),
)

# A task that leaves a note of each process that has it, and of the machine's Ray daemon.
OWN = """
import os
from pathlib import Path
import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

class Noted(CartPoleEnv):
    def __init__(self, **settings):
        super().__init__(**settings)
        Path(__file__).with_name(f"{os.getpid()}.pid").write_text(str(os.getppid()))

gymnasium.register("Noted-v0", Noted, max_episode_steps=500)
"""


class Watch(Callback):
    """Checks that batches continue one another and are those of the newest weights, and kills.

    Args:
        folder: where the processes leave their notes.
        kill_when_saved: the step whose checkpoint is saved when a collector is killed.
        kill_when_collected: the step at which one is killed before the update.
    """

    def __init__(self, folder: Path, kill_when_saved: int = 0, kill_when_collected: int = 0):
        self.folder = folder
        self.at = kill_when_saved, kill_when_collected
        self.policy: TensorDictModuleBase | None = None
        self.last: TensorDictBase | None = None
        self.seen = 0

    def collected(self, step: int, batch: TensorDictBase) -> None:
        assert batch.shape == (4, 16)
        if self.policy is not None and self.last is not None:
            [frames] = Rollout(batch.clone(), 2, "same").histories(torch.arange(64))
            frames = frames.view(4, 16, 2, 4)
            with torch.no_grad():
                assert_near(batch["features"], self.policy[0].module(frames))
            goes_on = ~self.last["next", "done"][:, -1, 0]
            assert goes_on.any()
            before = self.last["observation"][:, -1]
            torch.testing.assert_close(frames[goes_on, 0, 0], before[goes_on], rtol=0, atol=0)
            self.seen += 1
        self.last = batch.clone()
        if step == self.at[1]:
            self.kill()

    def updated(self, step: int, policy: TensorDictModuleBase) -> bool:
        self.policy = policy
        return False

    def saved(self, step: int) -> None:
        if step == self.at[0]:
            self.kill()

    def machines(self) -> dict[int, str]:
        """The processes of the collectors, and the machine of each."""
        notes = {int(note.stem): note.read_text() for note in self.folder.glob("*.pid")}
        return {pid: machine for pid, machine in notes.items() if pid != os.getpid()}

    def kill(self) -> None:
        os.kill(max(self.machines()), signal.SIGKILL)


@pytest.mark.slow
def test_a_run_whose_collector_is_killed_ends_in_one_line_and_is_resumed(
    cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a task in a file of the user's own."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", "")
    own = tmp_path / "noted.py"
    own.write_text(OWN)
    import_allowed(str(own))
    recipe = replace(RECIPE, ray=cluster)
    with pytest.raises(ValueError, match=r"has room for 0 collectors of 2 CPUs \(threads\), not"):
        make_algorithm(replace(recipe, threads=2)).check()

    watch = Watch(tmp_path, kill_when_saved=128)
    died = r"a collector on Ray died: .*A resumed run goes on from its last checkpoint"
    with Run.create(tmp_path / "run", recipe) as run:
        with pytest.raises(RuntimeError, match=died) as error:
            train(recipe, run, [watch])
        assert "\n" not in str(error.value)
        assert watch.seen == 1
        assert len(set(watch.machines().values())) == 2
        assert checkpoint_steps(run.checkpoints) == [64, 128]
    # With fewer collectors, since there are fewer machines.
    recipe = replace(recipe, collectors=1, total_steps=256)
    for note in tmp_path.glob("*.pid"):
        note.unlink()
    watch = Watch(tmp_path, kill_when_collected=256)
    with Run(tmp_path / "run", recipe) as run:
        with pytest.raises(RuntimeError, match=died) as error:
            train(recipe, run, [watch])
        assert "\n" not in str(error.value)
        assert watch.seen == 1
        assert max(checkpoint_steps(run.checkpoints)) == 192
        assert evaluate(run)["steps"] == 192


@pytest.mark.slow
def test_sac_stores_the_steps_of_all_environments_in_order(cluster: str, tmp_path: Path) -> None:
    recipe = replace(SAC_RECIPE, ray=cluster)
    algorithm = SACAlgorithm(recipe)
    algorithm.prepare(0, tmp_path)
    step = 0
    with closing(algorithm):
        batches = []
        for batch in algorithm.batches():
            assert batch.shape == (4, 8)
            batches.append(batch.clone())
            losses = algorithm.update(batch, step)
            step += 32
            *_, weight, bias = algorithm.policy.parameters()
            weight.data.zero_()  # from now on, it pushes as far as it can
            bias.data.copy_(torch.tensor([10.0, -10.0]))
    assert len(batches) == 3
    assert all(torch.isfinite(torch.as_tensor(loss)) for loss in losses.values())
    random, *later = (batch["action"] for batch in batches)
    assert random.std() > 0.5
    assert all((actions > 1.9).all() for actions in later)
    starts = seed_copies(algorithm.make_env(4), recipe.seed).reset()["observation"]
    torch.testing.assert_close(batches[0]["observation"][:, 0], starts)
    for batch, following in pairwise(batches):
        last, first = batch["next", "observation"][:, -1], following["observation"][:, 0]
        torch.testing.assert_close(last, first, rtol=0, atol=0)
    collected = torch.cat([batch["observation"] for batch in batches], 1)
    stored = algorithm.buffer.storage.get(slice(None))["observation"].transpose(0, 1)
    torch.testing.assert_close(stored, collected, rtol=0, atol=0)


def test_a_token_is_asked_for_unless_the_user_says_otherwise():
    assert os.environ["RAY_AUTH_MODE"] == "token"  # set by the import, before Ray's


def test_a_name_that_others_cannot_reach_is_refused(monkeypatch):
    monkeypatch.setattr("socket.gethostbyname", lambda name: "127.0.1.1")
    _check_own_name({"10.0.0.1"})  # a single machine
    with pytest.raises(ValueError, match=r"stands for 127\.0\.1\.1, where collectors on other"):
        _check_own_name({"10.0.0.1", "10.0.0.2"})


def test_the_error_of_a_collector_that_cannot_be_built_is_not_lost():
    """Ray asks whether it is true, which TorchRL's collectors have no answer to by then."""
    assert FrameCollector.__new__(FrameCollector)

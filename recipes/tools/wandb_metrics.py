"""Metrics of a run on Weights & Biases, beside CSV and TensorBoard."""

from __future__ import annotations

import importlib.util
import json
import math
import secrets
from collections.abc import Mapping, Sequence

import msgspec
from torchrl.record.loggers.wandb import WandbLogger

from torchrl_tit.extras import install
from torchrl_tit.files import write_text_atomic

from ..core.callback import Callback
from ..core.evaluation import Outcome
from ..core.metrics import read_metrics
from ..core.recipe_json import recipe_to_json
from ..core.run import Run

_FILE = "wandb.json"
_NOT_DRAWN = ("step", "time")


class WandbMetrics(Callback):
    """Sends each row of ``metrics.csv`` to Weights & Biases, with TorchRL's logger.

    A resumed run continues the W&B run whose name is in ``wandb.json``. Rows that were sent before
    are not sent again. A run that is resumed with W&B for the first time sends its earlier rows
    too. W&B's own environment variables control everything else: ``WANDB_MODE=offline`` keeps the
    metrics in the run folder's ``wandb/``, which ``wandb sync`` uploads.

    Args:
        run: the open run folder.
        project: the project on W&B.

    Raises:
        ValueError: if wandb is not installed, or the run is in another project.
        RuntimeError: if W&B cannot start, for example because nobody is logged in.
    """

    def __init__(self, run: Run, project: str) -> None:
        check_wandb(project)
        import wandb  # an extra

        name, known = _name_of(run, project)
        earlier = read_metrics(run.folder / "metrics.csv")
        settings = json.loads(recipe_to_json(run.recipe))
        try:
            self._logger = WandbLogger(
                exp_name=f"{run.recipe.name or run.folder.name}, seed {run.recipe.seed}",
                project=project,
                id=name,
                save_dir=run.folder,
                log_env_packages=False,  # versions.json has what results depend on
                config=settings,
                group=run.recipe.name or None,
            )
        except wandb.Error as error:
            raise RuntimeError(
                f"Weights & Biases cannot start: {' '.join(str(error).split())}; log in with "
                "`wandb login`, or set WANDB_MODE=offline to keep everything in the run folder"
            ) from error
        self._sent = -1.0
        if known and earlier:
            self._sent = earlier[-1]["step"]
        else:
            for row in earlier:
                self.logged(int(row["step"]), row)

    def logged(self, step: int, row: Mapping[str, float]) -> None:
        """Sends a row, if it is new."""
        if step <= self._sent:
            return
        known = {
            name: value
            for name, value in row.items()
            if name not in _NOT_DRAWN and not math.isnan(value)
        }
        if known:
            self._logger.log_metrics(known, step=step)
        self._sent = step

    def evaluated(self, step: int, outcomes: Sequence[Outcome]) -> None:
        """Writes the mean return of the newest evaluation into the summary."""
        best = max(outcome.mean for outcome in outcomes)
        self._logger.experiment.summary.update({"evaluation": best, "evaluation_step": step})

    def close(self) -> None:
        """Ends the run on W&B once all is sent."""
        self._logger.experiment.finish()


def check_wandb(project: str | None) -> None:
    """Raises ValueError if metrics cannot be sent to a project, before anything starts."""
    if project is None:
        return
    if importlib.util.find_spec("wandb") is None:
        raise ValueError(f"--wandb needs wandb: {install('wandb')}")
    if not project or any(letter in project for letter in "/\\#?%:"):
        raise ValueError(
            f"--wandb needs the name of a project, without / \\ # ? % and :, not {project!r}"
        )


class _Name(msgspec.Struct):
    """What ``wandb.json`` holds."""

    project: str
    id: str


def _name_of(run: Run, project: str) -> tuple[str, bool]:
    """Returns the run's name on W&B, which is new if it had none, and whether it had one."""
    path = run.folder / _FILE
    if not path.exists():
        name = _Name(project, secrets.token_hex(4))
        write_text_atomic(path, msgspec.json.encode(name).decode() + "\n")
        return name.id, False
    try:
        found = msgspec.json.decode(path.read_bytes(), type=_Name)
    except msgspec.MsgspecError as error:
        raise ValueError(
            f"{path} is damaged: delete it to begin a new run on Weights & Biases"
        ) from error
    if found.project != project:
        raise ValueError(
            f"{run.folder} is in the project {found.project!r} already: go on there, or delete "
            f"{path} to begin a run in {project!r}"
        )
    return found.id, True

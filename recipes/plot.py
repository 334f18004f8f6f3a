"""Learning curves as pictures."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from torchrl_tit.files import write_bytes_atomic

from .metrics import read_metrics


def plot_learning_curve(metrics: Path, picture: Path, *, title: str, window: int = 5) -> None:
    """Draws returns of training episodes over environment steps.

    Args:
        metrics: a run's ``metrics.csv`` with the columns ``step`` and ``return_mean``.
        picture: the PNG file to write.
        title: title of the picture.
        window: batches over which the bold line is averaged.
    """
    # Not at the top: Matplotlib takes a second that only this function should cost.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = [row for row in read_metrics(metrics) if not np.isnan(row["return_mean"])]
    steps = np.array([row["step"] for row in rows])
    returns = np.array([row["return_mean"] for row in rows])
    smooth = np.array([returns[max(0, i - window + 1) : i + 1].mean() for i in range(len(rows))])

    figure = Figure(figsize=(7, 4), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(steps, returns, color="C0", alpha=0.35, linewidth=1, label="mean of a batch")
    axes.plot(steps, smooth, color="C0", linewidth=2, label=f"mean of {window} batches")
    axes.set(title=title, xlabel="environment steps", ylabel="return of training episodes")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_bytes_atomic(picture, buffer.getvalue())

"""Pictures of learning curves."""

from pathlib import Path

from matplotlib.image import imread

from recipes.results.plot import plot_comparison


def height(folder: Path, groups: int) -> int:
    """Pixels of the picture of some groups of runs."""
    metrics, picture = folder / "metrics.csv", folder / f"{groups}.png"
    metrics.write_text("step,time,return_mean\n1,0,1.0\n2,1,3.0\n")
    plot_comparison({f"run {i}": [metrics] for i in range(groups)}, picture, title="")
    return len(imread(picture))


def test_the_legend_of_many_curves_has_a_place_of_its_own(tmp_path):
    assert height(tmp_path, 1) == height(tmp_path, 2) < height(tmp_path, 3) < height(tmp_path, 9)

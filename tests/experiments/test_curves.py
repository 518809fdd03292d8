import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments.curves import Chart, plot_charts, plot_curve, plot_losses
from visadapt.learning.rounds import Round


def make_round(samples: int) -> Round:
    losses = [(i, 1 / (1 + i), 2 / (1 + i) if i % 2 else math.nan) for i in range(10)]
    return Round(samples, losses, [0.5 / (1 + i) for i in range(5)])


def make_row(domain: str, samples: int, mean: object, failed: object = 0) -> dict[str, object]:
    return {"domain": domain, "method": "", "samples": samples, "mean": mean, "std": 0.02, "episodes": 100} | {
        "failed": failed
    }


def is_a_picture(path: Path) -> bool:
    with Image.open(path) as image:
        picture = np.asarray(image.convert("L"))
    return picture.shape[0] > 300 and picture.shape[1] > 600 and len(np.unique(picture)) > 20


@pytest.mark.parametrize(
    "rounds",
    [
        [make_round(200), make_round(400), make_round(1000)],
        [make_round(200)],
        [Round(50, [], [1.0])],
        [Round(50, [(0, 0.0, math.nan)], [math.nan])],
        [Round(50, [(0, 1.0, 1.2), (1, 0.1, 0.3)], [1.0] * 50)] * 3,
    ],
)
def test_losses_are_plotted_whatever_a_round_lacks(tmp_path: Path, rounds: list[Round]):
    plot_losses(tmp_path / "losses.png", rounds)
    assert is_a_picture(tmp_path / "losses.png")
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(("unadapted", "failed"), [("0.8", "40"), ("nan", "100"), ("", 100)])
def test_the_curve_takes_the_rows_of_a_table(tmp_path: Path, unadapted: str, failed: object):
    rows = [make_row("target", 0, unadapted, failed), make_row("source", 0, 0.06)]
    rows += [make_row("adapted", n, mean) for n, mean in ((1000, 0.1), (50, ""), (200, "0.2"))]
    rows.append(make_row("adapted", 200, 0.3, 5) | {"method": "rendered frames"})
    plot_curve(tmp_path / "curve.png", rows)
    assert is_a_picture(tmp_path / "curve.png")


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_charts_take_the_rows_of_a_table_failed_and_missing_ones_too(tmp_path: Path, columns: int):
    wide = [make_row("adapted", n, mean) for n, mean in ((1000, 0.1), (50, "0.01"), (200, "inf"))]
    other = [make_row("target", n, 0.3) | {"method": "another", "std": ""} for n in (50, 200, 1000)]
    before = [make_row("target", 0, "nan"), make_row("source", 0, 0.06)]
    charts = [Chart("left", "miss, m", [*before, *wide, *other]), Chart("right", "error, m/s", wide)]
    plot_charts(tmp_path / "charts.png", charts, columns)
    assert is_a_picture(tmp_path / "charts.png")


def test_nothing_to_plot_is_said(tmp_path: Path):
    with pytest.raises(ValueError, match="no rounds"):
        plot_losses(tmp_path / "a.png", [])
    with pytest.raises(ValueError, match="no rows"):
        plot_curve(tmp_path / "a.png", [make_row("source", 0, 0.1)])
    with pytest.raises(ValueError, match="no rows"):
        plot_charts(tmp_path / "a.png", [Chart("left", "miss, m", [make_row("source", 0, 0.1)])])
    assert not list(tmp_path.iterdir())


def test_no_global_state_of_pyplot_is_touched():
    code = "import sys, experiments.curves; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2]).returncode == 0

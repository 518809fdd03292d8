"""Fills the tables of README.md from the CSVs under results/: `python -m benchmarks.readme`.

Each table stands between the lines `<!-- table: NAME -->` and `<!-- end -->`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from benchmarks.cartpole_pixels import EXPERIMENT as PIXELS
from benchmarks.cartpole_pixels import OURS as FRAMES_ALONE
from benchmarks.cartpole_states import CONSTANT, OURS, SINE
from visadapt.files import replacing
from visadapt.results import read_rows

RESULTS = Path("results")
CURVE = (50, 100, 200, 500, 1000)
Rows = list[dict[str, str]]


def paper(rows: Rows) -> list[list[str]]:
    """The paper's CartPole numbers beside ours."""
    return [
        ["CartPole, mean cart speed in m/s", "paper", "here", "episodes up", "seeds"],
        ["frames, source, 0 samples", "0.15", *_cells(rows, PIXELS, "unadapted", "source", 0)],
        ["frames, target 2(sin t + 1) N, before", "unstable", *_cells(rows, PIXELS, "unadapted", "target", 0)],
        [
            "frames, target, after 1,000 samples",
            "0.29 (not counting those that chose the checkpoint)",
            *_cells(rows, PIXELS, FRAMES_ALONE, "adapted", 1000),
        ],
        ["states, source", "0.05", *_cells(rows, CONSTANT, "unadapted", "source", 0)],
        ["states, constant 3.3 N, before", "1.02", *_cells(rows, CONSTANT, "unadapted", "target", 0)],
        ["states, constant 3.3 N, after 50 samples", "0.09", *_cells(rows, CONSTANT, OURS, "adapted", 50)],
        ["states, 2(sin t + 1) N, before", "figure 3", *_cells(rows, SINE, "unadapted", "target", 0)],
        ["states, 2(sin t + 1) N, after 200 samples", "figure 3", *_cells(rows, SINE, OURS, "adapted", 200)],
        ["states, 2(sin t + 1) N, after 1,000 samples", "figure 3", *_cells(rows, SINE, OURS, "adapted", 1000)],
    ]


def curve(rows: Rows) -> list[list[str]]:
    """Mean cart speed and episodes up over counted samples."""
    table = [["counted target samples", "0", *(f"{samples:,}" for samples in CURVE)]]
    for name, experiment, method in (
        ("frames alone, 2(sin t + 1) N", PIXELS, FRAMES_ALONE),
        ("states, 2(sin t + 1) N", SINE, OURS),
    ):
        before = _cells(rows, experiment, "unadapted", "target", 0)
        after = [_cells(rows, experiment, method, "adapted", samples) for samples in CURVE]
        table.append([name, *(f"{speed} ({up})" if up else speed for speed, up, _ in (before, *after))])
    return table


def grounding(rows: Rows) -> list[list[str]]:
    """What grounding learns from, at 200 samples."""
    methods = dict.fromkeys(row["method"] for row in rows if row["experiment"] == PIXELS and row["samples"] == "200")
    table = [["CartPole from pixels, after 200 samples", "m/s", "episodes up", "seeds"]]
    return table + [[method, *_cells(rows, PIXELS, method, "adapted", 200)] for method in methods]


def pendulum(rows: Rows) -> list[list[str]]:
    """InvertedPendulum-v5."""
    table = [["InvertedPendulum-v5, mean cart speed in m/s", "counted samples", "here", "episodes up", "seeds"]]
    ours = [row for row in rows if row["system"].startswith("InvertedPendulum") and row["measure"] == "mean cart speed"]
    return table + [[f"{row['method']}, {row['domain']}", f"{int(row['samples']):,}", *_said(row)] for row in ours]


def _cells(rows: Rows, experiment: str, method: str, domain: str, samples: int) -> list[str]:
    for row in rows:
        key = (row["experiment"], row["method"], row["domain"], row["samples"])
        if key == (experiment, method, domain, str(samples)):
            return _said(row)
    return ["not run", "", ""]


def _said(row: dict[str, str]) -> list[str]:
    episodes, failed = int(row["episodes"]), int(row["failed"])
    speed = "unstable" if failed == episodes else f"{float(row['mean']):.3f} ± {float(row['std']):.3f}"
    return [speed, f"{episodes - failed} of {episodes}", row["seeds"]]


TABLES: dict[str, Callable[[Rows], list[list[str]]]] = {
    "paper": paper,
    "curve": curve,
    "grounding": grounding,
    "pendulum": pendulum,
}


def main() -> None:
    """Rewrite the tables of README.md."""
    rows = [row for path in sorted(RESULTS.glob("*.csv")) for row in read_rows(path)]
    readme = Path("README.md")
    text = readme.read_text()
    for name, make in TABLES.items():
        header, *body = make(rows)
        lines = ["| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *body)]
        block = f"<!-- table: {name} -->\n" + "\n".join(lines) + "\n<!-- end -->"
        before, rest = text.split(f"<!-- table: {name} -->", 1)
        text = before + block + rest.split("<!-- end -->", 1)[1]
    with replacing(readme) as temporary:
        temporary.write_text(text)


if __name__ == "__main__":
    main()

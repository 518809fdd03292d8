"""The tables of docs/paper.md: each line is a number of the paper, and beside it ours, taken from a CSV under results/.

The first line is the header. A number of the paper is never put into our column: what was not run says so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.action_times import ONNX, RESIDUAL
from benchmarks.baselines.table import BASELINES
from benchmarks.cartpole_pixels import EXPERIMENT as PIXELS, OURS as FRAMES_ALONE
from benchmarks.cartpole_states import CONSTANT, OURS, SINE
from benchmarks.data_collection import EXPLORERS
from benchmarks.tables_adaptation import CURVE_SAMPLES, LOOP_SPEEDS, Lines, Rows
from experiments.result_tables import ACTION_TIME

SPEED = "mean cart speed"
HEAD = ["paper", "here", "samples: paper, here", "kept up", "seeds", "verdict"]
NOT_RUN = ["not run", "", "", "", "not run"]
CURVE_HEAD = ["source", "0 samples", *(f"{count:,}" for count in CURVE_SAMPLES)]
CLOSE_TO_ZERO = 5.0
"""%: a smaller share of the gap that is left counts as the paper's "close to zero"; its figure 8 has no numbers"""
METHODS = {"PPO": "ppo", "MBMF": "mpc", "PETS": "pets"}
"""The paper's name: a module of `benchmarks.baselines`"""


@dataclass(frozen=True)
class Cell:
    """One number of the paper, the smaller the better, and the row of a CSV that stands beside it."""

    what: str
    paper: str
    """the number, or unstable; without a number in the paper, where it is drawn"""
    samples: str
    """of the target, in the paper"""
    experiment: str
    method: str
    domain: str
    counted: int
    measure: str = SPEED

    def line(self, rows: Rows) -> list[str]:
        """What the paper says, what was measured here, and the verdict."""
        key = (self.experiment, self.method, self.domain, str(self.counted), self.measure)
        for row in rows:
            if tuple(row[name] for name in ("experiment", "method", "domain", "samples", "measure")) == key:
                return [self.what, self.paper, *self._beside(row)]
        return [self.what, self.paper, *NOT_RUN]

    def _beside(self, row: dict[str, str]) -> list[str]:
        mean, episodes = float(row["mean"]), int(row["episodes"])
        up = episodes - int(row["failed"])
        spread = f" ± {float(row['std']):.3f}" if row["std"] else ""
        here = f"{mean:.3f}{spread}" if up else "unstable"
        samples = f"{self.samples or 'none'}, {self.counted:,}" if self.counted else ""
        outcome = verdict(self.paper, mean if up else math.inf)
        if self.domain == "target":
            outcome = ""
        elif 0 < up < episodes:
            outcome = f"not: {episodes - up} fell"
        return [here, samples, f"{up} of {episodes}", row["seeds"], outcome]


def verdict(paper: str, here: float) -> str:
    """Beaten, reached (equal when rounded to the paper's digits), or not; smaller is better. Empty where the paper has
    no such row."""
    if not paper:
        return ""
    if paper == "unstable":
        return "beaten" if math.isfinite(here) else "reached"
    try:
        said = float(paper.split()[0])
    except ValueError:
        return "no number in the paper"
    digits = len(paper.split()[0].partition(".")[2])
    if round(here, digits) == round(said, digits):
        return "reached"
    return "beaten" if here < said else "not"


def table(what: str, cells: Sequence[Cell], *files: Rows) -> Lines:
    """A table of cells, looked up in all files."""
    rows = [row for file in files for row in file]
    return [[what, *HEAD], *(cell.line(rows) for cell in cells)]


def table_1_cartpole(states: Rows, baselines: Rows) -> Lines:
    """Tables 1 and 3, the CartPole."""
    given = {
        "PPO": (("0.04 ± 0.04", "0.63 ± 0.54", "0.08 ± 0.06"), "60,000", 51200),
        "MBMF": (("0.01 ± 0.03", "0.35 ± 0.06", "0.02 ± 0.02"), "50", 50),
        "PETS": (("0.24 ± 0.10", "unstable", "0.26 ± 0.08"), "400", 500),
        "ours": (("0.05 ± 0.05", "1.02 ± 0.35", "0.09 ± 0.04"), "50", 50),
    }
    cells = []
    for name, (numbers, said, counted) in given.items():
        method = OURS if name == "ours" else BASELINES[METHODS[name]]
        before = "unadapted" if name == "ours" else method
        steps = (("source", before, 0), ("target", before, 0), ("adapted", method, counted))
        for paper, (domain, how, samples) in zip(numbers, steps, strict=True):
            cells.append(Cell(f"{name}, {domain}", paper, said, CONSTANT, how, domain, samples))
    return table("CartPole, constant force: cart speed, m/s", cells, states, baselines)


def table_1_vehicles(flights: Rows, baselines: Rows) -> Lines:
    """Tables 1 and 3, quadrotor and fixed wing."""
    given = {
        ("quadrotor", "PPO"): (("0.36 ± 0.10", "0.42 ± 0.09", "0.40 ± 0.12"), "150,000", 200704),
        ("quadrotor", "MBMF"): (("0.03 ± 0.01", "0.28 ± 0.04", "0.03 ± 0.02"), "1,000", 1000),
        ("quadrotor", "PETS"): (("0.18 ± 0.08", "0.38 ± 0.09", "0.10 ± 0.03"), "2,500 (simplified)", 1000),
        ("quadrotor", "ours"): (("0.05 ± 0.01", "0.56 ± 0.07", "0.07 ± 0.01"), "1,000", 1000),
        ("fixed wing", "PPO"): (("0.09 ± 0.05", "0.43 ± 1.45", "0.09 ± 0.06"), "150,000", 200704),
        ("fixed wing", "MBMF"): (("0.0 ± 0.0", "0.08 ± 0.08", "0.01 ± 0.02"), "2,000", 2000),
        ("fixed wing", "PETS"): (("0.24 ± 0.15", "8.39 ± 10.15", "0.27 ± 0.14"), "5,000", 2000),
        ("fixed wing", "ours"): (("0.01 ± 0.01", "0.07 ± 0.10", "0.02 ± 0.03"), "2,000", 2000),
    }
    measures = {"quadrotor": "mean tracking error", "fixed wing": "miss of the target"}
    cells = []
    for (vehicle, name), (numbers, said, counted) in given.items():
        method = OURS if name == "ours" else BASELINES[METHODS[name]]
        before = "unadapted" if name == "ours" else method
        steps = (("source", before, 0), ("target", before, 0), ("adapted", method, counted))
        for paper, (domain, how, samples) in zip(numbers, steps, strict=True):
            about = (f"{vehicle}, drag", how, domain, samples, measures[vehicle])
            cells.append(Cell(f"{vehicle}, {name}, {domain}", paper, said, *about))
    return table("drag 0.3 1/s: error or miss, m", cells, flights, baselines)


def table_2(pixels: Rows, baselines: Rows) -> Lines:
    """Table 2: the CartPole from frames."""
    cells = [
        Cell("ours, source", "0.15 ± 0.11", "", PIXELS, "unadapted", "source", 0),
        Cell("ours, target", "unstable", "", PIXELS, "unadapted", "target", 0),
        Cell("ours, adapted", "0.29 ± 0.17", "1,000", PIXELS, FRAMES_ALONE, "adapted", 1000),
        Cell("ours, adapted, a tenth of the samples", "0.29 ± 0.17", "1,000", PIXELS, FRAMES_ALONE, "adapted", 100),
    ]
    others = (
        ("PPO", "ppo", ("0.28 ± 0.23", "unstable", "0.39 ± 0.29"), "230,000", 200704),
        ("MBMF in image space", "mpc_pixels", ("unstable",) * 3, "1,000", 200),
        ("MBMF on states tracked from the frames", "mpc", ("",) * 3, "", 1000),
    )
    for name, module, numbers, said, counted in others:
        steps = (("source", 0), ("target", 0), ("adapted", counted))
        for paper, (domain, samples) in zip(numbers, steps, strict=True):
            cells.append(Cell(f"{name}, {domain}", paper, said, PIXELS, BASELINES[module], domain, samples))
    return table("CartPole, frames, 2(sin t + 1) N: cart speed, m/s", cells, pixels, baselines)


def figure_3(baselines: Rows) -> Lines:
    """Figure 3: the error of ours after 1,000 samples under a force that changes, against that of each baseline."""
    lines = [["2(sin t + 1) N, 1,000 samples: velocity error of ours smaller by", "paper", "here", "seeds", "verdict"]]
    found = {
        row["method"]: row
        for row in baselines
        if (row["experiment"], row["samples"], row["measure"]) == (SINE, "1000", SPEED)
    }
    ours = found.get(BASELINES["ours"])
    for method, paper in ((BASELINES["mpc"], "24 %"), (BASELINES["pets"], ""), (BASELINES["mppi"], "")):
        other = found.get(method)
        if ours is None or other is None:
            lines.append([f"than {method}", paper, *NOT_RUN[2:]])
            continue
        gain = 100 * (1 - float(ours["mean"]) / float(other["mean"]))
        outcome = "" if not paper else "reached" if gain >= float(paper.split()[0]) else "not"
        lines.append([f"than {method}", paper, f"{gain:z.0f} %", ours["seeds"], outcome])
    return lines


def baselines_changing(baselines: Rows) -> Lines:
    """The force that changes, every method, over samples."""
    return [["2(sin t + 1) N: cart speed, m/s", *CURVE_HEAD], *_curves(baselines, SINE)]


def baselines_constant(baselines: Rows) -> Lines:
    """The constant force, every method, over samples."""
    return [["constant 3.3 N: cart speed, m/s", *CURVE_HEAD], *_curves(baselines, CONSTANT)]


def _curves(rows: Rows, experiment: str) -> Lines:
    found = {
        (row["method"], row["domain"], int(row["samples"])): row
        for row in rows
        if (row["experiment"], row["measure"]) == (experiment, SPEED)
    }
    lines = []
    for method in dict.fromkeys(method for method, _, _ in found):
        keys = [("source", 0), ("target", 0), *(("adapted", count) for count in CURVE_SAMPLES)]
        lines.append([method, *(_speed(found.get((method, *key))) for key in keys)])
    return lines or [["not run", *[""] * len(CURVE_HEAD)]]


def ppo_curve(baselines: Rows, frames: Rows) -> Lines:
    """PPO in the target, over as many samples as it was given, as the paper's figure 7 for the fixed wing."""
    own = [row for row in (*baselines, *frames) if (row["method"], row["measure"]) == (BASELINES["ppo"], SPEED)]
    counts = sorted({int(row["samples"]) for row in own if row["domain"] != "source"})
    lines = [["PPO: cart speed, m/s", *(f"{count:,}" for count in counts)]]
    for experiment in dict.fromkeys(row["experiment"] for row in own):
        found = {
            int(row["samples"]): row for row in own if row["experiment"] == experiment if row["domain"] != "source"
        }
        name = experiment.removeprefix("CartPole, states, ").replace("CartPole, pixels", "frames")
        lines.append([name, *(_speed(found.get(count)) for count in counts)])
    return lines


def _speed(row: dict[str, str] | None) -> str:
    """Mean and spread, and how many episodes stayed up where not all did."""
    if row is None:
        return ""
    episodes, up = int(row["episodes"]), int(row["episodes"]) - int(row["failed"])
    if not up:
        return "unstable"
    lost = "" if up == episodes else f" ({up} of {episodes} up)"
    return f"{float(row['mean']):.3f} ± {float(row['std']):.3f}{lost}"


def runtime(baselines: Rows, exported: Rows) -> Lines:
    """A.4: the time of one action and its ratio to ours, of one run; then those of exported policies, of another."""
    said = {BASELINES["ours"]: 0.27, BASELINES["mpc"]: 5.0, BASELINES["pets"]: 2200.0}
    times = {
        row["method"]: float(row["mean"])
        for row in baselines
        if (row["measure"], row["experiment"]) == (ACTION_TIME, CONSTANT)
    }
    lines = [["one action, one core", "paper, ms", "here, ms", "paper, times ours", "here, times ours", "verdict"]]
    ours = times.get(BASELINES["ours"])
    for method in dict.fromkeys([*said, *times]):
        paper, here = said.get(method), times.get(method)
        cells = ["" if paper is None else f"{paper:g}", "not run" if here is None else f"{here:.3g}"]
        cells.append("" if paper is None else f"{paper / 0.27:.0f}")
        cells.append("" if here is None or not ours else f"{here / ours:.0f}")
        lines.append([method, *cells, "" if paper is None or here is None else verdict(f"{paper:g}", here)])
    for row in exported:
        if row["method"] == ONNX:
            said_there = "0.27" if row["experiment"] == f"CartPole, states{RESIDUAL}" else ""
            judged = verdict(said_there, float(row["mean"])) if said_there else ""
            what = f"ours as ONNX: {row['experiment']}"
            lines.append([what, said_there, f"{float(row['mean']):.2g}", "", "", judged])
    return lines


def collection(rows: Rows) -> Lines:
    """Figures 2 and 6: how much the current policy's data lower the error, or the mismatch, at the best round."""
    lines = [["2 cos t N: data of the current policy, instead of", "paper, up to", "here, up to", "seeds", "verdict"]]
    for vehicle, kind, given in (("quadrotor", "error", (33, 16)), ("fixed wing", "mismatch", (65, 55))):
        own = [
            row
            for row in rows
            if row["experiment"] == f"{vehicle}, 2 cos t, data collection"
            and ("mismatch" in row["measure"]) == (kind == "mismatch")
        ]
        means = {(row["method"], row["samples"]): float(row["mean"]) for row in own}
        for method, whose, paper in zip(EXPLORERS, ("a random policy's", "the MBMF's"), given, strict=True):
            what = f"{vehicle}, {kind}: {whose}"
            gains = [
                100 * (1 - means["data of the current policy", samples] / mean)
                for (by, samples), mean in means.items()
                if by == method
            ]
            if not gains:
                lines.append([what, f"{paper} %", "not run", "", "not run"])
                continue
            outcome = "reached" if max(gains) >= paper else "not"
            lines.append([what, f"{paper} %", f"{max(gains):z.0f} %", own[-1]["seeds"], outcome])
    return lines


def figure_7(baselines: Rows) -> Lines:
    """Figure 7: PPO on the fixed wing, over as many samples of the target as it was given."""
    own = [
        row
        for row in baselines
        if (row["experiment"], row["method"], row["unit"]) == ("fixed wing, drag", BASELINES["ppo"], "m")
        and row["domain"] != "source"
    ]
    lines = [["fixed wing, drag: miss in m after", *(f"{int(row['samples']):,} samples" for row in own)]]
    return [*lines, ["PPO, here", *(f"{float(row['mean']):.4f} ± {float(row['std']):.4f}" for row in own)]]


def figure_8(rows: Rows) -> Lines:
    """Figure 8: what is left of the quadrotor's gap."""
    lines = [["share of the gap left on flights not learnt from", "paper", "here", "samples", "seeds", "verdict"]]
    for row in rows:
        if row["samples"] in ("200", "1000"):
            left = 100 * float(row["mean"])
            cells = [f"{left:.1f} ± {100 * float(row['std']):.1f} %", f"{int(row['samples']):,}", row["seeds"]]
            outcome = "reached" if left < CLOSE_TO_ZERO else "not"
            lines.append([row["method"], "close to zero (drawn)", *cells, outcome])
    return lines


def table_4(rows: Rows) -> Lines:
    """Table 4: the power loop, at a radius of 7 m."""
    greatest = dict(zip(LOOP_SPEEDS, ("0.13", "0.23", "0.33", "0.79", "1.29"), strict=True))
    cells = []
    for speed, paper in LOOP_SPEEDS.items():
        args = (f"power loop, {speed} m/s", "ours, states", "source", 0)
        cells.append(Cell(f"{speed} m/s, mean error", paper, "", *args, "mean tracking error"))
        cells.append(Cell(f"{speed} m/s, greatest error", greatest[speed], "", *args, "greatest tracking error"))
    return table("power loop: m", cells, rows)


def swing(rows: Rows, learnt: Rows) -> Lines:
    """A.5: the swing-up. PPO is given the samples after which all its episodes succeed, or the most that it was."""
    args = ("CartPole, swing-up", "ours, states", "source", 20000)
    counted = int(learnt[-1]["samples"])
    cells = [
        Cell("mean cart speed, m/s", "0.29", "20,000", *args),
        Cell("distance from the middle, m", "0.01", "20,000", *args, "mean distance from the middle after 100 steps"),
        Cell("PPO: mean cart speed, m/s", "0.74", "300,000", args[0], "PPO", "source", counted),
    ]
    return table("swing-up", cells, rows, learnt)

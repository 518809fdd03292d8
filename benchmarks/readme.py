"""Fills the tables of README.md from the CSVs under results/: `python -m benchmarks.readme`.

Each table stands between the lines `<!-- table: NAME -->` and `<!-- end -->`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from benchmarks.cartpole_pixels import EXPERIMENT as PIXELS
from benchmarks.cartpole_pixels import OURS as FRAMES_ALONE
from benchmarks.cartpole_states import CONSTANT, OURS, SINE
from visadapt.evaluation.result_tables import read_rows
from visadapt.storage.atomic_files import replacing

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


VEHICLES = {
    "quadrotor, drag": ("quadrotor, drag 0.3 1/s: mean tracking error", "0.05", "0.56", "0.07 (1,000)"),
    "fixed wing, drag": ("fixed wing, drag 0.3 1/s: miss of the target", "0.01", "0.07", "0.02 (2,000)"),
    "quadrotor, 2 cos t": ("quadrotor, 2 cos t N: mean tracking error", "", "", "figure 2"),
    "fixed wing, 2 cos t": ("fixed wing, 2 cos t N: miss of the target", "", "", "figure 6"),
}
"""What the README calls the experiments of `benchmarks.flight`, and the paper's source, target before and after."""


def vehicles(rows: Rows) -> list[list[str]]:
    """The paper's vehicles beside ours, in m."""
    head = ("source", "before", "after: first round", "after: last round", "failed before, after")
    table = [["m", "paper: source, before, after (samples)", *head]]
    for name, (said, *papers) in VEHICLES.items():
        own = [row for row in rows if row["experiment"] == name]
        if own:
            adapted = sorted((row for row in own if row["domain"] == "adapted"), key=lambda row: int(row["samples"]))
            source, before = (next(row for row in own if row["domain"] == domain) for domain in ("source", "target"))
            shown = (source, before, adapted[0], adapted[-1])
            cells = [
                f"{float(row['mean']):.4f} ± {float(row['std']):.4f}" + (f" ({int(row['samples']):,})" if k > 1 else "")
                for k, row in enumerate(shown)
            ]
            failed = ", ".join(f"{row['failed']} of {row['episodes']}" for row in (before, adapted[-1]))
            table.append([said, ", ".join(filter(None, papers)), *cells, failed])
    return table


def residual(rows: Rows) -> list[list[str]]:
    """What is left of the quadrotor's gap, by counted samples."""
    return _by_samples(
        rows,
        "quadrotor, drag, residual by samples",
        "gap in velocity that is left",
        lambda row: f"{100 * float(row['mean']):.1f} ± {100 * float(row['std']):.1f} %",
    )


def collection(rows: Rows) -> list[list[str]]:
    """Who collects: the mismatch in mm/s and the misses in mm, before, after the first and after the last round."""
    own = [row for row in rows if row["experiment"].endswith(", data collection")]
    table = [["drag 0.3 1/s", "delta in mm/s: before", "first round", "last", "off in mm: before", "first", "last"]]
    for system, method in dict.fromkeys((row["system"], row["method"]) for row in own if row["domain"] == "adapted"):
        line = [f"{system.replace('_', ' ')}, {method}"]
        for unit in ("m/s", "m"):
            told = [row for row in own if (row["system"], row["unit"]) == (system, unit)]
            after = sorted((row for row in told if row["method"] == method), key=lambda row: int(row["samples"]))
            for row in (*(row for row in told if row["domain"] == "target"), after[0], after[-1]):
                samples = f" ({int(row['samples']):,})" if int(row["samples"]) else ""
                line.append(f"{1000 * float(row['mean']):.2f} ± {1000 * float(row['std']):.2f}{samples}")
        table.append(line)
    return table


def named(rows: Rows) -> list[list[str]]:
    """Named effects beside the residual, from very few samples, in m."""
    return _by_samples(
        rows,
        "quadrotor, drag, named effects",
        "quadrotor, drag: mean tracking error in m",
        lambda row: f"{float(row['mean']):.4f} ± {float(row['std']):.4f}",
    )


def _by_samples(rows: Rows, experiment: str, head: str, tell: Callable[[dict[str, str]], str]) -> list[list[str]]:
    """An experiment's methods, one a line, over counted samples."""
    found = {(row["method"], int(row["samples"])): row for row in rows if row["experiment"] == experiment}
    samples = sorted({count for _, count in found})
    table = [[head, *(f"{count:,} samples" for count in samples)]]
    methods = dict.fromkeys(method for method, _ in found)
    return table + [[method, *(tell(found[method, count]) for count in samples)] for method in methods]


def rotorpy(rows: Rows) -> list[list[str]]:
    """rotorpy's multirotor, in m."""
    table = [["rotorpy's Crazyflie, mean tracking error in m", "counted samples", "here", "within 1 m", "seeds"]]
    for row in rows:
        if row["experiment"] == "rotorpy" and row["measure"] == "mean tracking error":
            error = f"{float(row['mean']):.3f} ± {float(row['std']):.3f}"
            near = f"{int(row['episodes']) - int(row['failed'])} of {row['episodes']}"
            table.append([f"{row['method']}, {row['domain']}", f"{int(row['samples']):,}", error, near, row["seeds"]])
    return table


DIAGNOSED = {
    "verdict": "verdict",
    "most probable": "most probable effects",
    "gap closed": "gap closed",
    **{f"drag_{axis}": f"drag along {axis}, 1/s" for axis in "xyz"},
    **{f"damping_{axis}": f"damping of turns about {axis}, 1/s" for axis in "xyz"},
    "lift": "translational lift, 1/m",
    "lag": "lag of the motors, s",
    **{f"wind_{axis}": f"wind along {axis}, m/s" for axis in "xy"},
}
"""What `benchmarks.rotorpy_diagnosis` asks, and what the README calls it."""


def rotorpy_diagnosis(rows: Rows) -> list[list[str]]:
    """What the diagnosis says of rotorpy's multirotor, with 90 % intervals, and what rotorpy publishes."""
    kinds = list(dict.fromkeys(row["air"] for row in rows))
    found = {(row["air"], row["what"]): row for row in rows}
    table = [["rotorpy's Crazyflie, diagnosed", *kinds, "published"]]
    for what, told in DIAGNOSED.items():
        own = [found[kind, what] for kind in kinds]
        # In calm air, or in none, some of them are 0.
        published = max((row["published"] for row in own), key=lambda value: float(value or 0), default="")
        table.append([told, *map(_found, own), published])
    return table


def _found(row: dict[str, str]) -> str:
    if row["what"] == "gap closed" and row["value"]:
        return f"{100 * float(row['value']):.0f} %"
    value = row["value"].replace("_", " ")
    return f"{value} ({row['low']} to {row['high']})" if row["low"] else value


LOOPS = {"2.6": "0.05", "3.4": "0.09", "4.1": "0.12", "4.6": "0.21", "5.0": "0.31"}
"""Speeds in m/s, and the paper's mean errors in m."""


def loops(rows: Rows) -> list[list[str]]:
    """The power loop, in m."""
    found = {(row["experiment"], row["measure"]): f"{float(row['mean']):.3f}" for row in rows}
    table = [["power loop, m", *(f"{speed} m/s" for speed in LOOPS)], ["paper, mean error", *LOOPS.values()]]
    for name, said in (("power loop", "radius 7 m"), ("power loop, tightest", "tightest radius")):
        for measure, short in (("mean tracking error", "mean error"), ("greatest tracking error", "greatest error")):
            table.append([f"{said}, {short}", *(found.get((f"{name}, {speed} m/s", measure), "") for speed in LOOPS)])
    return table


def swing(rows: Rows) -> list[list[str]]:
    """The swing-up."""
    own = {row["measure"]: row for row in rows if row["experiment"] == "CartPole, swing-up"}
    table = [["swing-up, 20,000 samples", "paper", "here"]]
    if not own:
        return table
    whole = own["mean cart speed"]
    episodes = int(whole["episodes"])
    table.append(["episodes that succeed", "100 %", f"{episodes - int(whole['failed'])} of {episodes}"])
    for measure, paper_says in (
        ("mean cart speed", "0.29 m/s"),
        ("mean cart speed after 100 steps", ""),
        ("mean distance from the middle after 100 steps", "0.01 m"),
    ):
        row = own[measure]
        table.append([measure, paper_says, f"{float(row['mean']):.3f} ± {float(row['std']):.3f} {row['unit']}"])
    return table


def blind(rows: Rows, again: Rows) -> list[list[str]]:
    """The sealed check of the diagnosis: every diagnoser on both sets, and ours on hard ones drawn `again`."""
    found = {(row["kind"], row["diagnoser"], row["measure"]): row for row in rows}
    columns = [
        (kind, name) for kind in ("easy", "hard") for name in BLIND if any(key[:2] == (kind, name) for key in found)
    ]
    second = {row["measure"]: row for row in again if row["kind"] == "hard" and row["diagnoser"] == "ours"}
    table = [["sealed check", *(f"{kind}: {name}" for kind, name in columns), "hard, seed 2029: ours"]]
    for measure, told in MEASURES.items():
        cells = [found.get((kind, name, measure)) for kind, name in columns]
        table.append([told, *(_share(row) for row in (*cells, second.get(measure)))])
    return table


def blind_flights(rows: Rows) -> list[list[str]]:
    """The sealed check of the diagnosis of the vehicles: every diagnoser, and the measures that there are."""
    found = {(row["kind"], row["diagnoser"], row["measure"]): row for row in rows}
    columns = [
        (kind, name)
        for kind in ("quadrotor", "fixed_wing")
        for name in BLIND
        if any(key[:2] == (kind, name) for key in found)
    ]
    table = [["sealed check", *(f"{kind.replace('_', ' ')}: {name}" for kind, name in columns)]]
    for measure, told in MEASURES.items():
        cells = [found.get((kind, name, measure)) for kind, name in columns]
        if any(cells):
            table.append([told, *(_share(row) for row in cells)])
    return table


def _share(row: dict[str, str] | None) -> str:
    if row is None:
        return ""
    value, low, high = (float(row[name] or "nan") for name in ("value", "low", "high"))
    if row["measure"] == "seconds":
        return f"{value:.1f} s"
    if "median" in row["measure"] or "error" in row["measure"]:
        return f"{100 * value:.1f} %"
    return f"{100 * value:.0f} % ({100 * low:.0f} to {100 * high:.0f}) of {row['n']}"


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


BLIND = ("ours", "afternoon", "greedy", "refit", "pysindy", "chance")
MEASURES = {
    "single: among the named": "single effects named",
    "single: named, nothing else": "and nothing else",
    "pair: both named": "pairs, both named",
    "triple: all named": "triples, all named",
    "none: no_gap": "nothing there, called no_gap",
    "foreign: unexplained": "foreign effects, called unexplained",
    "parameter error, relative": "median parameter error",
    "coverage of 90 % intervals": "coverage of the 90 % intervals",
    "closed where identified, median": "gap closed where identified, median",
    "region overlap, median": "region of a patch, gust or frozen zone: overlap, median",
    "seconds": "time for one recording, median",
}
"""Measures of the blind check, and what the README calls them."""

TABLES: dict[str, Callable[[Rows], list[list[str]]]] = {
    "paper": paper,
    "curve": curve,
    "grounding": grounding,
    "pendulum": pendulum,
    "vehicles": vehicles,
    "residual": residual,
    "collection": collection,
    "named": named,
    "rotorpy": rotorpy,
    "loops": loops,
    "swing": swing,
}
"""from the experiments' rows"""


def main() -> None:
    """Rewrite the tables of README.md."""
    every = [row for path in sorted(RESULTS.glob("*.csv")) for row in read_rows(path)]
    rows = [row for row in every if "experiment" in row]
    names = ("blind_diagnosis", "blind_diagnosis_2029", "rotorpy_diagnosis")
    diagnosed, again, crazyflie = (read_rows(RESULTS / f"{name}.csv") for name in names)
    readme = Path("README.md")
    text = readme.read_text()
    tables = {name: make(rows) for name, make in TABLES.items()} | {
        "blind": blind(diagnosed, again),
        "blind flights": blind_flights(diagnosed),
        "rotorpy diagnosis": rotorpy_diagnosis(crazyflie),
    }
    for name, (header, *body) in tables.items():
        lines = ["| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *body)]
        block = f"<!-- table: {name} -->\n" + "\n".join(lines) + "\n<!-- end -->"
        before, rest = text.split(f"<!-- table: {name} -->", 1)
        text = before + block + rest.split("<!-- end -->", 1)[1]
    with replacing(readme) as temporary:
        temporary.write_text(text)


if __name__ == "__main__":
    main()

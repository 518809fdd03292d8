"""The pages' tables of the diagnosis: each function takes the rows of its CSVs and gives the lines of a table."""

from __future__ import annotations

from itertools import pairwise

from benchmarks.blind.tables import STRENGTH_EDGES
from benchmarks.diagnosis_ablations import WHOLE
from benchmarks.planned_experiments import OUTCOMES
from benchmarks.tables_adaptation import Lines, Rows
from benchmarks.vibrations import OTHERS

DIAGNOSERS = ("ours", "afternoon", "greedy", "refit", "pysindy", "chance")
"""Order of the columns."""

MEASURES = {
    "single: among the named": "single effects named",
    "single: named, nothing else": "and nothing else",
    "single: stage right": "single effects, stage right",
    "pair: both named": "pairs, both named",
    "pair: stages right": "pairs, stages right",
    "triple: all named": "triples, all named",
    "none: no_gap": "nothing hidden, called no_gap",
    "foreign: unexplained": "foreign effects, called unexplained",
    "nobody pushed: push named": "nobody pushed, a push named",
    "parameter error, relative": "median parameter error",
    "coverage of 90 % intervals": "coverage of the 90 % intervals",
    "closed where identified, median": "gap closed where identified, median",
    "region overlap, median": "region of a patch, gust or frozen zone: overlap, median",
    "seconds": "CPU time for one recording, median",
}
"""Measures of the sealed check, and their names in the tables."""

BY_STRENGTH = {"single effects named": "single: named, nothing else", "foreign, unexplained": "foreign: unexplained"}
"""Measures of the sealed check that are split by strength, by their names in the table."""

DRAWS = ("first", "second")

CRAZYFLIE = {
    "verdict": "verdict",
    "most probable": "most probable effects",
    "gap closed": "gap closed",
    **{f"drag_{axis}": f"drag along {axis}, 1/s" for axis in "xyz"},
    **{f"damping_{axis}": f"damping of turns about {axis}, 1/s" for axis in "xyz"},
    "lift": "translational lift, 1/m",
    "lag": "lag of the motors, s",
    **{f"wind_{axis}": f"wind along {axis}, m/s" for axis in "xy"},
}
"""Quantities of `benchmarks.rotorpy_diagnosis`, and their names in the table."""


def blind(first: Rows, second: Rows) -> Lines:
    """Cart-poles: every diagnoser on both sets of the first draw, and ours on the hard set of a second one."""
    again = {row["measure"]: row for row in second if (row["kind"], row["diagnoser"]) == ("hard", "ours")}
    header, *lines = _check(first, ("easy", "hard"))
    return [[*header, "hard, second draw: ours"], *([*line, _cell(again.get(key))] for key, *line in lines)]


def blind_strengths(first: Rows, second: Rows) -> Lines:
    """Cart-poles, hard: shares by the strength of the hidden effect, for both draws."""
    sets = [[row for row in rows if (row["kind"], row["diagnoser"]) == ("hard", "ours")] for rows in (first, second)]
    found = [{row["measure"]: row for row in rows} for rows in sets]
    lines = [["strength, times the noise", *(f"{name}, {draw} draw" for name in BY_STRENGTH for draw in DRAWS)]]
    for low, high in pairwise(STRENGTH_EDGES):
        keys = [f"{measure}, strength {low:g} to {high:g}" for measure in BY_STRENGTH.values()]
        cells = [_cell(rows.get(key)) for key in keys for rows in found]
        if any(cells):
            lines.append([f"{low:g} to {high:g}", *cells])
    return lines


def parts(rows: Rows) -> Lines:
    """The diagnosis with one part left out, on a draw for development."""
    lines = [
        [
            *("set", "without", "recordings on which it acts", "named effects: all, nothing else"),
            *("nothing hidden: no_gap", "foreign: unexplained", "coverage"),
            "CPU time where it acts, against the whole",
        ]
    ]
    for row in rows:
        shares = [
            f"{row[f'{what}_right']} of {row[what]}" if int(row[what]) else "" for what in ("named", "none", "foreign")
        ]
        covered, intervals = (float(row[key]) for key in ("covered", "intervals"))
        alone, whole = float(row["seconds"]), float(row["seconds_whole"])
        time = f"{alone:.0f} s for {whole:.0f} s" if row["without"] != WHOLE and alone else ""
        shown = [row["kind"], row["without"], row["acts"], *shares, f"{100 * covered / intervals:.0f} %", time]
        lines.append(shown)
    return lines


def blind_rigs(rows: Rows) -> Lines:
    """Lab's machines, large effects, and the rows of `datasets.blind.table`, without the measures that no set has."""
    header, *lines = _check(rows, ("rig-all", "large-all", "table"))
    return [header, *(line for _, *line in lines if any(line[1:]))]


def blind_frames(rows: Rows) -> Lines:
    """Films, without the measures that no set of them has."""
    header, *lines = _check(rows, ("film_plain", "film_textured"))
    return [header, *(line for _, *line in lines if any(line[1:]))]


def blind_flights(rows: Rows) -> Lines:
    """Vehicles: every diagnoser, without the measures that no vehicle has."""
    header, *lines = _check(rows, ("quadrotor", "fixed_wing"))
    return [header, *(line for _, *line in lines if any(line[1:]))]


def crazyflie(rows: Rows) -> Lines:
    """The diagnosis of rotorpy's multirotor with 90 % intervals, and what rotorpy publishes."""
    airs = list(dict.fromkeys(row["air"] for row in rows))
    found = {(row["air"], row["what"]): row for row in rows}
    lines = [["rotorpy's Crazyflie, diagnosed", *airs, "published"]]
    for quantity, name in CRAZYFLIE.items():
        own = [found[air, quantity] for air in airs]
        # In calm air, or in none, some of them are 0.
        published = max((row["published"] for row in own), key=lambda value: float(value or 0))
        lines.append([name, *map(_estimate, own), published])
    return lines


def planned(rows: Rows) -> Lines:
    """What the gentle recordings leave open, then what each kind of 200 more rows makes of it."""
    lines = [["one hidden effect", "recordings", *OUTCOMES]]
    for method in dict.fromkeys(row["method"] for row in rows):
        own = {row["measure"]: row for row in rows if row["method"] == method}
        shares = [f"{100 * float(own[name]['mean']):.0f} %" for name in OUTCOMES]
        lines.append([method, own[OUTCOMES[0]]["episodes"], *shares])
    return lines


def vibrations(rows: Rows) -> Lines:
    """One hidden effect beside a vibration, with white noise alone and with the search that has its colour."""
    found = {(row["method"], row["measure"]): row for row in rows}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = [[f"beside a vibration, {rows[0]['episodes']} recordings", *methods]]
    for measure in dict.fromkeys(row["measure"] for row in rows):
        numbers = [float(found[method, measure]["mean"] or "nan") for method in methods]
        lines.append([measure, *(f"{x:.1f}" if measure == OTHERS else f"{100 * x:.0f} %" for x in numbers)])
    return lines


def sticking(rows: Rows) -> Lines:
    """A ball that dry friction stops, with and without what the diagnosis does about that."""
    found = {(row["method"], row["measure"]): float(row["mean"] or "nan") for row in rows}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    units = {row["measure"]: row["unit"] for row in rows}
    lines = [[f"ball that dry friction stops, {rows[0]['episodes']} recordings", *methods]]
    for measure, unit in units.items():
        numbers = [found[method, measure] for method in methods]
        lines.append([measure, *(f"{x:.2f}" if unit == "1" else f"{100 * x:.3g} %" for x in numbers)])
    return lines


def _check(rows: Rows, kinds: tuple[str, ...]) -> Lines:
    """The header, and one line a measure: its key, its name, and a cell for every diagnoser on every set."""
    found = {(row["kind"], row["diagnoser"], row["measure"]): row for row in rows}
    run = {key[:2] for key in found}
    columns = [(kind, name) for kind in kinds for name in DIAGNOSERS if (kind, name) in run]
    header = ["sealed check", *(f"{kind.removesuffix('-all').replace('_', ' ')}: {name}" for kind, name in columns)]
    return [
        header,
        *([key, name, *(_cell(found.get((*column, key))) for column in columns)] for key, name in MEASURES.items()),
    ]


def _cell(row: dict[str, str] | None) -> str:
    if row is None:
        return ""
    value, low, high = (float(row[name] or "nan") for name in ("value", "low", "high"))
    if row["measure"] == "seconds":
        return f"{value:.1f} s"
    if "median" in row["measure"] or "error" in row["measure"]:
        return f"{100 * value:.1f} %"
    return f"{100 * value:.0f} % ({100 * low:.0f} to {100 * high:.0f}) of {row['n']}"


def _estimate(row: dict[str, str]) -> str:
    if row["what"] == "gap closed" and row["value"]:
        return f"{100 * float(row['value']):.0f} %"
    value = row["value"].replace("_", " ")
    return f"{value} ({row['low']} to {row['high']})" if row["low"] else value

"""The pages' tables of policies and renderers: each function takes the rows of its CSVs and gives the lines of a table.

The first line is the header. Rows are those of `experiments.result_tables`, as read from the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from benchmarks.cartpole_pixels import EXPERIMENT as PIXELS, OURS as FRAMES_ALONE
from benchmarks.cartpole_states import CONSTANT, OURS, SINE
from benchmarks.other_targets import METHOD

Row = dict[str, str]
Rows = list[Row]
Lines = list[list[str]]

CURVE_SAMPLES = (50, 100, 200, 500, 1000)
SAMPLES_HEAD = ["counted target samples", "0", *(f"{samples:,}" for samples in CURVE_SAMPLES)]
"""Counted target samples after which an adaptation is scored, and the columns of its table."""

VEHICLES = {
    "quadrotor, drag": ("quadrotor, drag 0.3 1/s: mean tracking error", "0.05, 0.56, 0.07 (1,000)"),
    "fixed wing, drag": ("fixed wing, drag 0.3 1/s: miss of the target point", "0.01, 0.07, 0.02 (2,000)"),
    "quadrotor, 2 cos t": ("quadrotor, 2 cos t N: mean tracking error", "figure 2"),
    "fixed wing, 2 cos t": ("fixed wing, 2 cos t N: miss of the target point", "figure 6"),
}
"""By experiment of `benchmarks.flight`: its name in the table, and the paper's source, before and after, in m."""

LOOP_SPEEDS = {"2.6": "0.05", "3.4": "0.09", "4.1": "0.12", "4.6": "0.21", "5.0": "0.31"}
"""Speeds of the power loop in m/s, and the paper's mean errors in m."""

DM_CONTROL = (("DreamerV3", "100,000", "945"), ("DrQ-v2", "100,000", "987"), ("PPO", "1,000,000", "507"))
"""Of dm_control's cart-pole, balance, from pixels: who published a return, after how many steps, and the return."""


def cartpole(pixels: Rows, states: Rows) -> Lines:
    """The paper's CartPole numbers beside ours."""
    return [
        ["CartPole, mean cart speed in m/s", "paper", "here", "episodes up", "seeds"],
        ["frames, source, 0 samples", "0.15", *_speed(pixels, PIXELS, "unadapted", "source", 0)],
        ["frames, target 2(sin t + 1) N, before", "unstable", *_speed(pixels, PIXELS, "unadapted", "target", 0)],
        [
            "frames, target, after 1,000 samples",
            "0.29 (not counting those that chose the checkpoint)",
            *_speed(pixels, PIXELS, FRAMES_ALONE, "adapted", 1000),
        ],
        ["states, source", "0.05", *_speed(states, CONSTANT, "unadapted", "source", 0)],
        ["states, constant 3.3 N, before", "1.02", *_speed(states, CONSTANT, "unadapted", "target", 0)],
        ["states, constant 3.3 N, after 50 samples", "0.09", *_speed(states, CONSTANT, OURS, "adapted", 50)],
        ["states, 2(sin t + 1) N, before", "figure 3", *_speed(states, SINE, "unadapted", "target", 0)],
        ["states, 2(sin t + 1) N, after 200 samples", "figure 3", *_speed(states, SINE, OURS, "adapted", 200)],
        ["states, 2(sin t + 1) N, after 1,000 samples", "figure 3", *_speed(states, SINE, OURS, "adapted", 1000)],
    ]


def curve(pixels: Rows, states: Rows) -> Lines:
    """Mean cart speed and episodes up over counted samples, under the paper's time-variant force."""
    lines = [
        _over_samples("frames alone, 2(sin t + 1) N", pixels, PIXELS, FRAMES_ALONE),
        _over_samples("states, 2(sin t + 1) N", states, SINE, OURS),
    ]
    return [SAMPLES_HEAD, *lines]


def other_targets(rows: Rows) -> Lines:
    """The same on other targets."""
    names = dict.fromkeys(row["experiment"] for row in rows)
    return [SAMPLES_HEAD, *(_over_samples(name.split(", ", 2)[2], rows, name, METHOD) for name in names)]


def _over_samples(name: str, rows: Rows, experiment: str, method: str) -> list[str]:
    """A line of SAMPLES_HEAD's columns."""
    before = _speed(rows, experiment, "unadapted", "target", 0)
    after = [_speed(rows, experiment, method, "adapted", samples) for samples in CURVE_SAMPLES]
    return [name, *(f"{speed} ({up})" if up else speed for speed, up, _ in (before, *after))]


def grounding(pixels: Rows) -> Lines:
    """What grounding learns from, at 200 samples."""
    methods = dict.fromkeys(row["method"] for row in pixels if row["samples"] == "200")
    lines = [["CartPole from pixels, after 200 samples", "m/s", "episodes up", "seeds"]]
    return lines + [[method, *_speed(pixels, PIXELS, method, "adapted", 200)] for method in methods]


def ablations(rows: Rows) -> Lines:
    """What each part of an adaptation is worth, one variant a line, in m/s."""

    def cell(row: Row) -> str:
        speed, up, _ = _speed_cells(row)
        return f"{speed} ({up})"

    return _by_method(
        rows, "mean cart speed in m/s (episodes up)", lambda row: row["experiment"].split(", ", 2)[2], cell
    )


def flight_ablations(rows: Rows) -> Lines:
    """The same of the vehicles, in m."""

    def cell(row: Row) -> str:
        return f"{mean_and_spread(row)} ({_failed(row)})"

    return _by_method(rows, "m (failed)", lambda row: VEHICLES[row["experiment"]][0], cell)


def _by_method(rows: Rows, head: str, label: Callable[[Row], str], cell: Callable[[Row], str]) -> Lines:
    """A line for each method with a cell for each experiment."""
    experiments = {row["experiment"]: label(row) for row in rows}
    lines = [[head, *experiments.values()]]
    for method in dict.fromkeys(row["method"] for row in rows):
        found = {row["experiment"]: row for row in rows if row["method"] == method}
        lines.append([method, *(cell(found[experiment]) for experiment in experiments)])
    return lines


def pendulum(rows: Rows) -> Lines:
    """InvertedPendulum-v5."""
    lines = [["InvertedPendulum-v5, mean cart speed in m/s", "counted samples", "here", "episodes up", "seeds"]]
    speeds = [row for row in rows if row["measure"] == "mean cart speed"]
    return lines + [
        [f"{row['method']}, {row['domain']}", f"{int(row['samples']):,}", *_speed_cells(row)] for row in speeds
    ]


def dm_control(rows: Rows) -> Lines:
    """dm_control's cart-pole, balance, beside what others have published."""
    lines = [["dm_control, balance, from pixels: return of at most 1,000", "steps of the suite", "return"]]
    for row in rows:
        spread = f" ± {float(row['std']):.0f}, {row['episodes']} episodes, seeds: {row['seeds']}"
        lines.append([f"ours, {row['domain']}", f"{int(row['samples']):,}", f"{float(row['mean']):.0f}{spread}"])
    return lines + [[f"{name} (published)", steps, earned] for name, steps, earned in DM_CONTROL]


def vehicles(rows: Rows) -> Lines:
    """The paper's vehicles beside ours, in m."""
    head = ("source", "before", "after: first round", "after: last round", "failed before, after")
    lines = [["m", "paper: source, before, after (samples)", *head]]
    for experiment, (name, paper) in VEHICLES.items():
        before, first, last = before_and_after(rows, experiment)
        source = next(row for row in rows if row["experiment"] == experiment and row["domain"] == "source")
        cells = [mean_and_spread(source), mean_and_spread(before)]
        cells += [f"{mean_and_spread(row)} ({int(row['samples']):,})" for row in (first, last)]
        lines.append([name, paper, *cells, f"{_failed(before)}, {_failed(last)}"])
    return lines


def residual(rows: Rows) -> Lines:
    """What is left of the quadrotor's gap, by counted samples."""
    return _by_samples(
        rows,
        "gap in velocity that is left",
        lambda row: f"{100 * float(row['mean']):.1f} ± {100 * float(row['std']):.1f} %",
    )


def collection(rows: Rows) -> Lines:
    """Who collects: the mismatch in mm/s and the error in mm, before, after the first and after the last round."""
    lines = [["", "delta in mm/s: before", "first round", "last", "error in mm: before", "first", "last"]]
    for name, method in dict.fromkeys((row["experiment"], row["method"]) for row in rows if row["domain"] == "adapted"):
        line = [f"{name.removesuffix(', data collection')}: {method}"]
        for unit in ("m/s", "m"):
            measured = [row for row in rows if (row["experiment"], row["unit"]) == (name, unit)]
            after = sorted((row for row in measured if row["method"] == method), key=lambda row: int(row["samples"]))
            for row in (*(row for row in measured if row["domain"] == "target"), after[0], after[-1]):
                samples = f" ({int(row['samples']):,})" if int(row["samples"]) else ""
                line.append(f"{1000 * float(row['mean']):.2f} ± {1000 * float(row['std']):.2f}{samples}")
        lines.append(line)
    return lines


def named(rows: Rows) -> Lines:
    """Named effects beside the residual, from very few samples, in m."""
    return _by_samples(rows, "quadrotor, drag: mean tracking error in m", mean_and_spread)


def named_control(rows: Rows) -> Lines:
    """Policies adapted by a residual, by what a diagnosis names, and with the true effect, in m/s."""
    samples = {row["method"]: int(row["samples"]) for row in rows}
    lines = [["mean cart speed in m/s (episodes up)", *(f"{m}, {n} samples" if n else m for m, n in samples.items())]]
    for experiment in dict.fromkeys(row["experiment"] for row in rows):
        own = {row["method"]: _speed_cells(row) for row in rows if row["experiment"] == experiment}
        cells = [f"{own[method][0]} ({own[method][1]})" for method in samples]
        lines.append([experiment.split(", ", 2)[2], *cells])
    return lines


def own_system(rows: Rows) -> Lines:
    """A rotary pendulum held upright under hidden effects: errors of its arm in mrad and rad/s."""
    samples = {row["method"]: int(row["samples"]) for row in rows}
    heads = [f"{method}, {count:,} samples" if count else method for method, count in samples.items()]
    lines = [["error of the arm in mrad, of its rate in rad/s (episodes upright)", *heads]]
    for experiment in dict.fromkeys(row["experiment"] for row in rows):
        line = [experiment.split(", ", 1)[1]]
        for method in samples:
            angle, rate = (row for row in rows if (row["experiment"], row["method"]) == (experiment, method))
            up = int(angle["episodes"]) - int(angle["failed"])
            errors = f"{1000 * float(angle['mean']):.1f}, {float(rate['mean']):.3f} " if up else ""
            line.append(f"{errors}({up} of {angle['episodes']})")
        lines.append(line)
    return lines


def rotorpy(rows: Rows) -> Lines:
    """rotorpy's multirotor, in m."""
    lines = [["rotorpy's Crazyflie, mean tracking error in m", "counted samples", "here", "within 1 m", "seeds"]]
    for row in rows:
        if row["measure"] == "mean tracking error":
            near = f"{int(row['episodes']) - int(row['failed'])} of {row['episodes']}"
            error = mean_and_spread(row, 3)
            lines.append([f"{row['method']}, {row['domain']}", f"{int(row['samples']):,}", error, near, row["seeds"]])
    return lines


def loops(rows: Rows) -> Lines:
    """The power loop, in m."""
    found = {(row["experiment"], row["measure"]): f"{float(row['mean']):.3f}" for row in rows}
    lines = [
        ["power loop, m", *(f"{speed} m/s" for speed in LOOP_SPEEDS)],
        ["paper, mean error", *LOOP_SPEEDS.values()],
    ]
    for name, shown in (("power loop", "radius 7 m"), ("power loop, tightest", "tightest radius")):
        for measure, short in (("mean tracking error", "mean error"), ("greatest tracking error", "greatest error")):
            lines.append([f"{shown}, {short}", *(found[f"{name}, {speed} m/s", measure] for speed in LOOP_SPEEDS)])
    return lines


def swing(rows: Rows) -> Lines:
    """The swing-up."""
    found = {row["measure"]: row for row in rows}
    whole = found["mean cart speed"]
    episodes = int(whole["episodes"])
    lines = [
        ["swing-up, 20,000 samples", "paper", "here"],
        ["episodes that succeed", "100 %", f"{episodes - int(whole['failed'])} of {episodes}"],
    ]
    for measure, paper in (
        ("mean cart speed", "0.29 m/s"),
        ("mean cart speed after 100 steps", ""),
        ("mean distance from the middle after 100 steps", "0.01 m"),
    ):
        lines.append([measure, paper, f"{mean_and_spread(found[measure], 3)} {found[measure]['unit']}"])
    return lines


def renderers(rows: Rows) -> Lines:
    """What a classical estimator reads from the frames of each renderer."""
    kinds = list(dict.fromkeys(row["method"] for row in rows))
    found = {(row["method"], row["measure"]): row for row in rows}
    lines = [["2,000 held-out states", *kinds]]
    for measure in dict.fromkeys(row["measure"] for row in rows):
        unit = next(row["unit"] for row in rows if row["measure"] == measure).replace("1", "")
        cells = [found.get((kind, measure)) for kind in kinds]
        lines.append(
            [f"{measure}{f', {unit}' if unit else ''}", *(f"{float(row['mean']):.3g}" if row else "" for row in cells)]
        )
    unread = [str(max(int(row["failed"]) for row in rows if row["method"] == kind)) for kind in kinds]
    return [*lines, ["frames from which no angle can be read", *unread]]


def action_times(rows: Rows) -> Lines:
    """PyTorch beside the exported file."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = [["one action, one core, ms", *methods, "ratio"]]
    for experiment in dict.fromkeys(row["experiment"] for row in rows):
        times = [float(row["mean"]) for row in rows if row["experiment"] == experiment]
        lines.append([experiment, *(f"{each:.2g}" for each in times), f"{times[0] / times[-1]:.1f}"])
    return lines


def headline(pixels: Rows, states: Rows, flights: Rows, crazyflie: Rows, diagnosed: Rows) -> Lines:
    """Six numbers: what is reached, from how many samples, and how often it fails."""
    lines = [["", "without", "with visadapt", "failed without, with", "target samples", "paper, with"]]
    alone = [row for row in pixels if row["method"] in ("unadapted", FRAMES_ALONE)]
    for name, rows, experiment, paper in (
        ("CartPole seen by a camera, force 2(sin t + 1) N: cart speed, m/s", alone, PIXELS, "0.29"),
        ("CartPole from states, constant 3.3 N: cart speed, m/s", states, CONSTANT, "0.09"),
        ("Quadrotor, drag: tracking error, m", flights, "quadrotor, drag", "0.07"),
        ("Quadrotor, force 2 cos t N: tracking error, m", flights, "quadrotor, 2 cos t", "figure 2"),
        ("rotorpy's Crazyflie in wind: tracking error, m", crazyflie, "rotorpy", ""),
    ):
        before, _, after = before_and_after(rows, experiment)
        fallen = before["failed"] == before["episodes"]
        lines.append(
            [
                name,
                "falls" if fallen else mean_and_spread(before, 3),
                mean_and_spread(after, 3),
                f"{_failed(before)}, {_failed(after)}",
                f"{int(after['samples']):,}",
                paper,
            ]
        )
    found = {row["diagnoser"]: row for row in diagnosed if (row["kind"], row["measure"]) == ("hard", SINGLE)}
    simple, ours = found["afternoon"], found["ours"]
    lines.append(
        [
            "Diagnosis, one hidden effect in 400 noisy rows: named",
            f"{100 * float(simple['value']):.0f} %",
            f"{100 * float(ours['value']):.0f} %",
            ", ".join(f"{round((1 - float(row['value'])) * int(row['n']))} of {row['n']}" for row in (simple, ours)),
            "400",
            "",
        ]
    )
    return lines


SINGLE = "single: named, nothing else"
"""Measure of the sealed check that the headline quotes."""


def before_and_after(rows: Rows, experiment: str) -> tuple[dict[str, str], dict[str, str], dict[str, str]]:
    """The unadapted policy on the target, and the last method's adapted one after the fewest and most samples."""
    own = [row for row in rows if row["experiment"] == experiment and not row["measure"].startswith("gap")]
    method = [row["method"] for row in own if row["domain"] == "adapted"][-1]
    after = sorted((row for row in own if row["method"] == method), key=lambda row: int(row["samples"]))
    before = next(row for row in own if (row["method"], row["domain"]) == ("unadapted", "target"))
    return before, after[0], after[-1]


def mean_and_spread(row: dict[str, str], digits: int = 4) -> str:
    """The mean and its standard deviation."""
    return f"{float(row['mean']):.{digits}f} ± {float(row['std']):.{digits}f}"


def _failed(row: dict[str, str]) -> str:
    return f"{row['failed']} of {row['episodes']}"


def _by_samples(rows: Rows, head: str, cell: Callable[[dict[str, str]], str]) -> Lines:
    """An experiment's methods, one a line, over counted samples."""
    found = {(row["method"], int(row["samples"])): row for row in rows}
    samples = sorted({count for _, count in found})
    methods: Iterable[str] = dict.fromkeys(method for method, _ in found)
    lines = [[head, *(f"{count:,} samples" for count in samples)]]
    return lines + [[method, *(cell(found[method, count]) for count in samples)] for method in methods]


def _speed(rows: Rows, experiment: str, method: str, domain: str, samples: int) -> list[str]:
    for row in rows:
        key = (row["experiment"], row["method"], row["domain"], row["samples"])
        if key == (experiment, method, domain, str(samples)):
            return _speed_cells(row)
    return ["not run", "", ""]


def _speed_cells(row: Row) -> list[str]:
    episodes, failed = int(row["episodes"]), int(row["failed"])
    speed = "unstable" if failed == episodes else mean_and_spread(row, 3)
    return [speed, f"{episodes - failed} of {episodes}", row["seeds"]]

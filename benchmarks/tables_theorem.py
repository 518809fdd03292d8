"""The tables of docs/paper.md that `benchmarks.theorem` measures: Theorem 1's terms, and Lipschitz constants."""

from __future__ import annotations

import numpy as np

from benchmarks.cartpole_states import CONSTANT
from benchmarks.tables_adaptation import Lines, Rows
from visadapt.systems import CartPole

PAPER = {CONSTANT: "56.7", "quadrotor, drag": "8.3", "fixed wing, drag": "41.2"}
"""L in Table 1"""


def theorem_1(rows: Rows) -> Lines:
    """Both sides of equation 8, a policy a line: means over seeds, of L the largest."""
    head = ["policy", "left", "δ", "L", "E of π - π̂", "ζ", "right", "holds", "right / left"]
    lines = [[*head, "right / left of equation 3", "seeds"]]
    for experiment, samples in dict.fromkeys((row["experiment"], row["samples"]) for row in rows):
        own = [row for row in rows if (row["experiment"], row["samples"]) == (experiment, samples)]
        left, delta, distance, zeta, right, ratio, control = (
            np.array([float(row[name]) for row in own])
            for name in ("left", "delta", "action_distance", "zeta", "right", "ratio", "control")
        )
        largest = max(float(row["lipschitz_between"]) for row in own)
        steps = min(float(row["steps_that_hold"]) for row in own)
        holds = "yes" if all(row["holds"] == "True" for row in own) else "no"
        policy = f"adapted with {int(samples):,} samples" if samples != "0" else "before"
        name = experiment.removeprefix("CartPole, states, ")
        lines.append(
            [
                f"{'CartPole' if name != experiment else ''} {name}, {policy}".strip(),
                *(f"{mean:.3f}" for mean in (left.mean(), delta.mean(), largest, distance.mean(), zeta.mean())),
                f"{right.mean():.3f}",
                f"{holds}, at {100 * steps:.4g} % of steps",
                _spread(ratio),
                _spread((delta + control) / left),
                str(len(own)),
            ]
        )
    return lines


def _spread(values: np.ndarray) -> str:
    return f"{values.mean():.2f} ± {values.std():.2f}" if len(values) > 1 else f"{values.mean():.2f}"


def lipschitz(rows: Rows) -> Lines:
    """Lipschitz constants of the sources at the states that the unadapted policies meet in the target."""
    head = ["L of the source", "paper", "a step: median, largest", "the rate of change, 1/s: median, largest"]
    lines = [[*head, "a step, per N"]]
    for experiment, paper in PAPER.items():
        own = [row for row in rows if (row["experiment"], row["samples"]) == (experiment, "0")]
        cells = []
        for kind in ("lipschitz", "rate_lipschitz"):
            median = np.mean([float(row[f"{kind}_median"]) for row in own])
            cells.append(f"{median:.3f}, {max(float(row[f'{kind}_max']) for row in own):.3f}")
        newton = ""
        if experiment == CONSTANT:  # a command of which is a force
            newton = f"{max(float(row['lipschitz_max']) for row in own) / float(CartPole.max_force):.4f}"
        lines.append([own[0]["system"].replace("_", " "), paper, *cells, newton])
    return lines

"""A ball on a beam, which dry friction stops again and again, with and without what the diagnosis does about that.

    python -m benchmarks.sticking

The only hidden effect is a dry friction of the ball of 0.015 N. A camera sees the ball 30 times a second, to 1 mm. The
catalogue has the three frictions that are easily taken for each other: Coulomb's, one that differs by direction, and
viscous friction. Left out are, one at a time and both, the fits from states at which the ball rests, and the verified
steps to the states from which predictions start (visadapt/estimation/iterated_smoother.py).

Writes results/sticking.csv. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import visadapt as va
from benchmarks.blind.ablations import without
from experiments.ball_beam import PERIOD, BallBeam, balanced
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import Row, write_rows
from visadapt.effects.catalogue import catalogue
from visadapt.storage.run_folder import once, open_run

FORCE, ROWS = 0.015, 3000
HELD, FARTHEST = 3.0, 0.2  # s for which the ball is sent to one place, and m of that from the middle of the beam
PARTS = ("fits at rest", "verified states")
METHODS = {"as shipped": (), **{f"without {part}": (part,) for part in PARTS}, "without either": PARTS}
NAMED, ERROR, NOISES, WORST = (
    "Coulomb friction identified, alone",
    "error of its force, median",
    "prediction error over the noise floor, median",
    "the same, of the worst recording",
)


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 6
    """recordings"""
    jobs: Jobs = 2
    """recordings at once, one core each"""
    work: Path = Path("runs/sticking")
    out: Path = Path("results/sticking.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    found = in_processes(_judged, settings, [(method, seed) for method in METHODS for seed in range(settings.seeds)])
    rows = []
    for method in METHODS:
        answers = [answer for (how, _), answer in found.items() if how == method]
        errors = [each["error"] for each in answers if each["error"] is not None]
        noises = [each["noises"] for each in answers]
        numbers = {
            NAMED: float(np.mean([each["named"] for each in answers])),
            ERROR: float(np.median(errors)) if errors else float("nan"),
            NOISES: float(np.median(noises)),
            WORST: max(noises),
        }
        about = ("ball on a beam, dry friction", "ball_beam", method, "target", ROWS)
        for measure, number in numbers.items():
            unit = "1" if measure in (NOISES, WORST) else "share"
            rows.append(Row(*about, measure, unit, round(number, 4), None, len(answers), 0, settings.seeds))
    write_rows(settings.out, rows)
    for row in rows:
        print(f"{row.method:32} {row.measure:48} {row.mean:.4f}")


def _judged(settings: Settings, method: str, seed: int) -> dict[str, Any]:
    torch.set_num_threads(1)
    folder = settings.work / method.replace(" ", "-") / str(seed)
    open_run(folder, {"seed": seed, "force": FORCE, "rows": ROWS})
    with ExitStack() as stack:
        for part in METHODS[method]:
            stack.enter_context(without(part))
        return once(folder / "outcome.json", lambda: _outcome(seed))


def _outcome(seed: int) -> dict[str, Any]:
    by_name = {effect.name: effect for effect in catalogue(BallBeam())}
    searched = [by_name[f"track.{kind}_friction"] for kind in ("coulomb", "directional", "viscous")]
    goals = np.random.default_rng(seed).uniform(-FARTHEST, FARTHEST, round(ROWS * PERIOD / HELD))
    recording, _ = balanced([searched[0](force=FORCE)], seed, ROWS, lambda time: float(goals[int(time / HELD)]))
    found = va.diagnose(recording, va.World(BallBeam(), (), PERIOD), searched)
    causes = {cause.effect: cause for cause in (*found.causes, *found.partial) if not cause.slight}
    friction = causes.get(searched[0].name)
    return {
        "named": found.verdict == "identified" and list(causes) == [searched[0].name],
        "error": abs(friction.parameters["force"].value / FORCE - 1) if friction else None,
        "noises": found.gap.after / found.gap.floor,
    }


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

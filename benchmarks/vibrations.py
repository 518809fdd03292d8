"""One hidden effect beside a vibration that no effect in the catalogue describes, with white and with coloured noise.

    python -m benchmarks.vibrations

The source policy runs on a cart-pole with the effect and a force of 4 N at 3.3 Hz: 600 noisy rows, diagnosed without
the periodic force in the catalogue. Once as `visadapt diagnose` does, whose search goes on with the colour of what is
unexplained as noise (visadapt/diagnosis/search/coloured.py), and once without that. Counted are the effects that
are named, or said to explain a part.

Writes results/vibrations.csv. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import tyro

import visadapt as va
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import Row, write_rows
from visadapt import effects
from visadapt.diagnosis import exploration
from visadapt.effects.catalogue import catalogue as every_effect
from visadapt.storage.run_folder import once, open_run
from visadapt.weights import shipped

STATES = ("x", "x_dot", "theta", "theta_dot")
NOISE = 1e-3  # Standard deviation of the measurement noise, in m, m/s, rad and rad/s
EPISODES, ROWS = 4, 150
HIDDEN: Mapping[str, Callable[[], va.Effect]] = {
    "viscous friction 2 N s/m": lambda: effects.ViscousFriction(coefficient=2.0),
    "dry friction 2 N": lambda: effects.CoulombFriction(force=2.0),
    "gain 0.8": lambda: effects.ActuatorGain(scale=0.8),
}
WHITE, COLOURED = "white noise alone", "and its colour"
NAMED, ERROR, COVERED, OTHERS, CLOSED = (
    "hidden effect named",
    "parameter error, median",
    "90 % interval covers",
    "other effects named, a recording",
    "gap closed, median",
)


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 4
    """recordings of each hidden effect"""
    jobs: Jobs = 2
    """recordings at once, one core each"""
    work: Path = Path("runs/vibrations")
    out: Path = Path("results/vibrations.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    jobs = [(name, method, seed) for name in HIDDEN for method in (WHITE, COLOURED) for seed in range(settings.seeds)]
    found = in_processes(_judged, settings, jobs)
    rows = []
    for method in (WHITE, COLOURED):
        answers = [answer for (_, how, _), answer in found.items() if how == method]
        named = [each for each in answers if each["error"] is not None]
        numbers = {
            NAMED: len(named) / len(answers),
            ERROR: float(np.median([each["error"] for each in named])) if named else float("nan"),
            COVERED: float(np.mean([each["covered"] for each in named])) if named else float("nan"),
            OTHERS: float(np.mean([each["others"] for each in answers])),
            CLOSED: float(np.median([each["closed"] for each in answers])),
        }
        about = ("CartPole, states, one hidden effect and a vibration", "cartpole", method, "target", EPISODES * ROWS)
        for measure, number in numbers.items():
            unit = "1" if measure == OTHERS else "share"
            rows.append(Row(*about, measure, unit, round(number, 4), None, len(answers), 0, settings.seeds))
    write_rows(settings.out, rows)
    for row in rows:
        print(f"{row.method:24} {row.measure:36} {row.mean:.3f}")


def _judged(settings: Settings, name: str, method: str, seed: int) -> dict[str, Any]:
    torch.set_num_threads(1)
    folder = settings.work / f"{name} {method}".replace(" ", "-").replace("/", "-") / str(seed)
    open_run(folder, {"hidden": name, "seed": seed, "noise": NOISE, "rows": EPISODES * ROWS})
    if method == WHITE:
        with patch.object(exploration, "with_coloured_noise", lambda search, comparison, *_: (search, comparison)):
            return once(folder / "outcome.json", lambda: _outcome(HIDDEN[name](), seed))
    return once(folder / "outcome.json", lambda: _outcome(HIDDEN[name](), seed))


def _outcome(hidden: va.Effect, seed: int) -> dict[str, Any]:
    vibration = effects.PeriodicForce(amplitude=4.0, frequency=3.3, phase=0.3, offset=0.0)
    target = va.SyntheticTarget(lambda batch, generator: [hidden, vibration])
    policy, rng = va.load_policy(shipped("cartpole_states")), np.random.default_rng(seed)
    runs = va.run(target, policy, EPISODES, ROWS, torch.Generator().manual_seed(seed), exploration=0.3)
    noisy = []
    for run in runs:
        state = run.episode.state
        assert state is not None
        noisy.append(replace(run.episode, state=state + NOISE * rng.standard_normal(state.shape)))
    source = va.World(va.CartPole())
    catalogue = [effect for effect in every_effect(source.system) if effect is not effects.PeriodicForce]
    found = va.diagnose(va.Recording(tuple(noisy), STATES, source.period, ("vibrating",) * EPISODES), source, catalogue)
    causes = {cause.effect: cause for cause in (*found.causes, *found.partial) if not cause.slight}
    alike = {hidden.name, *(causes[hidden.name].indistinguishable_from if hidden.name in causes else ())}
    out = {"closed": found.gap.closed, "others": len(causes.keys() - alike), "error": None, "covered": None}
    if hidden.name in causes:
        name = hidden.table[0].name
        one, true = causes[hidden.name].parameters[name], float(getattr(hidden, name))
        out |= {"error": abs(one.value / true - 1), "covered": one.ci90[0] <= true <= one.ci90[1]}
    return out


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

"""What a name is worth: named effects beside the residual, right and wrong, from very few samples.

    python -m benchmarks.named_effects

The quadrotor under a drag of 0.3 1/s, as in `benchmarks.flight`, adapted from 20, 50 and 100 counted samples in one
round: with the residual alone; with drag as an effect whose coefficient is fitted beside it (the paper, A.3.3: "almost
immediate closure of the dynamics gap"); and with a wrong name in its place.

Writes results/named_effects.csv. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from datasets import quadrotor_references
from experiments.flights import EXPERIMENTS, flight_target
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import miss_row, write_rows
from visadapt.effects import ConstantForce, Effect, LinearDrag, ThrustGain
from visadapt.evaluation import FlightScore
from visadapt.setups.flight import quadrotor
from visadapt.storage.run_folder import open_run
from visadapt.systems import Quadrotor
from visadapt.weights import shipped
from visadapt.world import World

EXPERIMENT = EXPERIMENTS["quadrotor, drag"]
BUDGETS = (20, 50, 100)
NAMES: dict[str, Callable[[], Sequence[Effect]]] = {
    "residual alone": tuple,
    "drag named, and residual": lambda: (LinearDrag(coefficient=0.0),),
    "constant force named (wrong), and residual": lambda: (ConstantForce(force=0.0),),
    "thrust gain named (wrong), and residual": lambda: (ThrustGain(scale=1.0),),
}


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    flights: int = 100
    jobs: Jobs = 2
    """runs at once, one core each"""
    work: Path = Path("runs/named_effects")
    out: Path = Path("results/named_effects.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    jobs = [(name, budget, seed) for name in NAMES for budget in BUDGETS for seed in range(settings.seeds)]
    found = in_processes(_scored, settings, jobs)
    rows = []
    for name in NAMES:
        for budget in BUDGETS:
            scores = [found[name, budget, seed] for seed in range(settings.seeds)]
            label = ("quadrotor, drag, named effects", "quadrotor", name, "adapted", budget, EXPERIMENT.measure)
            rows.append(miss_row(*label, scores))
    write_rows(settings.out, rows)
    for row in rows:
        print(f"{row.method:44} {row.samples:4} samples  {row.mean:.4f} +- {row.std:.4f} m")


def _scored(settings: Settings, name: str, budget: int, seed: int) -> FlightScore:
    torch.set_num_threads(1)
    train, test = quadrotor_references.ready()
    setup = quadrotor(train, test, World(Quadrotor(), NAMES[name](), train.period, substeps=2))
    folder = settings.work / name.replace(" ", "-").replace(",", "") / f"{budget}-{seed}"
    open_run(folder, {"seed": seed, "flights": settings.flights, "budget": budget, **setup.settings.numbers()})
    policy = setup.load(shipped("quadrotor"))
    hidden = EXPERIMENT.effects(setup)
    setup.adapt(policy, flight_target(setup, hidden, test=False), folder, budget, budget, seed)
    return kept_score(folder / "score.json", policy, flight_target(setup, hidden), settings.flights)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

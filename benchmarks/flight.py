"""The paper's vehicles under disturbances: drag (its Tables 1 and 3) and a force that changes (its section 3.2.2).

    python -m benchmarks.flight

The quadrotor follows random references, the fixed wing flies through a point 50 m ahead. Each has one source policy
(shipped, from train.flight_policies), and each seed adapts it: to a drag of 0.3 1/s with a residual that sees one
state, to 2 cos(t + phase) N, a phase for each flight, with a residual that sees five; that force acts along x on the
quadrotor, and across the way ahead, along y, on the wing (A.2.1). Scored on 100 flights that were not trained on, as it
stands after every round.

Writes results/flight.csv, and two pictures: assets/curve_flight.png, the misses over the samples, and
assets/alternation.png, the losses of the first seed of the quadrotor under drag (the paper's figure 5). Interrupt it
anywhere; started again, it goes on.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from datasets import quadrotor_references
from experiments.curves import Chart, plot_charts, plot_losses
from experiments.flights import EXPERIMENTS, flight_target
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import miss_row, read_rows, write_rows
from visadapt.evaluation import FlightScore
from visadapt.policies import Policy
from visadapt.setups.base import Setup
from visadapt.targets.synthetic import DrawEffects, no_effects
from visadapt.weights import shipped

OURS = "ours, states"
ALTERNATION = "quadrotor, drag"
"""whose losses are drawn"""


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    experiments: tuple[str, ...] = tuple(EXPERIMENTS)
    """which of EXPERIMENTS are run and tabled"""
    flights: int = 100
    """that each policy is scored on"""
    jobs: Jobs = 2
    """seeds at once, one core each"""
    pictures: Path = Path("assets")
    work: Path = Path("runs/flight")
    out: Path = Path("results/flight.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    for name in settings.experiments:
        prepared(name)  # before the jobs, which share the references
    jobs = [(name, seed) for name in settings.experiments for seed in range(settings.seeds)]
    found = in_processes(_scores, settings, jobs)
    rows = []
    for name in settings.experiments:
        kind, measure = EXPERIMENTS[name].vehicle.name, EXPERIMENTS[name].measure
        scores = [found[name, seed] for seed in range(settings.seeds)]
        for key in scores[0]:
            if key in ("source", "target"):  # one policy, which all seeds share
                rows.append(miss_row(name, kind, "unadapted", key, 0, measure, [scores[0][key]]))
            else:
                own = [each[key] for each in scores]
                rows.append(miss_row(name, kind, OURS, "adapted", int(key), measure, own))
    write_rows(settings.out, rows)
    _draw(settings)
    for row in rows:
        print(f"{row.experiment:20} {row.domain:8} {row.samples:5} samples  {row.mean:.4f} +- {row.std:.4f} m")


def _draw(settings: Settings) -> None:
    """The table's curves; and the losses of an adaptation, where it is one of those that were run."""
    rows = read_rows(settings.out)
    panels = []
    for name in settings.experiments:
        own = [row for row in rows if row["experiment"] == name]
        panels.append(Chart(name, f"{EXPERIMENTS[name].measure}, m", own))
    plot_charts(settings.pictures / "curve_flight.png", panels, columns=min(2, len(panels)))
    if ALTERNATION in settings.experiments:
        setup, policy = prepared(ALTERNATION)
        adapted = EXPERIMENTS[ALTERNATION].adapt(setup, settings.work, policy, seed=0)
        plot_losses(settings.pictures / "alternation.png", adapted.rounds)


def prepared(name: str) -> tuple[Setup, Policy]:
    """The setup of an experiment, and the vehicle's policy of the source, which all seeds share."""
    setup = EXPERIMENTS[name].setup(quadrotor_references.ready)
    return setup, setup.load(shipped(EXPERIMENTS[name].vehicle.name))


def _scores(settings: Settings, name: str, seed: int) -> dict[str, FlightScore]:
    """Scores of one seed of an experiment, by samples; before adaptation by domain."""
    torch.set_num_threads(1)
    experiment = EXPERIMENTS[name]
    setup, policy = prepared(name)
    folder = experiment.open(setup, settings.work, seed, settings.flights)
    adapting = copy.deepcopy(policy)
    adapted = experiment.adapt(setup, settings.work, adapting, seed)

    def scored(key: str, draw_effects: DrawEffects, which: Policy) -> FlightScore:
        return kept_score(folder / f"{key}.json", which, flight_target(setup, draw_effects), settings.flights)

    hidden = experiment.effects(setup)
    found = {"source": scored("source", no_effects, policy), "target": scored("target", hidden, policy)}
    for samples in [each.samples for each in adapted.rounds]:
        adapted.restore(adapting, samples)
        found[str(samples)] = scored(str(samples), hidden, adapting)
    return found


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

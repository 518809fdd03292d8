"""The paper's vehicles under disturbances: drag (its Tables 1 and 3) and a force that changes (its section 3.2.2).

    python -m benchmarks.flight

The quadrotor follows random references, the fixed wing flies through a point 50 m ahead. Each has one source policy
(assets/, from train.flight_policies), and each seed adapts it: to a drag of 0.3 1/s with a residual that sees one
state, to 2 cos(t + phase) N, a phase for each flight, with a residual that sees five; that force acts along x on the
quadrotor, and across the way ahead, along y, on the wing (A.2.1). Scored on 100 flights that were not trained on, as it
stands after every round.

Writes results/flight.csv, and two pictures: assets/curve_flight.png, the misses over the samples, and
assets/alternation.png, the losses of the first seed of the quadrotor under drag (the paper's figure 5). Interrupt it
anywhere; started again, it goes on.
"""

from __future__ import annotations

import copy
import math
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

from train.flight_policies import made
from visadapt.effects import Effect, LinearDrag, PeriodicForce
from visadapt.evaluation.result_tables import miss_row, read_rows, write_rows
from visadapt.films.plots import Chart, plot_charts, plot_losses
from visadapt.learning.joint import Adapted
from visadapt.policies import FlightPolicy, Policy
from visadapt.progress import Report
from visadapt.setups.flight import Flight, FlightScore, kept_score
from visadapt.storage.run_folder import open_run
from visadapt.systems import FixedWing, Quadrotor, RigidBody, System
from visadapt.targets.synthetic import DrawEffects, no_effects

DRAG = 0.3
"""1/s, r in v' = ... - r v"""
SCORE_SEED = 2026
OURS = "ours, states"
MEASURES: dict[type[RigidBody], str] = {Quadrotor: "mean tracking error", FixedWing: "miss of the target"}


@dataclass(frozen=True)
class Experiment:
    """A vehicle, what is hidden in its target, and the samples it is given."""

    vehicle: type[RigidBody]
    hidden: str
    """drag, or force"""
    budget: int
    round_samples: int


EXPERIMENTS = {
    "quadrotor, drag": Experiment(Quadrotor, "drag", 1000, 200),
    "fixed wing, drag": Experiment(FixedWing, "drag", 2000, 400),
    "quadrotor, 2 cos t": Experiment(Quadrotor, "force", 1000, 200),
    "fixed wing, 2 cos t": Experiment(FixedWing, "force", 2000, 400),
}
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
    jobs: int = 2
    """seeds at once, one core each"""
    references: Path = Path("data/quadrotor_references.npz")
    """made where it is not there"""
    assets: Path = Path("assets")
    work: Path = Path("runs/flight")
    out: Path = Path("results/flight.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    for name in settings.experiments:  # before the jobs, which share references and source policies
        source_policy(settings.assets, vehicle(EXPERIMENTS[name], settings.references))
    jobs = [(name, seed) for name in settings.experiments for seed in range(settings.seeds)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(settings.jobs, mp_context=context) as pool:
        found = dict(zip(jobs, pool.map(_scores, [settings] * len(jobs), *zip(*jobs, strict=True)), strict=True))
    rows = []
    for name in settings.experiments:
        kind = EXPERIMENTS[name].vehicle
        scores = [found[name, seed] for seed in range(settings.seeds)]
        for key in scores[0]:
            if key in ("source", "target"):  # one policy, which all seeds share
                rows.append(miss_row(name, kind.name, "unadapted", key, 0, MEASURES[kind], [scores[0][key]]))
            else:
                own = [each[key] for each in scores]
                rows.append(miss_row(name, kind.name, OURS, "adapted", int(key), MEASURES[kind], own))
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
        panels.append(Chart(name, f"{MEASURES[EXPERIMENTS[name].vehicle]}, m", own))
    plot_charts(settings.assets / "curve_flight.png", panels, columns=min(2, len(panels)))
    if ALTERNATION in settings.experiments:
        flight = vehicle(EXPERIMENTS[ALTERNATION], settings.references)
        adapted = adapt(flight, ALTERNATION, settings.work, source_policy(settings.assets, flight), seed=0)
        plot_losses(settings.assets / "alternation.png", adapted.rounds)


class SidePush(PeriodicForce):
    """A push along y that comes and goes. It has no name of its own, and so is in no catalogue."""

    systems = (RigidBody,)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return super().load(time, state, system).roll(1, -1)


def vehicle(experiment: Experiment, references: Path) -> Flight:
    """The vehicle of an experiment, and its courses."""
    return made(experiment.vehicle.name, references)


def hidden(experiment: Experiment, mass: float) -> DrawEffects:
    """What is hidden in the target."""

    def drag(batch: int, generator: torch.Generator) -> Sequence[Effect]:
        return (LinearDrag(coefficient=DRAG * mass),)

    def force(batch: int, generator: torch.Generator) -> Sequence[Effect]:
        phase = math.pi * (2 * torch.rand(batch, generator=generator) - 1)
        kind = SidePush if experiment.vehicle is FixedWing else PeriodicForce
        return (kind(amplitude=2.0, frequency=1 / (2 * math.pi), phase=phase, offset=0.0),)

    return drag if experiment.hidden == "drag" else force


def _scores(settings: Settings, name: str, seed: int) -> dict[str, FlightScore]:
    """Scores of one seed of an experiment, by samples; before adaptation by domain."""
    torch.set_num_threads(1)
    experiment = EXPERIMENTS[name]
    flight = vehicle(experiment, settings.references)
    folder = opened(flight, name, settings.work, seed, settings.flights)
    draw = hidden(experiment, float(flight.system.mass))
    policy = source_policy(settings.assets, flight)
    adapting = copy.deepcopy(policy)
    adapted = adapt(flight, name, settings.work, adapting, seed)

    def scored(key: str, draws: DrawEffects, which: FlightPolicy) -> FlightScore:
        return kept_score(folder / f"{key}.json", flight.target(draws), which, SCORE_SEED, settings.flights)

    found = {"source": scored("source", no_effects, policy), "target": scored("target", draw, policy)}
    for samples in [each.samples for each in adapted.rounds]:
        adapted.restore(adapting, samples)
        found[str(samples)] = scored(str(samples), draw, adapting)
    return found


def opened(flight: Flight, name: str, work: Path, seed: int, flights: int) -> Path:
    """The folder under `work` of a seed of the experiment `name`, whose policies are scored on `flights`."""
    folder = _folder(work, name, seed)
    own = {**asdict(EXPERIMENTS[name]), "vehicle": flight.system.name}
    open_run(folder, {"seed": seed, "flights": flights, **own, **asdict(flight.settings)})
    return folder


def adapt(
    flight: Flight,
    name: str,
    work: Path,
    policy: FlightPolicy,
    seed: int,
    report: Report | None = None,
    explorer: Policy | None = None,
    reach: float = math.inf,
) -> Adapted:
    """Adapt `policy`, in place, to the target of the experiment `name`, going on from what is in `work`.

    With an `explorer` it is that policy that collects the data, in flights that end `reach` m off their course.
    """
    experiment = EXPERIMENTS[name]
    return flight.adapt(
        policy,
        flight.target(hidden(experiment, float(flight.system.mass)), test=False, reach=reach),
        _folder(work, name, seed),
        experiment.budget,
        experiment.round_samples,
        seed,
        with_history=experiment.hidden == "force",
        report=report,
        explorer=explorer,
    )


def _folder(work: Path, name: str, seed: int) -> Path:
    return work / name.replace(", ", "-").replace(" ", "-") / f"seed-{seed}"


def source_policy(assets: Path, flight: Flight) -> FlightPolicy:
    """The vehicle's policy of the source, which all seeds share."""
    return flight.pretrain(assets / f"{flight.system.name}.safetensors", 0)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

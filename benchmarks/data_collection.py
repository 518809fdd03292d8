"""Who is to collect the target's data (the paper's figures 2 and 6): the policy that is tuned, an MPC, or a random one.

    python -m benchmarks.data_collection

The experiments of `benchmarks.flight`, whose own adaptations are those with data of the current policy: where they are
kept, they are read. The random policy wanders about hover or level flight, on the same courses. The MPC
(`benchmarks.baselines.mpc`) plans in the source with the residual as it was fitted in the round before. A flight of
either of these two ends once it is 5 m off its course; all its samples count. Nothing else differs. After every round
the policy flies 100 courses that were not trained on, and nothing is learnt from these flights. They give its mean
miss and the dynamics mismatch delta (equation 6): the mean norm of the velocity error of one step of the simulator with
the residual.

Writes results/data_collection.csv and assets/data_collection.png. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from benchmarks.flight import prepared
from experiments.curves import Chart, plot_charts
from experiments.flights import EXPERIMENTS, flight_target
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import Row, miss_row, read_rows, write_rows
from visadapt.effects import Residual
from visadapt.evaluation import SCORE_SEED, FlightScore
from visadapt.learning.grounding import gap, gap_with_residual
from visadapt.learning.transitions import Transitions
from visadapt.policies import AutoregressivePolicy, Policy
from visadapt.setups.base import Setup
from visadapt.storage.run_folder import once
from visadapt.systems import FixedWing, Quadrotor
from visadapt.systems.rigid_body import VELOCITY
from visadapt.targets.rollout import run
from visadapt.tasks.reach import Reach

REACH = 5.0
"""m off its course at which a flight of another policy than the current one ends"""
LASTING = 1.0
"""s after which a random command is forgotten, but for a share of 1/e"""
MISMATCH = "dynamics mismatch in velocity"


def random_policy(setup: Setup, learner: Policy) -> Policy:
    """Commands that wander about hover, or about level flight."""
    system = setup.source.system
    if isinstance(system, Quadrotor):
        rest = torch.tensor([float(system.hover()), 0.0, 0.0, 0.0])
    else:
        assert isinstance(system, FixedWing)
        rest = system.trim(torch.tensor([Reach.speed]))[1][0]
    return AutoregressivePolicy(len(system.states), rest, math.exp(-setup.source.period / LASTING))


def mpc(setup: Setup, learner: Policy) -> Policy:
    """An MPC that plans with the residual that `learner` reads, as it stands."""
    from benchmarks.baselines.mpc import following  # whose CasADi no other collector needs

    return following(setup, learner)


CURRENT = "data of the current policy"
EXPLORERS: dict[str, Callable[[Setup, Policy], Policy]] = {
    "data of a random policy": random_policy,
    "data of the MPC": mpc,
}
"""Who else may collect: of a setup, and the policy that is tuned."""


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    experiments: tuple[str, ...] = tuple(EXPERIMENTS)
    flights: int = 100
    """that each policy is scored on"""
    jobs: Jobs = 2
    """seeds at once, one core each"""
    current: Path = Path("runs/flight")
    """where benchmarks.flight keeps its adaptations"""
    work: Path = Path("runs/data_collection")
    out: Path = Path("results/data_collection.csv")
    picture: Path = Path("assets/data_collection.png")


@dataclass(frozen=True)
class Stand:
    """How a policy, and the simulator that it was tuned in, do on flights in the target."""

    score: FlightScore
    mismatch: float
    """m/s"""


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    methods = (CURRENT, *EXPLORERS)
    before = {name: _before(settings, name) for name in settings.experiments}  # and references are made, for the jobs
    jobs = [(name, by, seed) for seed in range(settings.seeds) for name in settings.experiments for by in methods]
    found = in_processes(_stands, settings, jobs)
    rows = []
    for name in settings.experiments:
        rows += _rows(name, "unadapted", "target", 0, [before[name]])
        for by in methods:
            seeds = [found[name, by, seed] for seed in range(settings.seeds)]
            for samples in seeds[0]:
                rows += _rows(name, by, "adapted", samples, [each[samples] for each in seeds])
    write_rows(settings.out, rows)
    _draw(settings)
    for row in rows:
        spread = f"{row.mean:.5f} +- {row.std:.5f} {row.unit}"
        print(f"{row.experiment:18} {row.method:26} {row.samples:5} samples  {row.measure:30} {spread}")


def _draw(settings: Settings) -> None:
    """Mismatch above, miss below, an experiment in each column."""
    panels = {}
    rows = read_rows(settings.out)
    for name in settings.experiments:
        for measure, unit in ((MISMATCH, "m/s"), (EXPERIMENTS[name].measure, "m")):
            own = [row for row in rows if row["experiment"] == label(name) and row["measure"] == measure]
            panels[measure == MISMATCH, name] = Chart(name, f"{measure}, {unit}", own)
    ordered = [panels[first, name] for first in (True, False) for name in settings.experiments]
    plot_charts(settings.picture, ordered, columns=len(settings.experiments))


def label(name: str) -> str:
    """What the table calls an experiment here."""
    return f"{name}, data collection"


def _rows(name: str, method: str, domain: str, samples: int, seeds: list[Stand]) -> list[Row]:
    """What the seeds of a method missed by, and their mismatch with its spread over them."""
    kind, measure = EXPERIMENTS[name].vehicle.name, EXPERIMENTS[name].measure
    missed = miss_row(label(name), kind, method, domain, samples, measure, [each.score for each in seeds])
    mismatches = [each.mismatch for each in seeds]
    mismatch = Row(
        experiment=label(name),
        system=kind,
        method=method,
        domain=domain,
        samples=samples,
        measure=MISMATCH,
        unit="m/s",
        mean=round(float(np.mean(mismatches)), 6),
        std=round(float(np.std(mismatches)), 6),
        episodes=missed.episodes,
        failed=missed.failed,
        seeds=len(seeds),
    )
    return [missed, mismatch]


def _before(settings: Settings, name: str) -> Stand:
    """The policy of the source, in the target."""
    setup, policy = prepared(name)
    folder = EXPERIMENTS[name].open(setup, settings.current, 0, settings.flights)
    return _stand(settings, setup, name, folder, "target", policy)


def _stands(settings: Settings, name: str, by: str, seed: int) -> dict[int, Stand]:
    """One seed with data collected `by` one of the methods, by samples."""
    torch.set_num_threads(1)
    experiment = EXPERIMENTS[name]
    setup, policy = prepared(name)
    explorer = EXPLORERS[by](setup, policy) if by in EXPLORERS else None
    work = settings.current if explorer is None else settings.work / by.replace(" ", "-")
    folder = experiment.open(setup, work, seed, settings.flights)
    reach = math.inf if explorer is None else REACH
    adapted = experiment.adapt(setup, work, policy, seed, explorer=explorer, reach=reach)
    found = {}
    for samples in [each.samples for each in adapted.rounds]:
        adapted.restore(policy, samples)
        found[samples] = _stand(settings, setup, name, folder, str(samples), policy)
    return found


def _stand(settings: Settings, setup: Setup, name: str, folder: Path, key: str, policy: Policy) -> Stand:
    """How `policy` stands, kept in `folder` under `key`."""
    target = flight_target(setup, EXPERIMENTS[name].effects(setup))
    found = kept_score(folder / f"{key}.json", policy, target, settings.flights)

    def mismatch() -> dict[str, float]:
        generator = torch.Generator().manual_seed(SCORE_SEED)
        flown = run(target, policy, settings.flights, target.task.steps, generator, strict=False)
        transitions = Transitions.cut([each.episode for each in flown])
        return {"mean": float(_error(policy.residual, setup, transitions)[:, VELOCITY].norm(dim=1).mean())}

    return Stand(found, once(folder / f"mismatch-{key}.json", mismatch)["mean"])


def _error(residual: Residual | None, setup: Setup, transitions: Transitions) -> torch.Tensor:
    """Of one step of the simulator (N, n_state)."""
    source = setup.source
    return gap(source, transitions) if residual is None else gap_with_residual(residual, source, transitions)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

"""What each part of an adaptation is worth to the paper's vehicles, under a force that changes, after one round.

    python -m benchmarks.ablations_flight

Each seed adapts the shipped source policy anew, as shipped and with a part left out, to 2 cos(t + phase) N, and is
scored on flights that were not trained on. No score chooses anything. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

from benchmarks.ablations import with_an_mlp
from datasets import quadrotor_references
from experiments.flights import EXPERIMENTS, flight_target
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import miss_row, write_rows
from visadapt.evaluation import FlightScore
from visadapt.policies import Policy
from visadapt.policies.flight import FlightPolicy
from visadapt.setups.base import Setup
from visadapt.setups.policy_file import residual_for
from visadapt.weights import shipped

VEHICLES = ("quadrotor, 2 cos t", "fixed wing, 2 cos t")
UNADAPTED = "unadapted"


def without_history(setup: Setup, policy: Policy) -> Setup:
    """The residual reads one state, and the policy no disturbance estimate."""
    return replace(setup, residual=residual_for)


def without_disturbance_estimate(setup: Setup, policy: Policy) -> Setup:
    """The residual reads the history, but the policy reads the residual's correction alone."""
    assert isinstance(policy, FlightPolicy)
    for layer in (policy.disturbance_in, policy.disturbance_out):  # zero in the source, where there is no estimate
        layer.requires_grad_(False)
    return setup


def with_output_layers_alone(setup: Setup, policy: Policy) -> Setup:
    """Of the policy, the maps to its commands alone are tuned."""
    assert isinstance(policy, FlightPolicy)
    policy.requires_grad_(False)
    for layer in (policy.out, policy.skip, policy.disturbance_out):
        layer.requires_grad_(True)
    return setup


VARIANTS: dict[str, Callable[[Setup, Policy], Setup]] = {
    "as shipped": lambda setup, policy: setup,
    "no history": without_history,
    "no disturbance estimate": without_disturbance_estimate,
    "MLP residual": with_an_mlp,
    "output layers alone": with_output_layers_alone,
}


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 2
    flights: int = 100
    """that each policy is scored on"""
    experiments: tuple[str, ...] = VEHICLES
    """which of experiments.flights.EXPERIMENTS"""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """which of VARIANTS"""
    jobs: Jobs = 2
    """adaptations at once, one core each"""
    work: Path = Path("runs/ablations_flight")
    out: Path = Path("results/ablations_flight.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    quadrotor_references.ready()  # before the jobs, which share it
    jobs = [(name, UNADAPTED, 0) for name in settings.experiments]
    jobs += [
        (name, variant, seed)
        for name in settings.experiments
        for variant in settings.variants
        for seed in range(settings.seeds)
    ]
    found = in_processes(_score, settings, jobs)
    rows = []
    for name in settings.experiments:
        experiment = EXPERIMENTS[name]
        about, samples = (name, experiment.vehicle.name), experiment.round_samples
        rows.append(miss_row(*about, UNADAPTED, "target", 0, experiment.measure, [found[name, UNADAPTED, 0]]))
        for variant in settings.variants:
            scores = [found[name, variant, seed] for seed in range(settings.seeds)]
            rows.append(miss_row(*about, variant, "adapted", samples, experiment.measure, scores))
    write_rows(settings.out, rows)
    for row in rows:
        failed = f"{row.failed} of {row.episodes} failed"
        print(f"{row.experiment:20} {row.method:20} {row.mean:.4f} +- {row.std:.4f} m, {failed}")


def _score(settings: Settings, name: str, variant: str, seed: int) -> FlightScore:
    """The score of a policy after one round of an adaptation, or UNADAPTED."""
    torch.set_num_threads(1)
    experiment = replace(EXPERIMENTS[name], budget=EXPERIMENTS[name].round_samples)
    setup = experiment.setup(quadrotor_references.ready)
    policy = setup.load(shipped(experiment.vehicle.name))
    target, work = flight_target(setup, experiment.effects(setup)), settings.work / variant
    folder = experiment.open(setup, work, seed, settings.flights)
    if variant != UNADAPTED:
        experiment.adapt(VARIANTS[variant](setup, policy), work, policy, seed)
    return kept_score(folder / "score.json", policy, target, settings.flights)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

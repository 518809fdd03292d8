"""What a residual learns from how many samples (the paper's figure 8): ours and the paper's MLP.

    python -m benchmarks.residual_samples

The quadrotor under a drag of 0.3 1/s, flown by the policy of the source with a little noise on its commands. Each seed
draws flights of its own; both residuals are grounded on the first 50 to 1,000 samples, and judged by what they leave of
the gap in velocity on 1,000 samples of other flights, that no one learnt from: root mean square, as a share of the gap.

Writes results/residual_samples.csv and assets/residual_samples.png.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from datasets import quadrotor_references
from experiments.curves import Chart, plot_charts
from experiments.flights import EXPERIMENTS, flight_target
from experiments.result_tables import Row, read_rows, write_rows
from visadapt.effects import Residual
from visadapt.learning.grounding import gap, gap_with_residual, ground, rescale
from visadapt.learning.transitions import Transitions
from visadapt.policies import Policy
from visadapt.policies.networks import FlightResidualNetwork, ResidualNetwork, StateResidualNetwork
from visadapt.setups.base import Setup
from visadapt.systems import RigidBody
from visadapt.systems.rigid_body import VELOCITY
from visadapt.targets.rollout import run
from visadapt.weights import shipped

EXPERIMENT = EXPERIMENTS["quadrotor, drag"]
SAMPLES = (50, 100, 200, 500, 1000)
FLIGHTS = 10
"""of 100 samples each"""
NOISE = 0.05
OURS, PAPER = "ours, linear", "the paper's MLP, 64-64"


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    picture: Path = Path("assets/residual_samples.png")
    out: Path = Path("results/residual_samples.csv")


def main(settings: Settings) -> None:
    """Ground all residuals and write the table."""
    setup = EXPERIMENT.setup(quadrotor_references.ready)
    policy = setup.load(shipped("quadrotor"))
    shares: dict[tuple[str, int], list[float]] = {}
    for seed in range(settings.seeds):
        train, test = (_flown(setup, policy, 2 * seed + k) for k in (0, 1))
        for method in (OURS, PAPER):
            for samples in SAMPLES:
                shares.setdefault((method, samples), []).append(_share(setup, method, train, samples, test, seed))
    rows = [
        Row(
            experiment="quadrotor, drag, residual by samples",
            system="quadrotor",
            method=method,
            domain="target",
            samples=samples,
            measure="gap in velocity that is left",
            unit="1",
            mean=round(float(np.mean(values)), 4),
            std=round(float(np.std(values)), 4),
            episodes=None,
            failed=0,
            seeds=settings.seeds,
        )
        for (method, samples), values in shares.items()
    ]
    write_rows(settings.out, rows)
    _draw(settings)
    for row in rows:
        print(f"{row.method:24} {row.samples:5} samples  {row.mean:.4f} +- {row.std:.4f} of the gap left")


def _draw(settings: Settings) -> None:
    title = "quadrotor, drag 0.3 1/s: flights that were not learnt from"
    panel = Chart(title, "gap in velocity that is left, as a share", read_rows(settings.out))
    plot_charts(settings.picture, [panel])


def _flown(setup: Setup, policy: Policy, seed: int) -> Transitions:
    """Samples of flights in the target."""
    target = flight_target(setup, EXPERIMENT.effects(setup), test=False)
    generator = torch.Generator().manual_seed(seed)
    runs = run(target, policy, FLIGHTS, target.task.steps, generator, NOISE)
    return Transitions.cut([each.episode for each in runs])


def _share(setup: Setup, method: str, train: Transitions, samples: int, test: Transitions, seed: int) -> float:
    """The share of the gap in velocity that a residual leaves on `test`."""
    torch.manual_seed(seed)
    source, own = setup.source, setup.settings.ground
    assert isinstance(source.system, RigidBody)
    network: ResidualNetwork = (
        FlightResidualNetwork(source.system, source.period)
        if method == OURS
        else StateResidualNetwork(len(source.system.states), len(source.system.actions))
    )
    residual = Residual(network, torch.ones(len(source.system.states)))
    few = _first(train, samples)
    rescale(residual, source, few, own.negligible)
    ground(residual, source, few, own, torch.Generator().manual_seed(seed))
    return _size(gap_with_residual(residual, source, test)) / _size(gap(source, test))


def _first(transitions: Transitions, count: int) -> Transitions:
    """The first transitions only, of the same episodes."""
    return dataclasses.replace(transitions, rows=transitions.rows[:count])


def _size(change: Tensor) -> float:
    return float(change[:, VELOCITY].square().mean().sqrt())


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

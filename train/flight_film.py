"""A film of one flight three times: in the source, in the target before adaptation, and after it.

    python -m train.flight_film --vehicle quadrotor --experiment drag

Source policies are the shipped ones (from train.flight_policies). Adapted weights are those that `benchmarks.flight`
left in runs/flight; where they are not there yet, or not all, the policy is adapted there first, in the same way. Do
not start it while the benchmark is at work on the same experiment and seed. Writes

    runs/films/<vehicle>-<experiment>.mp4    source, before and after side by side
    runs/films/<vehicle>-<experiment>.png    a still of it

and prints how far each of the three was off.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro

from datasets import quadrotor_references
from experiments.endings import ends_in_one_line
from experiments.flights import EXPERIMENTS, flight_target
from visadapt.films.flight_film import FlightFilm
from visadapt.films.flight_panel import FlightPanel
from visadapt.policies import Policy
from visadapt.progress import reporting, staged
from visadapt.setups.base import Setup
from visadapt.targets.rollout import run
from visadapt.targets.synthetic import DrawEffects, no_effects
from visadapt.weights import shipped


@dataclass(frozen=True)
class Settings:
    """What is filmed, and where its policies are."""

    vehicle: Literal["quadrotor", "fixed_wing"] = "quadrotor"
    experiment: Literal["drag", "force"] = "drag"
    """hidden in the target: a drag of 0.3 1/s, or 2 cos(t + phase) N, along x or, on the wing, along y"""
    seed: int = 0
    """of the adaptation"""
    flight: int = 12
    """seed of what is to be flown, and of the force's phase: one that was not trained on"""
    still: float = 6.0
    """s at which the still is taken; 0.3 s after it passed its target, if it flies through one"""
    work: Path = Path("runs/flight")
    out: Path = Path("runs/films")


def main(settings: Settings) -> None:
    """Adapt what is not adapted yet, fly, and film."""
    torch.set_num_threads(1)
    kind = settings.vehicle, settings.experiment
    experiment = next(each for each in EXPERIMENTS.values() if (each.vehicle.name, each.hidden) == kind)
    setup = experiment.setup(quadrotor_references.ready)
    policy = setup.load(shipped(settings.vehicle))
    adapting = copy.deepcopy(policy)
    hidden = experiment.effects(setup)
    with reporting() as report:
        adapted = experiment.adapt(setup, settings.work, adapting, settings.seed, report)
        after = f"Target, after {adapted.ledger.used:,} samples"
        panels = [
            flown(setup, no_effects, policy, settings.flight, "Source, 0 samples"),
            flown(setup, hidden, policy, settings.flight, "Target, before adaptation"),
            flown(setup, hidden, adapting, settings.flight, after),
        ]
        path = settings.out / f"{settings.vehicle}-{settings.experiment}.mp4"
        passed = max(panel.passed for panel in panels) + 0.3
        film = FlightFilm(panels)
        film.write_still(path.with_suffix(".png"), settings.still if film.follows else passed)
        film.write(path, staged(report, "film"))
    for panel in panels:
        print(f"{panel.title:30} {100 * float(panel.score[-1]):7.2f} cm {'mean' if film.follows else 'nearest'}")
    print(f"{path} and {path.with_suffix('.png').name} are written")


def flown(setup: Setup, draw_effects: DrawEffects, policy: Policy, seed: int, title: str) -> FlightPanel:
    """One flight under hidden effects; the seed alone decides what is to be flown, and the force."""
    policy.eval()
    target = flight_target(setup, draw_effects)
    flights = run(target, policy, 1, target.task.steps, torch.Generator().manual_seed(seed), strict=False)
    return FlightPanel(title, flights[0], target.system, target.task, target.first[0])


if __name__ == "__main__":
    with ends_in_one_line("flight_film"):
        main(tyro.cli(Settings, description=__doc__))

"""What each part of adapting from frames is worth, on six targets, at 200 counted samples.

    python -m benchmarks.ablations

Each seed adapts the shipped policy anew, as shipped and with a part left out, and is scored on episodes whose starts
no training saw. No score chooses anything. Writes results/ablations.csv. Interrupt it anywhere; started again, it
goes on.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro

from experiments.kept_scores import kept_score
from experiments.result_tables import print_speed, speed_row, write_rows
from renderers import DrawnCartPole
from visadapt.effects import ActuatorDelay, ActuatorGain, ConstantForce, CoulombFriction
from visadapt.evaluation import CartPoleScore
from visadapt.learning.setup_settings import SetupSettings
from visadapt.setups.cartpole import cartpole_frames
from visadapt.storage.run_folder import open_run
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget, no_effects, sine_force
from visadapt.weights import shipped

SAMPLES = 200
ROUND_SAMPLES = 100

TARGETS: dict[str, Callable[..., SyntheticTarget]] = {
    "2(sin t + 1) N": partial(SyntheticTarget, sine_force),
    "dry friction 4 N": partial(SyntheticTarget, lambda batch, generator: [CoulombFriction(force=4.0)]),
    "gain 0.7": partial(SyntheticTarget, lambda batch, generator: [ActuatorGain(scale=0.7)]),
    "pole twice as heavy": partial(SyntheticTarget, no_effects, system=CartPole(pole_mass=2 * CartPole().pole_mass)),
    "constant 2 N": partial(SyntheticTarget, lambda batch, generator: [ConstantForce(force=2.0)]),
    "delay 0.05 s and 1 N": partial(
        SyntheticTarget, lambda batch, generator: [ActuatorDelay(delay=0.05), ConstantForce(force=1.0)]
    ),
}


def untuned(settings: SetupSettings) -> SetupSettings:
    """The feed-forward on the residual, in closed form, and no backpropagation."""
    return replace(settings, tuning=replace(settings.tuning, iterations=0))


VARIANTS: dict[str, Callable[[SetupSettings], SetupSettings]] = {
    "as shipped": lambda settings: settings,
    "no tuning": untuned,
    "no feed-forward": lambda settings: replace(settings, feedforward=False),
    "no averaging of weights": lambda settings: replace(settings, trust=1.0),
}


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    episodes: int = 60
    targets: tuple[str, ...] = tuple(TARGETS)
    """which of TARGETS"""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """which of VARIANTS"""
    jobs: int = 2
    """adaptations at once, one core each"""
    work: Path = Path("runs/ablations")
    out: Path = Path("results/ablations.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    rows = []
    jobs = [
        (settings, name, variant, seed)
        for name in settings.targets
        for variant in settings.variants
        for seed in range(settings.seeds)
    ]
    with ProcessPoolExecutor(settings.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        unadapted = [pool.submit(_before, settings, name) for name in settings.targets]
        found = dict(zip(jobs, pool.map(_after, *zip(*jobs, strict=True)), strict=True))
    for name, before in zip(settings.targets, unadapted, strict=True):
        experiment = f"CartPole, pixels, {name}"
        rows.append(speed_row(experiment, "unadapted", "target", 0, [before.result()]))
        for variant in settings.variants:
            scores = [found[settings, name, variant, seed] for seed in range(settings.seeds)]
            rows.append(speed_row(experiment, variant, "adapted", SAMPLES, scores))
    write_rows(settings.out, rows)
    for row in rows:
        print_speed(row)


def _before(settings: Settings, name: str) -> CartPoleScore:
    torch.set_num_threads(1)
    folder = settings.work / "unadapted"
    open_run(folder, {"episodes": settings.episodes})
    policy = cartpole_frames().load(shipped("cartpole_frames"))
    return kept_score(folder / f"{name}.json", policy, TARGETS[name](camera=DrawnCartPole()), settings.episodes)


def _after(settings: Settings, name: str, variant: str, seed: int) -> CartPoleScore:
    torch.set_num_threads(1)
    setup, target = cartpole_frames(), TARGETS[name](camera=DrawnCartPole())
    setup = replace(setup, settings=VARIANTS[variant](setup.settings))
    folder = settings.work / name / variant / f"seed-{seed}"
    open_run(folder, {"seed": seed, "episodes": settings.episodes, **setup.settings.numbers()})
    policy = setup.load(shipped("cartpole_frames"))
    setup.adapt(policy, target, folder, SAMPLES, ROUND_SAMPLES, seed)
    return kept_score(folder / "score.json", policy, target, settings.episodes)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

"""What each part of an adaptation is worth, on six targets, at 200 counted samples.

    python -m benchmarks.ablations
    python -m benchmarks.ablations --shown states --out results/ablations_states.csv

Each seed adapts the source policy anew, as shipped and with a part left out, and is scored on episodes whose starts
no training saw. No score chooses anything. From frames the source policy is the shipped one; from states, where the
networks see 5 states and actions, it is trained first. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import torch
import tyro
from torch import nn

from experiments.kept_scores import kept_score
from experiments.parallel import in_processes
from experiments.result_tables import print_speed, speed_row, write_rows
from renderers import DrawnCartPole
from visadapt.effects import ActuatorDelay, ActuatorGain, ConstantForce, CoulombFriction, Residual
from visadapt.evaluation import CartPoleScore
from visadapt.policies import Policy
from visadapt.policies.networks import ResidualNetwork, mlp
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import cartpole_frames, cartpole_states
from visadapt.storage.run_folder import open_run
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget, no_effects, sine_force
from visadapt.weights import shipped
from visadapt.world import World

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


Variant = Callable[[Setup], Setup]


def untuned(setup: Setup) -> Setup:
    """The feed-forward on the residual, in closed form, and no backpropagation."""
    tuning = replace(setup.settings.tuning, iterations=0)
    return replace(setup, settings=replace(setup.settings, tuning=tuning))


def held_over_a_plan(setup: Setup) -> Setup:
    """The residual's correction is constant over a plan, so that the gradient flows through the physics alone."""
    plans = setup.settings.refinement
    assert plans is not None
    held = replace(plans, iterations=300, streams=32, recorded=0.8)
    return replace(setup, settings=replace(setup.settings, tuning=held))


def with_an_mlp(setup: Setup) -> Setup:
    """The paper's head of the residual: two hidden layers of 64, fitted by gradient descent."""

    def residual(policy: Policy, source: World) -> Residual:
        made = setup.residual(policy, source)
        network = made.network
        assert isinstance(network, ResidualNetwork)
        assert isinstance(network.head, nn.Linear)
        network.head = mlp(network.head.in_features, 64, 64, network.head.out_features)
        for weight in network.head[-1].parameters():
            nn.init.zeros_(weight)
        return made

    return replace(setup, residual=residual)


def _with(**changed: object) -> Variant:
    return lambda setup: replace(setup, settings=replace(setup.settings, **changed))  # type: ignore[arg-type]


VARIANTS: dict[str, Variant] = {
    "as shipped": lambda setup: setup,
    "no tuning": untuned,
    "no feed-forward": _with(feedforward=False),
    "each round tunes on": _with(tunes_on=True),
    "correction held over a plan": held_over_a_plan,
    "MLP residual": with_an_mlp,
}


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    shown: Literal["frames", "states"] = "frames"
    """what the policy sees"""
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
    if settings.shown == "states":
        _source(settings)
    jobs = [
        (name, variant, seed)
        for name in settings.targets
        for variant in settings.variants
        for seed in range(settings.seeds)
    ]
    unadapted = in_processes(_before, settings, [(name,) for name in settings.targets])
    found = in_processes(_after, settings, jobs)
    for name in settings.targets:
        experiment = f"CartPole, {'pixels' if settings.shown == 'frames' else 'states'}, {name}"
        rows.append(speed_row(experiment, "unadapted", "target", 0, [unadapted[(name,)]]))
        for variant in settings.variants:
            scores = [found[name, variant, seed] for seed in range(settings.seeds)]
            rows.append(speed_row(experiment, variant, "adapted", SAMPLES, scores))
    write_rows(settings.out, rows)
    for row in rows:
        print_speed(row)


def _source(settings: Settings) -> tuple[Setup, Policy]:
    if settings.shown == "frames":
        setup = cartpole_frames()
        return setup, setup.load(shipped("cartpole_frames"))
    setup = cartpole_states(with_history=True)
    return setup, setup.pretrain(settings.work / "source.safetensors", seed=0)


def _target(settings: Settings, name: str) -> SyntheticTarget:
    return TARGETS[name](camera=DrawnCartPole() if settings.shown == "frames" else None)


def _before(settings: Settings, name: str) -> CartPoleScore:
    torch.set_num_threads(1)
    folder = settings.work / "unadapted"
    open_run(folder, {"shown": settings.shown, "episodes": settings.episodes})
    _, policy = _source(settings)
    return kept_score(folder / f"{name}.json", policy, _target(settings, name), settings.episodes)


def _after(settings: Settings, name: str, variant: str, seed: int) -> CartPoleScore:
    torch.set_num_threads(1)
    shipped_setup, policy = _source(settings)
    setup, target = VARIANTS[variant](shipped_setup), _target(settings, name)
    folder = settings.work / name / variant / f"seed-{seed}"
    about = {"shown": settings.shown, "seed": seed, "episodes": settings.episodes}
    open_run(folder, {**about, **setup.settings.numbers()})
    setup.adapt(policy, target, folder, SAMPLES, ROUND_SAMPLES, seed)
    return kept_score(folder / "score.json", policy, target, settings.episodes)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

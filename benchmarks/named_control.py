"""What a diagnosis is worth for control: adapted with the causes that it names, with a residual, with the true effect.

    python -m benchmarks.named_control
    python -m benchmarks.named_control --shown frames --out results/named_control_frames.csv

The CartPole under hidden effects of each kind, among them one that no effect of the library describes and none at all;
from frames, a camera that was turned too. For each method the source policy collects the samples, in one round and
from the same seed:

    residual                 the paper's
    diagnosed                `visadapt adapt --diagnose`: what is named is put into the simulator, and a residual learns
                             the gap only where nothing is named
    diagnosed early          the same after fewer samples
    diagnosed and residual   a residual learns beside what is named, whose parameters are fitted to the samples again
    true effect              the hidden effect is in the simulator; takes no samples, and is tuned with the same random
                             numbers as "diagnosed"

From states each seed has its own source policy, from frames all have the shipped one. Scores are of 100 episodes of
12.5 s. Where a residual cannot be learnt, since no states are seen in a faulty camera's frames, the source policy is
scored.

Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import torch
import tyro
from torch import Tensor

from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import print_speed, speed_row, write_rows
from renderers import DrawnCartPole
from visadapt.effects import (
    ActuatorDelay,
    ActuatorGain,
    AngleOffset,
    CameraRotation,
    CoulombFriction,
    DynamicsEffect,
    Effect,
    PeriodicForce,
    Spring,
    ViscousFriction,
)
from visadapt.evaluation import CartPoleScore
from visadapt.learning.rounds import TUNING, RoundFolder
from visadapt.learning.tracking import TrackingError
from visadapt.policies import Policy
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import cartpole_frames, cartpole_states, from_states
from visadapt.storage.run_folder import open_run
from visadapt.systems import CartPole, System
from visadapt.targets import SyntheticTarget
from visadapt.weights import shipped
from visadapt.world import World


class Ripple(DynamicsEffect):
    """A foreign effect: the force of a track that is not even, which none of the library's effects describes."""

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        """(B, 2) up to 2 N on the cart."""
        force = 2.0 * (6.0 * state[:, 0]).cos() * (3.0 * state[:, 2]).cos()
        return torch.stack((force, torch.zeros_like(force)), -1)


Hidden = dict[str, Callable[[], list[Effect]]]
HIDDEN: Hidden = {
    "viscous friction": lambda: [ViscousFriction(coefficient=5.0)],
    "dry friction": lambda: [CoulombFriction(force=3.0)],
    "periodic force": lambda: [PeriodicForce(amplitude=2.0, frequency=0.5, phase=1.0, offset=1.0)],
    "spring": lambda: [Spring(stiffness=2.0, rest=0.2)],
    "delay": lambda: [ActuatorDelay(delay=0.08)],
    "angle offset": lambda: [AngleOffset(offset=0.03)],
    "gain and friction": lambda: [ActuatorGain(scale=0.75), ViscousFriction(coefficient=3.0)],
    "foreign (uneven track)": lambda: [Ripple()],
    "nothing": list,
}
"""From states: what is hidden."""
HIDDEN_FROM_FRAMES: Hidden = {
    "camera turned by 2 degrees, gain 0.6": lambda: [CameraRotation(angle=0.035), ActuatorGain(scale=0.6)],
    "dry friction": lambda: [CoulombFriction(force=4.0)],
    "viscous friction": lambda: [ViscousFriction(coefficient=5.0)],
    "periodic force": lambda: [PeriodicForce(amplitude=2.0, frequency=1 / (2 * math.pi), phase=0.0, offset=2.0)],
    "foreign (uneven track)": lambda: [Ripple()],
    "nothing": list,
}
"""What is hidden from policies that are shown frames."""

NONE, RESIDUAL, EARLY, DIAGNOSED, BOTH, TRUE = METHODS = (
    "source policy",
    "residual",
    "diagnosed early",
    "diagnosed",
    "diagnosed and residual",
    "true effect",
)


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    shown: Literal["states", "frames"] = "states"
    """what the policies are shown"""
    kinds: tuple[str, ...] = ()
    """what is hidden, of `HIDDEN` or `HIDDEN_FROM_FRAMES`; without, all of it"""
    seeds: int = 3
    episodes: int = 100
    samples: int = 300
    """counted, in one round"""
    early: int = 50
    """counted by the diagnosis that is made early"""
    source_iterations: int = 3000
    """of the source policy, from states"""
    iterations: int = 400
    """of the tuning with a residual, from states"""
    jobs: Jobs = 2
    """of what is hidden and seeds at once, one core each"""
    work: Path = Path("runs/named_control")
    out: Path = Path("results/named_control.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    if settings.shown == "states":
        in_processes(_source, settings, [(seed,) for seed in range(settings.seeds)])
    kinds = settings.kinds or tuple(_every(settings))
    found = in_processes(_scores, settings, [(kind, seed) for kind in kinds for seed in range(settings.seeds)])
    rows = []
    for kind in kinds:
        for method in METHODS:
            domain = "target" if method == NONE else "adapted"
            scores = [found[kind, seed][method] for seed in range(settings.seeds)]
            samples = _samples(settings, method)
            rows.append(speed_row(f"CartPole, {settings.shown}, {kind}", method, domain, samples, scores))
    write_rows(settings.out, rows)
    for row in rows:
        print(f"{row.experiment:50}", end="")
        print_speed(row)


def _samples(settings: Settings, method: str) -> int:
    """Samples of the target that a method counts."""
    return {NONE: 0, TRUE: 0, EARLY: settings.early}.get(method, settings.samples)


def _every(settings: Settings) -> Hidden:
    """All that may be hidden from policies that are shown this."""
    return HIDDEN if settings.shown == "states" else HIDDEN_FROM_FRAMES


def _setup(settings: Settings, source: World | None = None) -> Setup:
    """The setup, with a source that differs from the bare cart-pole by effects that a diagnosis named."""
    if settings.shown == "frames":
        return cartpole_frames(source)
    own = from_states(World(CartPole())).shortened(settings.source_iterations)
    own = own.with_tuning(partial(replace, iterations=settings.iterations))
    return cartpole_states(source, with_history=True, settings=own)


def _source(settings: Settings, seed: int) -> Policy:
    """The source policy of a seed; from states it is trained where it is not kept yet."""
    torch.set_num_threads(1)
    setup = _setup(settings)
    if settings.shown == "frames":
        return setup.load(shipped("cartpole_frames"))
    return setup.pretrain(settings.work / "states" / f"seed-{seed}.safetensors", seed)


def _scores(settings: Settings, kind: str, seed: int) -> dict[str, CartPoleScore]:
    """Scores of one seed under what is hidden, by method."""
    setup, source = _setup(settings), _source(settings, seed)
    folder = settings.work / settings.shown / kind / f"seed-{seed}"
    numbers = {name: getattr(settings, name) for name in ("episodes", "samples", "early")}
    open_run(folder, {"seed": seed, **numbers, **setup.settings.numbers()})
    effects = _every(settings)[kind]()
    camera = DrawnCartPole() if settings.shown == "frames" else None
    target = SyntheticTarget(lambda batch, generator: effects, camera)
    scores = {}
    for method in METHODS:
        work = folder / method.replace(" ", "-")
        path = work.with_suffix(".json")
        policy = source
        if method != NONE and not path.exists():
            policy = _adapted(setup, source, effects, target, method, work, settings, seed)
        scores[method] = kept_score(path, policy, target, settings.episodes)
    return scores


def _adapted(
    setup: Setup,
    source: Policy,
    effects: list[Effect],
    target: SyntheticTarget,
    method: str,
    work: Path,
    settings: Settings,
    seed: int,
) -> Policy:
    """The source policy, adapted by a method."""
    policy, samples = copy.deepcopy(source), _samples(settings, method)
    if method == TRUE:
        if effects:
            as_diagnosed = RoundFolder.of(work, 0, 1, seed).generator(TUNING).initial_seed()
            replace(setup, source=World(CartPole(), effects)).tune(policy, as_diagnosed)
        return policy
    diagnose = method in (EARLY, DIAGNOSED)
    try:
        if method == BOTH:
            work_before, again = work.with_name(DIAGNOSED), copy.deepcopy(source)
            named = setup.adapt(again, target, work_before, samples, samples, seed, diagnose=True).source
            setup = _setup(settings, named)
            if not len(named.effects):  # then this is the run with a residual alone
                work = work.with_name(RESIDUAL)
        setup.adapt(policy, target, work, samples, samples, seed, diagnose=diagnose)
    except TrackingError as error:
        print(f"{work}: {error}", flush=True)
        return source
    return policy


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

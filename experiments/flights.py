"""The paper's experiments with vehicles: drag (its Tables 1 and 3) and a force that changes (its section 3.2.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from visadapt.effects import Effect, LinearDrag, PeriodicForce
from visadapt.learning.joint import Adapted
from visadapt.policies import Policy
from visadapt.progress import Report
from visadapt.setups.base import Setup
from visadapt.setups.flight import fixed_wing, quadrotor
from visadapt.storage.run_folder import open_run
from visadapt.systems import FixedWing, Quadrotor, RigidBody, System
from visadapt.targets import FlightTarget
from visadapt.targets.synthetic import DrawEffects, no_effects
from visadapt.tasks.base import FlightTask
from visadapt.tasks.references import Reference

DRAG = 0.3  # 1/s, r in v' = ... - r v
FORCE = 2.0  # N, amplitude of FORCE cos(t + phase)


def flight_target(
    setup: Setup, draw_effects: DrawEffects = no_effects, test: bool = True, reach: float = math.inf
) -> FlightTarget:
    """A setup's vehicle with hidden effects, in the task that it is scored in, or else in the one it is trained in.

    A flight ends `reach` m off its task's line.
    """
    task, system = setup.test if test else setup.settings.source.task, setup.source.system
    assert isinstance(task, FlightTask)
    assert isinstance(system, RigidBody)
    return FlightTarget(task, system, draw_effects, reach=reach)


class SidePush(PeriodicForce):
    """A push along y that comes and goes. It has no name of its own, and so is in no catalogue."""

    systems = (RigidBody,)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return super().load(time, state, system).roll(1, -1)


@dataclass(frozen=True)
class FlightExperiment:
    """A vehicle, what is hidden in its target, and the samples it is given."""

    name: str
    vehicle: type[RigidBody]
    hidden: str
    """drag, or force: the latter along x on the quadrotor, and along y, across the way ahead, on the wing (A.2.1)"""
    budget: int
    round_samples: int

    @property
    def measure(self) -> str:
        """What a score of it is."""
        return "mean tracking error" if self.vehicle is Quadrotor else "miss of the target"

    def setup(self, references: Callable[[], tuple[Reference, Reference]]) -> Setup:
        """The vehicle, which may need references to train on and to be scored on; a force is read in the history."""
        with_history = self.hidden == "force"
        if self.vehicle is FixedWing:
            return fixed_wing(with_history=with_history)
        return quadrotor(*references(), with_history=with_history)

    def effects(self, setup: Setup) -> DrawEffects:
        """What is hidden in the target."""
        assert isinstance(setup.source.system, RigidBody)
        mass = float(setup.source.system.mass)

        def drag(batch: int, generator: torch.Generator) -> Sequence[Effect]:
            return (LinearDrag(coefficient=DRAG * mass),)

        def force(batch: int, generator: torch.Generator) -> Sequence[Effect]:
            phase = math.pi * (2 * torch.rand(batch, generator=generator) - 1)
            kind = SidePush if self.vehicle is FixedWing else PeriodicForce
            return (kind(amplitude=FORCE, frequency=1 / (2 * math.pi), phase=phase, offset=0.0),)

        return drag if self.hidden == "drag" else force

    def folder(self, work: Path, seed: int) -> Path:
        """Where a seed's adaptation is kept under `work`."""
        return work / self.name.replace(", ", "-").replace(" ", "-") / f"seed-{seed}"

    def open(self, setup: Setup, work: Path, seed: int, flights: int) -> Path:
        """The folder of a seed whose policies are scored on `flights`; raises RunError where it is another run's."""
        folder = self.folder(work, seed)
        about = {"experiment": self.name, "budget": self.budget, "round_samples": self.round_samples}
        open_run(folder, {"seed": seed, "flights": flights, **about, **setup.settings.numbers()})
        return folder

    def adapt(
        self,
        setup: Setup,
        work: Path,
        policy: Policy,
        seed: int,
        report: Report | None = None,
        explorer: Policy | None = None,
        reach: float = math.inf,
    ) -> Adapted:
        """Adapt `policy`, in place, to the target, going on from what is in `work`.

        With an `explorer` that policy collects the data, in flights that end `reach` m off their task's line.
        """
        target, place = flight_target(setup, self.effects(setup), False, reach), self.folder(work, seed)
        return setup.adapt(policy, target, place, self.budget, self.round_samples, seed, report, explorer)


EXPERIMENTS = {
    each.name: each
    for each in (
        FlightExperiment("quadrotor, drag", Quadrotor, "drag", 1000, 200),
        FlightExperiment("fixed wing, drag", FixedWing, "drag", 2000, 400),
        FlightExperiment("quadrotor, 2 cos t", Quadrotor, "force", 1000, 200),
        FlightExperiment("fixed wing, 2 cos t", FixedWing, "force", 2000, 400),
    )
}

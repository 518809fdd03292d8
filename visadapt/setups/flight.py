"""Vehicles from states: the paper's quadrotor and fixed wing (section 3.2.1, A.1.1 and A.1.2), and its experiments.

In the experiments the vehicles meet drag (its Tables 1 and 3) or a force that changes (its section 3.2.2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from visadapt.effects import Effect, LinearDrag, PeriodicForce
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.joint import Adapted, SetupSettings
from visadapt.learning.policy import TuneSettings
from visadapt.policies import FollowPolicy, Policy, ReachPolicy
from visadapt.progress import Report
from visadapt.setups.base import Setup
from visadapt.setups.policy_file import residual_for
from visadapt.storage.run_folder import open_run
from visadapt.systems import FixedWing, Quadrotor, RigidBody, System
from visadapt.targets import FlightTarget
from visadapt.targets.synthetic import DrawEffects, no_effects
from visadapt.tasks.base import FlightTask
from visadapt.tasks.follow import Follow, RecoverCost
from visadapt.tasks.reach import Reach
from visadapt.tasks.references import Reference
from visadapt.world import World

GROUND = GroundSettings(ridge=0.1, negligible=0.1)
RECORDED = 0.8
"""Share of the streams that start in a recorded flight, history and all, where the residual reads the history: without
it, a stream would meet no force that changes, or one that its residual makes up."""
DRAG = 0.3  # 1/s, r in v' = ... - r v
FORCE = 2.0  # N, amplitude of FORCE cos(t + phase)

_learn = partial(TuneSettings, longest=100, observation_noise=0.0)


def quadrotor(
    train: Reference, test: Reference | None = None, source: World | None = None, with_history: bool = False
) -> Setup:
    """The quadrotor that follows references, (N, T, 3) or a single one, (T, 3).

    Args:
        train, test: references to train on, and to be scored on; the same without the latter.
        source: the physics known beforehand; without it, Flightmare's quadrotor at the references' period.
        with_history: whether the residual also reads what the source left unexplained over the last periods, in which
            a force that changes shows.

    Raises:
        ValueError: a source whose period is not that of the references.
    """
    if source is not None and abs(source.period - train.period) > 1e-6:
        raise ValueError(
            f"the references have rows {train.period:g} s apart, the source {source.period:g} s between commands"
        )
    train, test = train.as_many(), None if test is None else test.as_many()
    task, recover = Follow(train), Follow(train, RecoverCost(), divergence=3.0)
    tuning = _learn(task, 200, 256, 1e-3, curriculum=False)
    if with_history:
        tuning = _learn(recover, 400, 128, 2e-3, curriculum=False, recorded=RECORDED)
    return Setup(
        source=source or World(Quadrotor(), period=train.period, substeps=2),
        policy=lambda: FollowPolicy(train.period),
        residual=partial(residual_for, with_history=with_history),
        settings=_settings(_learn(task, 4000, 256, 4e-3), tuning),
        test=task if test is None else Follow(test),
    )


def fixed_wing(source: World | None = None, with_history: bool = False) -> Setup:
    """The fixed wing that flies through points 50 m ahead.

    Args:
        source: the physics known beforehand; without it, Waldock's aircraft, 0.05 s between commands.
        with_history: as for `quadrotor`.
    """
    source = source or World(FixedWing(), period=0.05)
    assert isinstance(source.system, FixedWing)
    task = Reach(source.period, source.system)
    recorded = RECORDED if with_history else 0.0
    tuning = _learn(task, 200, 128, 3e-4, curriculum=False, recorded=recorded)
    return Setup(
        source=source,
        policy=ReachPolicy,
        residual=partial(residual_for, with_history=with_history),
        settings=_settings(_learn(task, 3000, 128, 3e-3), tuning),
        test=task,
    )


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


def _settings(source: TuneSettings, tuning: TuneSettings) -> SetupSettings:
    assert isinstance(tuning.task, FlightTask)
    return SetupSettings(source, tuning, GROUND, longest_episode=tuning.task.steps, feedforward=False)


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

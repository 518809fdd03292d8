"""Control of vehicles from states: the paper's quadrotor and fixed wing (section 3.2.1, A.1.1 and A.1.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from visadapt.effects import Effect, Residual
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.joint import Adapted, AdaptSettings, adapt
from visadapt.learning.policy import TuneSettings, train_or_load
from visadapt.policies import FlightPolicy, FollowPolicy, Policy, ReachPolicy
from visadapt.policies.networks import FlightResidualNetwork
from visadapt.progress import Report, staged
from visadapt.storage.checkpoints import load_network
from visadapt.storage.run_folder import once
from visadapt.systems import FixedWing, Quadrotor, RigidBody
from visadapt.targets import FlightTarget
from visadapt.targets.rollout import run, see_goals
from visadapt.targets.synthetic import DrawEffects, no_effects
from visadapt.tasks.base import Task
from visadapt.tasks.courses import AlongReferences, Course, ToTarget
from visadapt.tasks.flight import Follow, Reach, RecoverCost
from visadapt.world import World

RECORDED = 0.8
"""share of the streams that start as a recorded flight went, past and all, where the residual reads the past"""


@dataclass(frozen=True)
class TrainSettings:
    """How long and how fast a policy learns."""

    iterations: int
    rate: float
    batch: int = 256


@dataclass(frozen=True)
class FlightSettings:
    """How a vehicle's policy is trained."""

    source: TrainSettings
    tuning: TrainSettings
    """in each round of the adaptation"""
    recovering: TrainSettings
    """the same, where the residual reads the past"""
    longest: int = 100
    """steps of a stream"""
    ground: GroundSettings = field(default_factory=lambda: GroundSettings(ridge=0.1, negligible=0.1))


class Flight:
    """One vehicle and what it is to do.

    Args:
        system: the vehicle.
        period: s between commands.
        substeps: of the source's integrator.
        train, test: courses to train on, and to be scored on.
        task: what streams do.
        policy: makes a new policy.
        recovery: what streams do when the policy is adapted to what changes, if not the same.
    """

    def __init__(
        self,
        system: RigidBody,
        period: float,
        substeps: int,
        train: Course,
        test: Course,
        task: Task,
        policy: Callable[[], FlightPolicy],
        settings: FlightSettings,
        recovery: Task | None = None,
    ) -> None:
        self.system = system
        self.source = World(system, period=period, substeps=substeps)
        self.train = train
        self.test = test
        self.task = task
        self.recovery = recovery or task
        self.policy = policy
        self.settings = settings

    def target(
        self, draw_effects: DrawEffects = no_effects, test: bool = True, reach: float = math.inf
    ) -> FlightTarget:
        """The vehicle with hidden effects, on the courses to be scored on, or else on those to train on.

        A flight ends `reach` m off its course.
        """
        course = self.test if test else self.train
        return FlightTarget(course, self.system, self.source.period, draw_effects, reach=reach)

    def pretrain(self, path: Path, seed: int, report: Report | None = None) -> FlightPolicy:
        """The policy of the source, trained there or read from `path`."""
        torch.manual_seed(seed)
        policy = self.policy()
        own, how = self.settings, self.settings.source
        settings = TuneSettings(self.task, how.iterations, how.batch, how.rate, own.longest, observation_noise=0.0)
        generator = torch.Generator().manual_seed(seed)
        progress = staged(report, f"{self.system.name}: source policy")
        train_or_load(path, policy, self.source, None, settings, generator, {"seed": seed, **asdict(how)}, progress)
        return policy

    def load(self, path: Path) -> FlightPolicy:
        """A policy that `pretrain` left; raises CheckpointError where there is none, or it does not fit."""
        policy = self.policy()
        load_network(path, policy)
        return policy

    def adapt(
        self,
        policy: FlightPolicy,
        target: FlightTarget,
        folder: Path,
        budget: int,
        round_samples: int,
        seed: int,
        with_history: bool = False,
        named: Sequence[Effect] = (),
        report: Report | None = None,
        explorer: Policy | None = None,
    ) -> Adapted:
        """Adapt `policy`, in place, to `target` with at most `budget` counted samples: Algorithm 1 in `folder`.

        Args:
            with_history: whether the residual also reads what was left unexplained over the last periods, in which
                a force that changes shows.
            named: effects that are guessed to act, with any parameters: these are fitted, beside the residual.
            explorer: collects the data in place of `policy`.
        """
        torch.manual_seed(seed)
        own = self.settings
        how = own.recovering if with_history else own.tuning
        source = World(self.system, named, self.source.period, substeps=self.source.substeps)
        predict = partial(_step, source) if with_history else None
        network = FlightResidualNetwork(self.system, self.source.period, predict)
        residual = Residual(network, torch.ones(len(self.system.states)))
        settings = AdaptSettings(
            TuneSettings(
                self.recovery if with_history else self.task,
                how.iterations,
                how.batch,
                how.rate,
                own.longest,
                curriculum=False,
                # A stream that begins without a past meets no force that changes, or one that its residual makes up.
                recorded=RECORDED if with_history else 0.0,
                observation_noise=0.0,
            ),
            own.ground,
            budget,
            round_samples,
            "state",
            longest_episode=target.course.steps,
            feedforward=False,
            seed=seed,
        )
        args = (policy, residual, source, target, None, see_goals, settings, folder)
        return adapt(*args, report=report, explorer=explorer)


def quadrotor(train: AlongReferences, test: AlongReferences, system: Quadrotor | None = None) -> Flight:
    """The quadrotor, Flightmare's or one's own, that follows references 0.1 s a row."""
    period = train.references.period
    settings = FlightSettings(TrainSettings(4000, 4e-3), TrainSettings(200, 1e-3), TrainSettings(400, 2e-3, 128))
    follow, recover = Follow(train), Follow(train, RecoverCost(), divergence=3.0)
    return Flight(
        system or Quadrotor(), period, 2, train, test, follow, lambda: FollowPolicy(period), settings, recover
    )


def fixed_wing(period: float = 0.05, system: FixedWing | None = None) -> Flight:
    """The fixed wing, Waldock's or one's own, that flies through points 50 m ahead."""
    system = system or FixedWing()
    course = ToTarget(period, system)
    settings = FlightSettings(
        TrainSettings(3000, 3e-3, 128), TrainSettings(200, 3e-4, 128), TrainSettings(200, 3e-4, 128)
    )
    return Flight(system, period, 1, course, course, Reach(course), ReachPolicy, settings)


@dataclass(frozen=True)
class FlightScore:
    """How far flights miss. A flight that fails is in the mean with all it missed by: infinitely, if not finite."""

    flights: int
    failed: int
    """flights that were more than FAR off somewhere, or not finite"""
    mean: float
    """m, over flights, of the mean over each"""
    std: float
    """m, over flights"""
    worst: float
    """m, the greatest distance of all"""

    def __str__(self) -> str:
        return f"{self.mean:.4f} +- {self.std:.4f} m, {self.flights - self.failed} of {self.flights} stayed near"


FAR = 1.0
"""m off the course: the flight has failed."""


def score(target: FlightTarget, policy: Policy, seed: int, flights: int = 100) -> FlightScore:
    """Fly `flights` courses drawn with `seed`; the steps are free and not counted."""
    policy.eval()
    generator = torch.Generator().manual_seed(seed)
    runs = run(target, policy, see_goals, flights, target.course.steps, generator, strict=False)
    misses = []
    for k, flown in enumerate(runs):
        if flown.survived:
            assert flown.episode.state is not None
            states = torch.as_tensor(flown.episode.state)[None]
            misses.append(target.course.misses(states, target.first[k : k + 1])[0].numpy())
        else:
            misses.append(np.array([np.inf]))
    means = np.array([miss.mean() for miss in misses])
    worst = np.array([miss.max() for miss in misses])
    mean = float(means.mean())
    std = float(means.std()) if math.isfinite(mean) else math.inf
    return FlightScore(flights, int((worst > FAR).sum()), mean, std, float(worst.max()))


def kept_score(path: Path, target: FlightTarget, policy: Policy, seed: int, flights: int) -> FlightScore:
    """`score`, flown only where it is not kept in `path` yet."""
    found = once(path, lambda: asdict(score(target, policy, seed, flights)))
    # JSON has no infinity: that of a flight that was not finite is null there.
    missing: dict[str, Any] = {key: math.inf for key, value in found.items() if value is None}
    return FlightScore(**(found | missing))


def _step(source: World, state: Tensor, action: Tensor) -> Tensor:
    return source.step(source.start(state), action).state

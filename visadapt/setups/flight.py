"""Vehicles from states: the paper's quadrotor and fixed wing (section 3.2.1, A.1.1 and A.1.2)."""

from __future__ import annotations

from functools import partial

from visadapt.history import LENGTH
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.setup_settings import SetupSettings
from visadapt.learning.tuning import TuneSettings
from visadapt.policies import FollowPolicy, ReachPolicy
from visadapt.setups.base import Setup
from visadapt.setups.policy_file import residual_for
from visadapt.systems import FixedWing, Quadrotor
from visadapt.targets.base import periods_differ
from visadapt.tasks.follow import Follow, RecoverCost
from visadapt.tasks.reach import Reach
from visadapt.tasks.references import Reference
from visadapt.world import World

GROUND = GroundSettings(ridges=(0.1,), negligible=0.1)
RECORDED = 0.8
"""Share of the streams that start in a recorded flight, with its history, where the residual reads the history: in
other starts it shows no changing force, or only the residual's own."""

_tune_settings = partial(TuneSettings, longest=100, observation_noise=0.0)
_setup_settings = partial(SetupSettings, ground=GROUND, feedforward=False, tunes_on=True)


def quadrotor(
    train: Reference, test: Reference | None = None, source: World | None = None, with_history: bool = False
) -> Setup:
    """The quadrotor that follows references, (N, T, 3) or a single one, (T, 3).

    Args:
        train, test: references to train on, and to be scored on; without `test`, those of `train`.
        source: the physics known beforehand; without it, Flightmare's quadrotor at the references' period.
        with_history: whether the residual also reads the accelerations that the source left unexplained over the last
            periods, which show a changing force.

    Raises:
        ValueError: a source whose period is not that of the references, or these are too short for a history.
    """
    if source is not None and periods_differ(source.period, train.period):
        raise ValueError(
            f"the references have rows {train.period:g} s apart, the source {source.period:g} s between commands"
        )
    source = source or World(Quadrotor(), period=train.period, substeps=2)
    assert isinstance(source.system, Quadrotor)
    follow = partial(Follow, gravity=float(source.system.gravity))
    task, far_off = follow(train), partial(follow, train, start_spread=(0.3, 0.8), divergence=3.0)
    if with_history and task.steps < LENGTH:
        raise ValueError(f"references of {task.steps + 1} rows are too short for a history: {LENGTH + 1} are right")
    tuning = _tune_settings(task, iterations=200, batch=256, learning_rate=1e-3, curriculum=False)
    if with_history:
        tuning = _tune_settings(
            far_off(RecoverCost()),
            iterations=400,
            batch=128,
            learning_rate=5e-3,
            longest=60,
            curriculum=False,
            recorded=RECORDED,
        )
    return Setup(
        source=source,
        policy=lambda: FollowPolicy(train.period),
        residual=partial(residual_for, with_history=with_history),
        # First to keep to the reference, then to come back from far off.
        settings=_setup_settings(
            source=_tune_settings(task, iterations=4000, batch=256, learning_rate=4e-3),
            refinement=_tune_settings(far_off(), iterations=2000, batch=256, learning_rate=1e-3, curriculum=False),
            tuning=tuning,
            longest_episode=task.steps,
        ),
        test=task if test is None else follow(test),
    )


def fixed_wing(source: World | None = None, with_history: bool = False, task: Reach | None = None) -> Setup:
    """The fixed wing that flies through points ahead.

    Args:
        source: the physics known beforehand; without it, Waldock's aircraft, 0.05 s between commands.
        with_history: as for `quadrotor`.
        task: where the points are, and how fast it flies; without it, 50 m ahead at 11.5 m/s.
    """
    source = source or World(FixedWing(), period=0.05)
    assert isinstance(source.system, FixedWing)
    task = task or Reach(source.period, source.system)
    recorded = RECORDED if with_history else 0.0
    tuning = _tune_settings(task, iterations=200, batch=128, learning_rate=3e-4, curriculum=False, recorded=recorded)
    return Setup(
        source=source,
        policy=ReachPolicy,
        residual=partial(residual_for, with_history=with_history),
        settings=_setup_settings(
            source=_tune_settings(task, iterations=3000, batch=128, learning_rate=3e-3),
            tuning=tuning,
            longest_episode=task.steps,
        ),
        test=task,
    )

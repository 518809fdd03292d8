"""A system of one's own, shown its states: brought to rest at a goal."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from visadapt.history import HORIZON
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.setup_settings import SetupSettings
from visadapt.learning.tuning import TuneSettings
from visadapt.policies import RegulatorPolicy
from visadapt.recordings.physics import same_after_a_turn
from visadapt.setups.base import Setup
from visadapt.setups.policy_file import residual_for
from visadapt.systems import System
from visadapt.tasks.linear_quadratic import Regulator
from visadapt.tasks.regulate import Regulate
from visadapt.world import World

TWO_TURNS = 4 * math.pi  # rad; of an angle with a smaller range, a turn further is another reading of the same place

NEARLY = 0.999  # Largest share of a command's range that the policy holds at the goal before it is trained


def regulator(source: World, task: Regulate) -> Setup:
    """A system that is brought to rest at the goal of its task.

    The policy begins as the linear-quadratic regulator of the source, and is trained in it; the regulator's cost-to-go
    ends the cost of each plan. Where a diagnosis finds effects, that of the world with these does.

    Raises:
        ValueError: as `Regulate.solved`.

    >>> import visadapt as va
    >>> source = va.World(va.CartPole())
    >>> setup = regulator(source, va.Regulate(source.system, tolerance={"x": 0.5, "theta": 0.05}))
    >>> setup.policy().n_action
    1
    """
    task, solved = task.solved(source)
    steps = task.episode_steps(source.period)
    tuning = TuneSettings(
        task,
        iterations=400,
        longest=min(100, steps),
        closed_loop=True,
        curriculum=False,
        observation_noise=0.0,
    )
    return Setup(
        source=source,
        policy=partial(_policy, task, solved),
        residual=residual_for,
        settings=SetupSettings(
            source=tuning,
            tuning=replace(tuning, iterations=200, recorded=0.8),
            named=tuning,
            # An arm whose commands are two periods late falls, or its tuning diverges, with the ridge 1 alone.
            ground=GroundSettings(ridges=(1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)),
            longest_episode=steps,
            feedforward=False,
        ),
    )


def _turning(system: System) -> list[str]:
    """The angles that a sensor may read within a turn: those of a range below two, in which the system is the same a
    turn further."""
    return [
        state.name
        for state in system.states
        if state.unit == "rad" and state.high - state.low < TWO_TURNS and same_after_a_turn(system, state.name)
    ]


def _policy(task: Regulate, solved: Regulator) -> RegulatorPolicy:
    """A policy whose plan is the regulator's, as long as its commands are small."""
    low, high = task.command_range
    states = {state.name: state.unit for state in task.system.states}
    half_ranges = torch.tensor([(state.high - state.low) / 2 for state in task.system.states]).double()
    unit = task.spread.where(task.spread > 0, half_ranges)
    goal, ranges = task.at_goal.tolist(), (low.tolist(), high.tolist())
    policy = RegulatorPolicy(states, goal, unit.tolist(), *ranges, task.settings(), _turning(task.system))
    half, middle = (high - low) / 2, (high + low) / 2
    held = ((task.held - middle) / half).clamp(-NEARLY, NEARLY)
    slope = half * (1 - held.square())  # of the command by what the policy's last tanh takes
    with torch.no_grad():
        policy.law.weight.copy_((_plan(solved) * unit / slope[:, None]).flatten(0, 1))
        policy.law.bias.copy_(held.atanh().repeat(HORIZON))
    return policy


def _plan(solved: Regulator) -> Tensor:
    """(HORIZON, n_action, n_state) a state to the next commands of the regulator."""
    ahead, plan = torch.eye(len(solved.closed)).to(solved.closed), []
    for _ in range(HORIZON):
        plan.append(-solved.gain @ ahead)
        ahead = solved.closed @ ahead
    return torch.stack(plan)

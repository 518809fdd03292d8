"""Targets: machines and simulators on which a policy can be run."""

from visadapt.targets.base import Observation, Target, TargetError, TaskTarget
from visadapt.targets.following import FollowingTarget
from visadapt.targets.reaching import ReachingTarget
from visadapt.targets.synthetic import FlightTarget, Start, SyntheticTarget, constant_force, no_effects, sine_force

__all__ = [
    "FlightTarget",
    "FollowingTarget",
    "Observation",
    "ReachingTarget",
    "Start",
    "SyntheticTarget",
    "Target",
    "TargetError",
    "TaskTarget",
    "constant_force",
    "no_effects",
    "sine_force",
]

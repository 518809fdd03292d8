"""Targets: machines and simulators on which a policy can be run."""

from visadapt.targets.base import Observation, Target, TargetError
from visadapt.targets.synthetic import FlightTarget, Start, SyntheticTarget, constant_force, no_effects, sine_force

__all__ = [
    "FlightTarget",
    "Observation",
    "Start",
    "SyntheticTarget",
    "Target",
    "TargetError",
    "constant_force",
    "no_effects",
    "sine_force",
]

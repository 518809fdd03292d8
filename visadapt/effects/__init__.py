"""Effects: everything that separates the target from the source."""

from visadapt.effects.actuation import ActuatorDelay
from visadapt.effects.base import EFFECTS, ActuationEffect, DynamicsEffect, Effect, Parameter, Stage
from visadapt.effects.forces import ConstantForce, PeriodicForce, ViscousFriction
from visadapt.effects.residual import Residual

__all__ = [
    "EFFECTS",
    "ActuationEffect",
    "ActuatorDelay",
    "ConstantForce",
    "DynamicsEffect",
    "Effect",
    "Parameter",
    "PeriodicForce",
    "Residual",
    "Stage",
    "ViscousFriction",
]

"""Effects: everything that separates the target from the source."""

from visadapt.effects.actuation import (
    ActuatorBacklash,
    ActuatorBias,
    ActuatorDeadzone,
    ActuatorDelay,
    ActuatorGain,
    ActuatorLag,
    ActuatorSaturation,
)
from visadapt.effects.aerial import LinearDrag
from visadapt.effects.base import (
    EFFECTS,
    ActuationEffect,
    DynamicsEffect,
    Effect,
    Parameter,
    SensingEffect,
    Stage,
)
from visadapt.effects.forces import ConstantForce, Gust, PeriodicForce, Spring, TrackTilt
from visadapt.effects.friction import CoulombFriction, FrictionPatch, PoleDamping, QuadraticDrag, ViscousFriction
from visadapt.effects.parameters import CartMass, PoleLength, PoleMass
from visadapt.effects.residual import Residual
from visadapt.effects.sensing import (
    AngleOffset,
    Dropout,
    FrozenZone,
    MeasurementDelay,
    PositionOffset,
    SensorScale,
)

__all__ = [
    "EFFECTS",
    "ActuationEffect",
    "ActuatorBacklash",
    "ActuatorBias",
    "ActuatorDeadzone",
    "ActuatorDelay",
    "ActuatorGain",
    "ActuatorLag",
    "ActuatorSaturation",
    "AngleOffset",
    "CartMass",
    "ConstantForce",
    "CoulombFriction",
    "Dropout",
    "DynamicsEffect",
    "Effect",
    "FrictionPatch",
    "FrozenZone",
    "Gust",
    "LinearDrag",
    "MeasurementDelay",
    "Parameter",
    "PeriodicForce",
    "PoleDamping",
    "PoleLength",
    "PoleMass",
    "PositionOffset",
    "QuadraticDrag",
    "Residual",
    "SensingEffect",
    "SensorScale",
    "Spring",
    "Stage",
    "TrackTilt",
    "ViscousFriction",
]

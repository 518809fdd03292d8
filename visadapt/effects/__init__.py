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
from visadapt.effects.aerial import LinearDrag, PeriodicWind, RotorDrag, TranslationalLift, Wind
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
from visadapt.effects.vehicle import (
    BatterySag,
    CenterOfMassOffset,
    GroundEffect,
    Inertia,
    MotorLag,
    Payload,
    RotorEfficiency,
    ThrustGain,
)
from visadapt.effects.wing import ControlEffectiveness, Drag, LiftSlope, Mass, TrimOffset

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
    "BatterySag",
    "CartMass",
    "CenterOfMassOffset",
    "ConstantForce",
    "ControlEffectiveness",
    "CoulombFriction",
    "Drag",
    "Dropout",
    "DynamicsEffect",
    "Effect",
    "FrictionPatch",
    "FrozenZone",
    "GroundEffect",
    "Gust",
    "Inertia",
    "LiftSlope",
    "LinearDrag",
    "Mass",
    "MeasurementDelay",
    "MotorLag",
    "Parameter",
    "Payload",
    "PeriodicForce",
    "PeriodicWind",
    "PoleDamping",
    "PoleLength",
    "PoleMass",
    "PositionOffset",
    "QuadraticDrag",
    "Residual",
    "RotorDrag",
    "RotorEfficiency",
    "SensingEffect",
    "SensorScale",
    "Spring",
    "Stage",
    "ThrustGain",
    "TrackTilt",
    "TranslationalLift",
    "TrimOffset",
    "ViscousFriction",
    "Wind",
]

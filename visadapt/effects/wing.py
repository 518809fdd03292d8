"""Effects that change parameters of a fixed wing; coefficients and signs are those of `systems.FixedWing`."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

from visadapt.effects.base import DynamicsEffect, Parameter, require_system
from visadapt.effects.parameters import ParameterScale
from visadapt.systems import FixedWing, System

__all__ = ["ControlEffectiveness", "Drag", "LiftSlope", "Mass", "TrimOffset"]


class Mass(ParameterScale):
    """An aircraft heavier or lighter than the source's, with the same moments of inertia."""

    name = "mass"
    equation = "m = scale m_source"
    source = "Newton's second law"
    table = (Parameter("scale", "1", 0.5, 2.0, 1.0),)
    systems = (FixedWing,)
    scaled: ClassVar[dict[str, str]] = {"scale": "mass"}


class LiftSlope(ParameterScale):
    """Lift that grows faster or slower with the angle of attack; lift at an angle of 0 is unchanged."""

    name = "lift_slope"
    equation = "C_Lalpha = scale C_Lalpha_source"
    source = "Beard and McLain (2012), Small Unmanned Aircraft, equation 4.11"
    table = (Parameter("scale", "1", 0.3, 2.0, 1.0),)
    systems = (FixedWing,)
    scaled: ClassVar[dict[str, str]] = {"scale": "lift_attack"}


class Drag(ParameterScale):
    """More or less drag at an angle of attack of 0: ice, dirt, an extended part.

    It grows with the square of the airspeed, like the source's drag. The paper's drag, proportional to the velocity, is
    linear_drag, on both vehicles.
    """

    name = "drag"
    equation = "C_D0 = scale C_D0_source"
    source = "Beard and McLain (2012), Small Unmanned Aircraft, section 4.2.1"
    table = (Parameter("scale", "1", 0.2, 5.0, 1.0),)
    systems = (FixedWing,)
    scaled: ClassVar[dict[str, str]] = {"scale": "drag_zero"}


class ControlEffectiveness(ParameterScale):
    """Control surfaces more or less effective than modelled: damaged, or deflected by wrong angles."""

    name = "control_effectiveness"
    equation = "deflection_i = scale_i deflection_i_asked, i the elevator, the ailerons, the rudder"
    source = "Ducard (2009), Fault-tolerant Flight Control and Guidance Systems, section 3.4 (loss of effectiveness)"
    table = tuple(Parameter(f"scale_{surface}", "1", 0.1, 2.0, 1.0) for surface in ("elevator", "aileron", "rudder"))
    systems = (FixedWing,)
    scaled: ClassVar[dict[str, str]] = {f"scale_{s}": f"max_{s}" for s in ("elevator", "aileron", "rudder")}


class TrimOffset(DynamicsEffect):
    """Control surfaces deflected at a command of 0: linkages out of trim.

    Coefficients are linear in the deflections, so that an offset adds a constant to each of them.
    """

    name = "trim_offset"
    equation = "deflection_i = deflection_i_asked + offset_i, i the elevator, the ailerons, the rudder"
    source = "Ding (2013), Model-Based Fault Diagnosis Techniques, section 3.5 (additive actuator fault)"
    table = (
        Parameter("elevator", "rad", -math.pi / 18, math.pi / 18, 0.0),
        Parameter("aileron", "rad", -math.pi / 36, math.pi / 36, 0.0),
        Parameter("rudder", "rad", -math.pi / 18, math.pi / 18, 0.0),
    )
    systems = (FixedWing,)

    def alter(self, system: System) -> System:
        wing = require_system(system, self)
        return replace(
            wing,
            lift_zero=wing.lift_zero + wing.lift_elevator * self.elevator,
            drag_zero=wing.drag_zero + wing.drag_elevator * self.elevator,
            pitch_zero=wing.pitch_zero + wing.pitch_elevator * self.elevator,
            side_zero=wing.side_zero + wing.side_aileron * self.aileron + wing.side_rudder * self.rudder,
            roll_zero=wing.roll_zero + wing.roll_aileron * self.aileron + wing.roll_rudder * self.rudder,
            yaw_zero=wing.yaw_zero + wing.yaw_aileron * self.aileron + wing.yaw_rudder * self.rudder,
        )

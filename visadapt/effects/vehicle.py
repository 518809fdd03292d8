"""Effects on the propulsion of a vehicle, and on the body of a quadrotor.

The quadrotor's flight controller does not account for any of them: it commands the thrust and the torques that the
source vehicle would need. Their order does not matter: factors multiply, and masses and offsets add.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar, Self

import torch
from torch import Tensor

from visadapt.effects.aerial import VEHICLES, Vehicle
from visadapt.effects.base import ActuationEffect, DynamicsEffect, Parameter, require_system
from visadapt.effects.parameters import ParameterScale, ParameterShift
from visadapt.effects.recurrence import linear_recurrence
from visadapt.systems import Quadrotor, System
from visadapt.systems.integrators import Duration
from visadapt.systems.rigid_body import matvec, stack_parameters

__all__ = [
    "BatterySag",
    "CenterOfMassOffset",
    "GroundEffect",
    "Inertia",
    "MotorLag",
    "Payload",
    "RateDamping",
    "RotorEfficiency",
    "ThrustGain",
]


def with_thrust(vehicle: Vehicle, factor: Tensor) -> Vehicle:
    """The vehicle whose thrust is multiplied by a factor, () or (B,), at every command."""
    ends = ("min_thrust", "max_thrust") if isinstance(vehicle, Quadrotor) else ("max_thrust",)
    return replace(vehicle, **{end: factor * getattr(vehicle, end) for end in ends})


class ThrustGain(DynamicsEffect):
    """Rotors or a propeller that give more or less thrust than commanded; torques are unchanged."""

    name = "thrust_gain"
    equation = "T = scale T_asked"
    source = "Beard and McLain (2012), Small Unmanned Aircraft, section 4.3"
    table = (Parameter("scale", "1", 0.3, 2.0, 1.0),)
    systems = VEHICLES
    indistinguishable_from = ("payload",)
    settled_by: ClassVar[Mapping[str, str]] = {
        "payload": "weigh the vehicle: a payload is on the scales, a thrust that is off is not"
    }

    scale: Tensor

    def alter(self, system: System) -> System:
        return with_thrust(require_system(system, self), self.scale)


class MotorLag(ActuationEffect):
    """Motors whose thrusts follow their commands as first-order systems: thrust and torques have the same lag.

    An actuator_lag is before the flight controller; this lag is inside its rate loop, whose torque follows the error
    w_asked - w late. It is modelled as the rate command a = w + d by which a vehicle without lag would turn as much,
    where d is the lagging torque divided by inertia and gain. The rate w in it is that of a vehicle with its actual
    inertia and rate_damping under its loop alone; the loop is taken to cancel other torques at once.
    """

    name = "motor_lag"
    equation = (
        "time_constant dT/dt = T_asked - T; time_constant dd/dt = w_asked - w - d, dw/dt = gain d - damping w; "
        "all from a command of 0"
    )
    source = (
        "Faessler, Falanga and Scaramuzza (2017), Thrust mixing, saturation, and body-rate control for accurate "
        "aggressive quadrotor flight"
    )
    table = (Parameter("time_constant", "s", 0.0, 0.3, 0.0),)
    systems = (Quadrotor,)

    loops: tuple[tuple[float | Tensor, ...], tuple[float | Tensor, ...]] | None = None
    """1/s, gain and damping of the loop around each command: 0 for the thrust; None (no loop) until bound"""

    def acting_on(self, system: System) -> Self:
        own = require_system(system, self)
        scales = (own.inertia_scale_x, own.inertia_scale_y, own.inertia_scale_z)
        gains = zip((own.roll_gain, own.roll_gain, own.yaw_gain), scales, strict=True)
        dampings = zip((own.damping_x, own.damping_y, own.damping_z), scales, strict=True)
        bound = copy.copy(self)
        bound.loops = (
            (0.0, *(gain / scale for gain, scale in gains)),
            (0.0, *(rate / scale for rate, scale in dampings)),
        )
        return bound

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        """w and d (B, 2, n_action); for the thrust, w is 0."""
        return torch.zeros_like(commands[:, :1]).repeat(1, 2, 1)

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        count = commands.shape[1]
        length = substep if isinstance(substep, Tensor) else commands.new_full((1, 1), substep)
        ratio = self.value("time_constant", commands).reshape(-1, 1) / length
        kept, brought = self._of_a_substep(ratio, length, commands)
        kept = kept.expand(-1, count, -1, -1, -1)
        after, kept = linear_recurrence(kept, commands[..., None] * brought, torch.matmul, matvec)
        after = after + matvec(kept, memory.movedim(1, 2)[:, None])
        before = torch.cat((memory[:, 1:], after[:, :-1, :, 1]), 1)
        # The mean of w + d over a substep, since time_constant dd/dt = command - (w + d).
        return commands + ratio[..., None] * (before - after[..., 1]), after[:, -1].movedim(2, 1)

    def _of_a_substep(self, ratio: Tensor, length: Tensor, commands: Tensor) -> tuple[Tensor, Tensor]:
        """Transitions of (w, d), (..., n_action, 2, 2), over substeps of `length` (B or 1, S or 1) s, and responses to
        a command of 1, (..., n_action, 2)."""
        none = (0.0,) * commands.shape[2]
        gain, damping = (
            length[..., None] * stack_parameters(values, commands).unsqueeze(-2)
            for values in self.loops or (none, none)
        )
        # As in actuator_lag: with exp(-1000) the limit is exact, and nothing divides by 0.
        rate = ratio.clamp_min(1e-3).reciprocal()[..., None]
        rate, gain, damping = torch.broadcast_tensors(rate, gain, damping)
        zero = torch.zeros_like(gain)
        flow = torch.stack((-damping, gain, zero, -rate, -rate, rate, zero, zero, zero), -1)
        whole = flow.unflatten(-1, (3, 3)).matrix_exp()
        return whole[..., :2, :2], whole[..., :2, 2]


class RateDamping(ParameterShift):
    """Aerodynamic damping of rotations: an arm that moves down meets air from below, which raises its rotor's thrust.

    Rates are per moment of inertia, like the derivatives L_p, M_q and N_r of flight dynamics, so that they compare
    between vehicles of any size.
    """

    name = "rate_damping"
    equation = "torque = -J_known diag(rate_x, rate_y, rate_z) w"
    source = "Padfield (2007), Helicopter Flight Dynamics, chapter 4 (L_p, M_q and N_r)"
    table = tuple(Parameter(f"rate_{axis}", "1/s", 0.0, 20.0, 0.0) for axis in "xyz")
    systems = (Quadrotor,)
    shifted: ClassVar[dict[str, str]] = {f"damping_{axis}": f"rate_{axis}" for axis in "xyz"}


class BatterySag(DynamicsEffect):
    """A battery whose voltage, and with it the collective thrust, decays from the start of the episode."""

    name = "battery_sag"
    equation = "T = exp(-rate t) T_asked"
    source = "Bangura and Mahony (2017), Thrust control for multirotor aerial vehicles (thrust follows the bus voltage)"
    table = (Parameter("rate", "1/s", 0.0, 0.2, 0.0),)
    systems = (Quadrotor,)

    def vary(self, system: System, time: Tensor, state: Tensor) -> System:
        return with_thrust(require_system(system, self), (-self.value("rate", state) * time).exp())


class GroundEffect(DynamicsEffect):
    """Additional thrust near the ground, where the rotors' wake is deflected.

    Cheeseman and Bennett's ratio holds above a height of about one radius and has a pole at a quarter of a radius. Here
    it rises to 4/3 at the ground and keeps that value below: with x = (radius / 4 height)^2, the x of the formula is
    x / (1 + (4 x)^4)^(1/4), which at a height of one radius is x to 0.1 %.
    """

    name = "ground_effect"
    equation = "T = T_asked / (1 - (radius / (4 (z - ground)))^2)"
    source = (
        "Cheeseman and Bennett (1955), The effect of the ground on a helicopter rotor in forward flight, ARC R&M 3021"
    )
    table = (Parameter("radius", "m", 0.0, 1.0, 0.0), Parameter("ground", "m", -3.0, 3.0, None))
    systems = (Quadrotor,)

    LEAST: ClassVar[float] = 1e-30  # m8, keeps the root positive where both height and radius are 0

    def vary(self, system: System, time: Tensor, state: Tensor) -> System:
        vehicle = require_system(system, self)
        height = (state[:, 2] - self.value("ground", state)).clamp_min(0)
        square = self.value("radius", state).square()
        # x / (1 + (4 x)^4)^(1/4), multiplied out: neither a height of 0 nor a radius of 0 is divided by.
        x = square / ((4 * height) ** 8 + (4 * square) ** 4 + self.LEAST) ** 0.25
        return with_thrust(vehicle, 1 / (1 - x))


class RotorEfficiency(ParameterScale):
    """Rotors of an X configuration that each give a share of their commanded thrust: chipped blades, a failing motor.

    Rotors are numbered from the front left, clockwise seen from above. Unequal shares couple thrust and torques.
    """

    name = "rotor_efficiency"
    equation = "f_i = scale_i f_i_asked, f_asked the rotor thrusts that the mixer computes from T and the torques"
    source = "Mahony, Kumar and Corke (2012), Multirotor aerial vehicles; numbers: Song et al. (2020), Flightmare"
    table = tuple(Parameter(f"scale_{k}", "1", 0.1, 1.5, 1.0) for k in (1, 2, 3, 4))
    systems = (Quadrotor,)
    scaled: ClassVar[dict[str, str]] = {f"scale_{k}": f"rotor_{k}" for k in (1, 2, 3, 4)}


class Inertia(ParameterScale):
    """Moments of inertia that differ from those that the rate loops assume."""

    name = "inertia"
    equation = "J = diag(scale_x, scale_y, scale_z) J_known"
    source = "Euler's equations: Stevens, Lewis and Johnson (2016), Aircraft Control and Simulation, section 1.7"
    table = tuple(Parameter(f"scale_{axis}", "1", 0.3, 4.0, 1.0) for axis in "xyz")
    systems = (Quadrotor,)
    scaled: ClassVar[dict[str, str]] = {f"scale_{axis}": f"inertia_scale_{axis}" for axis in "xyz"}


class Payload(ParameterShift):
    """A point mass at the quadrotor's centre that the flight controller does not account for.

    Weight and translational inertia grow, the rotors' force does not. Without other forces the motion is exactly that
    of a thrust_gain of m / (m + mass); only a gain above 1 cannot be a payload.
    """

    name = "payload"
    equation = "(m + mass) v' = T_asked m R e_z - (m + mass) g e_z, T_asked in m/s2"
    source = "Newton's second law; the paper's introduction (a payload)"
    table = (Parameter("mass", "kg", 0.0, 1.0, 0.0),)
    systems = (Quadrotor,)
    indistinguishable_from = ("thrust_gain",)
    shifted: ClassVar[dict[str, str]] = {"mass": "mass", "payload": "mass"}


class CenterOfMassOffset(ParameterShift):
    """A centre of mass beside the centre of the rotors: x ahead, y to the left.

    The state is that of the centre of mass, where the weight acts, so only thrust has a lever arm. Moments of inertia
    are unchanged, as they would change with the square of the offset.
    """

    name = "center_of_mass_offset"
    equation = "torque = -(x, y, 0) cross (0, 0, T) = (-y T, x T, 0)"
    source = "Stevens, Lewis and Johnson (2016), Aircraft Control and Simulation, section 2.3 (moment transfer)"
    table = (Parameter("x", "m", -0.1, 0.1, 0.0), Parameter("y", "m", -0.1, 0.1, 0.0))
    systems = (Quadrotor,)
    shifted: ClassVar[dict[str, str]] = {"centre_x": "x", "centre_y": "y"}

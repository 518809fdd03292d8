"""A small aeroplane with a propeller in front, an elevator, ailerons and a rudder.

Equations: Beard and McLain (2012), Small Unmanned Aircraft, chapters 3 and 4. Lift, drag, side force and moments are
linear (section 4.2); rates count as c q / (2 V), b p / (2 V) and b r / (2 V); moments are force times chord (pitch) or
span (roll, yaw). Coefficients have the book's signs and axes, x forward, y right, z down; state, force and torque are
in the body's, y left, z up.

Two things differ from the book. Thrust is a force along the body's x axis that follows the command without delay, as in
the paper. And the coefficients, which hold for attached flow, stay constant where angle of attack or sideslip exceed
`linear_range`: past the stall lift stays near its maximum instead of growing without bound, and drag stays positive.
Separated flow is not modelled (the book's flat plate, equation 4.9, needs numbers that are not published for this
aircraft), so drag is too small in a deep stall or a spin.

Numbers: the perching aircraft of Waldock, Greatwood, Salama and Richardson (2018), "Learning to perform a perched
landing on the ground using deep reinforcement learning", J. Intell. Robot. Syst. 92, as the paper's authors list them
(github.com/lis-epfl/apg_trajectory_tracking, neural_control/dynamics/config_fixed_wing.json); they were not compared
with Waldock's own table. All inertias, sizes and coefficients are that file's values; the 10 degrees of `linear_range`
are the bound in the code beside it; ranges of commands are the paper's. Not modelled: that file's thrust line, tilted
down by 0.165 rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import ClassVar

import torch
from torch import Tensor

from visadapt.systems.base import Variable, holds
from visadapt.systems.rigid_body import POSITION, VELOCITY, RigidBody, from_angles, matvec, stack_parameters

_FORCES = ("drag", "side", "lift", "roll", "pitch", "yaw")  # The last three are moments
_CAUSES = ("zero", "sideslip", "attack", "elevator", "aileron", "rudder", "roll_rate", "pitch_rate", "yaw_rate")
_DEGREE = math.pi / 180
_LEAST_AIRSPEED = 1e-6
"""m/s in the x-z plane; below it the angle of attack is undefined and taken as 0"""


@dataclass(frozen=True)
class FixedWing(RigidBody):
    """Defaults are Waldock's aircraft and the paper's ranges of commands (0.05 s between commands; starts at 11.5 m/s).

    A thrust command of -1 is no thrust and 1 is `max_thrust`. A positive elevator (trailing edge down) pushes the nose
    down, a positive aileron the left wing down, a positive rudder (trailing edge left) the nose to the left.
    Coefficients are dimensionless, or 1/rad. `<force or moment>_<cause>` is the slope of the first over the second;
    `<force or moment>_zero` is the value without any cause, which is 0 sideways for a symmetric aircraft.

    Roll rate decays with a rate of 1.95 V in 1/s at an airspeed V in m/s. RK4 with steps of 0.05 s is stable for that
    up to 28 m/s; a dive needs shorter steps.

    >>> import torch, visadapt as va
    >>> state, command = va.FixedWing().trim(torch.tensor([11.5]))
    >>> state.shape, command.shape
    (torch.Size([1, 13]), torch.Size([1, 4]))
    """

    mass: float | Tensor = 1.01  # kg
    inertia_x: float | Tensor = 0.04766  # kg m2, J_x, roll
    inertia_y: float | Tensor = 0.05005  # kg m2, J_y, pitch
    inertia_z: float | Tensor = 0.09558  # kg m2, J_z, yaw
    inertia_xz: float | Tensor = -0.00105  # kg m2, J_xz, the integral of x z dm with z down, as in the book
    wing_area: float | Tensor = 0.276  # m2, S
    span: float | Tensor = 1.54  # m, b
    chord: float | Tensor = 0.185  # m, c, mean
    air_density: float | Tensor = 1.225  # kg/m3
    gravity: float | Tensor = 9.81  # m/s2
    max_thrust: float | Tensor = 7.0  # N at a command of 1
    max_elevator: float | Tensor = 20 * _DEGREE  # rad at a command of 1
    max_aileron: float | Tensor = 2.5 * _DEGREE  # rad at a command of 1
    max_rudder: float | Tensor = 20 * _DEGREE  # rad at a command of 1
    linear_range: float | Tensor = 10 * _DEGREE  # rad of attack and sideslip, beyond which coefficients stay constant
    wind_x: float | Tensor = 0.0  # m/s, velocity of the air in world axes
    wind_y: float | Tensor = 0.0  # m/s
    wind_z: float | Tensor = 0.0  # m/s

    lift_zero: float | Tensor = 0.39  # C_L0
    lift_attack: float | Tensor = 4.5321  # C_Lalpha, the lift slope
    lift_pitch_rate: float | Tensor = 0.318  # C_Lq
    lift_elevator: float | Tensor = 0.527  # C_Ldelta_e
    drag_zero: float | Tensor = 0.0765  # C_D0
    drag_attack: float | Tensor = 0.3346  # C_Dalpha
    drag_pitch_rate: float | Tensor = 0.354  # C_Dq
    drag_elevator: float | Tensor = 0.004  # C_Ddelta_e
    side_zero: float | Tensor = 0.0  # C_Y0
    side_sideslip: float | Tensor = -0.033  # C_Ybeta
    side_roll_rate: float | Tensor = -0.1  # C_Yp
    side_yaw_rate: float | Tensor = 0.039  # C_Yr
    side_aileron: float | Tensor = 0.0  # C_Ydelta_a
    side_rudder: float | Tensor = 0.225  # C_Ydelta_r
    roll_zero: float | Tensor = 0.0  # C_l0
    roll_sideslip: float | Tensor = -0.081  # C_lbeta
    roll_roll_rate: float | Tensor = -0.529  # C_lp
    roll_yaw_rate: float | Tensor = 0.159  # C_lr
    roll_aileron: float | Tensor = -0.453  # C_ldelta_a
    roll_rudder: float | Tensor = 0.005  # C_ldelta_r
    pitch_zero: float | Tensor = 0.02  # C_m0
    pitch_attack: float | Tensor = -1.4037  # C_malpha
    pitch_pitch_rate: float | Tensor = -0.1324  # C_mq
    pitch_elevator: float | Tensor = -0.4236  # C_mdelta_e
    yaw_zero: float | Tensor = 0.0  # C_n0
    yaw_sideslip: float | Tensor = 0.189  # C_nbeta
    yaw_roll_rate: float | Tensor = -0.083  # C_np
    yaw_yaw_rate: float | Tensor = -0.948  # C_nr
    yaw_aileron: float | Tensor = -0.041  # C_ndelta_a
    yaw_rudder: float | Tensor = -0.077  # C_ndelta_r

    name: ClassVar[str] = "fixed_wing"
    longest_step: ClassVar[float | None] = 0.05  # the roll rate decays at 1.95 per metre flown, at 11.5 m/s
    actions: ClassVar[tuple[Variable, ...]] = tuple(
        Variable(name, "1", -1.0, 1.0) for name in ("thrust", "elevator", "aileron", "rudder")
    )

    def __post_init__(self) -> None:
        signed = ("inertia_xz", *(f.name for f in fields(self) if f.name.startswith((*_FORCES, "wind"))))
        self.check_parameters(either_sign=signed)
        if not holds(self.inertia_xz**2 < self.inertia_x * self.inertia_z):
            raise ValueError(
                "fixed_wing: inertia_xz must be smaller than the geometric mean of inertia_x and inertia_z, "
                f"got {self.inertia_xz!r}"
            )

    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        wind = (self.wind_x, self.wind_y, self.wind_z)
        if not any(isinstance(value, Tensor) or value for value in wind):
            return super().derivative(state, command, load)
        # All derivatives but the position's are those in still air at the velocity relative to the air.
        velocity = state[:, VELOCITY]
        airborne = torch.cat(
            (state[:, POSITION], velocity - stack_parameters(wind, state), state[:, VELOCITY.stop :]), 1
        )
        change = super().derivative(airborne, command, load)
        return torch.cat((velocity, change[:, VELOCITY.start :]), 1)

    def inertia(self, like: Tensor) -> Tensor:
        # With z up, the product of inertia has the opposite sign of the book's.
        x, y, z, xz = self.inertia_x, self.inertia_y, self.inertia_z, self.inertia_xz
        return stack_parameters((x, 0.0, xz, 0.0, y, 0.0, xz, 0.0, z), like).unflatten(-1, (3, 3))

    def wrench(self, velocity: Tensor, rates: Tensor, command: Tensor) -> tuple[Tensor, Tensor]:
        """Beard and McLain's section 4.2, and thrust; force and torque (B, 3) each."""
        like = velocity.dtype, velocity.device
        table, limit = _constant_table(self, *like) if self.is_constant else self.coefficients(velocity)
        plane, speed = velocity[:, ::2], velocity.norm(dim=-1, keepdim=True)
        in_plane = plane.norm(dim=-1, keepdim=True).clamp_min(_LEAST_AIRSPEED)
        ahead = torch.where(in_plane > _LEAST_AIRSPEED, velocity[:, :1], 1.0)  # atan2 has no gradient at (0, 0)
        # Minus sideslip and minus angle of attack, since y is left and z is up; the table's entries undo the sign.
        angles = torch.atan2(velocity[:, 1:], torch.cat((in_plane, ahead), -1)).clamp(-limit, limit)
        # The causes times V. Forces are V times their sum: rates enter as c q / (2 V), and no division by V is left.
        causes = torch.cat((speed, speed * torch.cat((angles, command[:, 1:]), -1), rates), -1)
        aerodynamic = speed * matvec(table, causes)
        drag, side, lift = aerodynamic[:, :3].unbind(-1)
        forward, upward = (plane / in_plane).unbind(-1)
        thrust = self.max_thrust * (command[:, 0] + 1) / 2
        force = torch.stack((thrust - drag * forward - lift * upward, side, lift * forward - drag * upward), -1)
        return force, aerodynamic[:, 3:]

    def trim(self, speed: Tensor) -> tuple[Tensor, Tensor]:
        """States (B, 13) and commands (B, 4) of steady level flight, with the nose along +x, at airspeeds (B,) in m/s.

        A wind carries the wing along; where it rises or sinks, its vertical part adds to the airspeed.

        Solves acceleration = 0 and angular acceleration = 0 for roll, pitch, and the four commands by Newton's method,
        in float64. Not differentiable.

        Raises:
            ValueError: there is no such flight, because it stalls or needs a command beyond [-1, 1].
        """
        speeds, like = speed.detach().double(), speed if speed.is_floating_point() else speed.float()
        system = self.to(speeds)
        still = torch.zeros(len(speeds), 12, dtype=torch.float64, device=speeds.device)
        drift = stack_parameters((system.wind_x, system.wind_y, 0.0), still).expand(len(speeds), 3)
        velocity = torch.cat((speeds[:, None], still[:, :2]), 1) + drift

        def flight(unknown: Tensor) -> tuple[Tensor, Tensor]:
            attitude = from_angles(torch.cat((unknown[:, :2], still[:, :1]), 1))
            return torch.cat((still[:, :3], velocity, attitude, still[:, :3]), 1), unknown[:, 2:]

        def imbalance(unknown: Tensor) -> Tensor:
            change = system.derivative(*flight(unknown), still[:, :6])
            return torch.cat((change[:, 3:6], change[:, 10:]), 1)

        unknown = still[:, :6].clone()
        for _ in range(20):
            left = imbalance(unknown).detach()
            if left.abs().max() < 1e-10:
                break
            # Rows do not touch each other, so the gradient of their sum holds the gradient of each.
            jacobian = torch.autograd.functional.jacobian(lambda at: imbalance(at).sum(0), unknown)
            unknown = unknown - torch.linalg.solve_ex(jacobian.movedim(1, 0), left)[0]
        state, command = (part.detach() for part in flight(unknown))
        found = (imbalance(unknown).detach().abs() < 1e-8).all(1) & (command.abs() <= 1).all(1)
        if not bool(found.all()):
            raise ValueError(f"fixed_wing: no level flight within the commands at {float(speeds[~found][0]):g} m/s")
        return state.to(like), command.to(like)

    def coefficients(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """What one unit of each cause adds to each force or moment, in the body's axes, and the limit of the angles.

        (6, 9) and (1,), or (B, 6, 9) and (B, 1) where a parameter is (B,). Entries become N and N m when they are
        multiplied by the airspeed and by the cause, which is the airspeed times an angle, or a rate.
        """
        unit = self.air_density * self.wing_area / 2
        forces = (unit, -unit, unit, unit * self.span, -unit * self.chord, -unit * self.span)
        surfaces = (self.max_elevator, self.max_aileron, self.max_rudder)
        causes = (1.0, -1.0, -1.0, *surfaces, self.span / 2, -self.chord / 2, -self.span / 2)
        values = [
            getattr(self, name) * forces[row] * causes[column] if name else 0.0
            for row, names in enumerate(_TABLE)
            for column, name in enumerate(names)
        ]
        gathered = stack_parameters([*values, self.linear_range], like)
        return gathered[..., :-1].unflatten(-1, (len(_FORCES), len(_CAUSES))), gathered[..., -1:]


@lru_cache(64)
def _constant_table(wing: FixedWing, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    with torch.inference_mode(False):
        return wing.coefficients(torch.empty(0, dtype=dtype, device=device))


_TABLE = tuple(
    tuple(name if (name := f"{force}_{cause}") in FixedWing.__dataclass_fields__ else "" for cause in _CAUSES)
    for force in _FORCES
)
"""Names of the coefficients, a row for each force or moment; empty where a cause does not change it."""

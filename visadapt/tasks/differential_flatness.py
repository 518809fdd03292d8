"""What a motion asks of a quadrotor: thrust, attitude and body rates from derivatives of the position.

A quadrotor without drag is differentially flat in position and yaw: Mellinger and Kumar (2011), Minimum snap
trajectory generation and control for quadrotors, ICRA. Thrust points along a + g z and the jerk turns it:

    thrust = |a + g z|        z_body = (a + g z) / thrust        z_rate = (j - (z_body . j) z_body) / thrust
    y_body = z_body x e_x, normalised        x_body = y_body x z_body        (yaw is zero)
    omega_x = -z_rate . y_body        omega_y = z_rate . x_body        omega_z = omega_x (z_body . e_x) / (x_body . e_x)

omega_z keeps y_body at right angles to e_x (Faessler, Franchi and Scaramuzza 2018, RA-L 3(2), without drag); it is
not zero, though yaw stands still. Vectors a (acceleration) and j (jerk) are in world axes, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.systems import Quadrotor

TIME_STEP = 1e-4  # s, of the difference that takes the place of a derivative: in float64, right to about 1e-7 rad/s2


@dataclass(frozen=True)
class Demand:
    """What a motion asks for, for each of its instants."""

    thrust: Tensor  # (...) m/s2, mass-normalised
    attitude: Tensor  # (..., 4) quaternion w, x, y, z, with w positive
    rates: Tensor  # (..., 3) rad/s, about the body's axes

    def state(self, position: Tensor, velocity: Tensor) -> Tensor:
        """The quadrotor's state (..., 13) at positions (..., 3) and velocities (..., 3)."""
        return torch.cat((position, velocity, self.attitude, self.rates), -1)


def demanded(acceleration: Tensor, jerk: Tensor, gravity: float = 9.81) -> Demand:
    """What accelerations (..., 3) in m/s2 and jerks (..., 3) in m/s3 ask for, with yaw zero.

    There is no answer where the thrust vanishes (free fall) or points along the x axis.
    """
    pull = acceleration + gravity * acceleration.new_tensor((0.0, 0.0, 1.0))
    thrust = pull.norm(dim=-1, keepdim=True)
    up = pull / thrust
    ahead = acceleration.new_tensor((1.0, 0.0, 0.0)).expand_as(up)
    left = torch.linalg.cross(up, ahead)
    left = left / left.norm(dim=-1, keepdim=True)
    forward = torch.linalg.cross(left, up)
    up_rate = (jerk - up * (up * jerk).sum(-1, keepdim=True)) / thrust
    roll, pitch = -(up_rate * left).sum(-1), (up_rate * forward).sum(-1)
    rates = torch.stack((roll, pitch, roll * up[..., 0] / forward[..., 0]), -1)
    return Demand(thrust[..., 0], _attitude(torch.stack((forward, left, up), -1)), rates)


def commands(acceleration: Tensor, jerk: Tensor, snap: Tensor, quadrotor: Quadrotor) -> Tensor:
    """Commands (..., 4) that carry out a motion exactly, lag of the rate loop included; in [-1, 1] if it is feasible.

    The loop closes omega' = gain (asked - omega), so it is asked for omega + omega' / gain. omega', which needs the
    snap (..., 3) in m/s4, is the difference of omega a little earlier and later.
    """
    a, j, s = (derivative.double() for derivative in (acceleration, jerk, snap))
    times, gravity = (-TIME_STEP, 0.0, TIME_STEP), float(quadrotor.gravity)
    before, now, after = (demanded(a + t * j, j + t * s, gravity) for t in times)
    thrust, rates, change = now.thrust, now.rates, (after.rates - before.rates) / (2 * TIME_STEP)
    gain = rates.new_tensor([float(g) for g in (quadrotor.roll_gain, quadrotor.roll_gain, quadrotor.yaw_gain)])
    low, high = float(quadrotor.min_thrust), float(quadrotor.max_thrust)
    lift = (2 * thrust - high - low) / (high - low)
    asked = torch.cat((lift[..., None], (rates + change / gain) / float(quadrotor.max_rate)), -1)
    return asked.to(acceleration)


def _attitude(rotation: Tensor) -> Tensor:
    """Quaternions (..., 4) of rotations (..., 3, 3) that keep the body's z axis above the horizon.

    With yaw zero, w is then far from zero, so the plain formula is safe: w = sqrt(1 + trace) / 2.
    """
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    w = (1 + trace).sqrt() / 2
    turned = rotation - rotation.mT
    xyz = torch.stack((turned[..., 2, 1], turned[..., 0, 2], turned[..., 1, 0]), -1)
    return torch.cat((w[..., None], xyz / (4 * w[..., None])), -1)

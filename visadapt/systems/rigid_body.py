"""A flying rigid body: the equations of motion that quadrotor and fixed wing share.

Frames follow ROS's REP 103: the world's z axis points up; the body's x axis points forward, y left, z up. Attitude
is a quaternion (w, x, y, z) that rotates body into world axes, so no attitude is singular. It need not have length 1:
it is normalised wherever it is used.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import lru_cache
from typing import ClassVar

import torch
from torch import Tensor

from visadapt.systems.base import System, Variable

POSITION, VELOCITY, ATTITUDE, RATES = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)
"""Columns of the state."""

# Matrices (I J, K) that map the flattened products of two vectors, (I,) and (J,), to a vector (K,): one matrix product
# is faster than many small operations.
# fmt: off
_ROTATION = torch.tensor([
    #w:w  x  y  z    x:w  x  y  z    y:w  x  y  z    z:w  x  y  z
    (1, 0, 0, 0,     0, 1, 0, 0,     0, 0, -1, 0,    0, 0, 0, -1),  # R11 = w^2 + x^2 - y^2 - z^2
    (0, 0, 0, -2,    0, 0, 2, 0,     0, 0, 0, 0,     0, 0, 0, 0),   # R12 = 2 (x y - w z)
    (0, 0, 2, 0,     0, 0, 0, 2,     0, 0, 0, 0,     0, 0, 0, 0),   # R13 = 2 (x z + w y)
    (0, 0, 0, 2,     0, 0, 2, 0,     0, 0, 0, 0,     0, 0, 0, 0),   # R21 = 2 (x y + w z)
    (1, 0, 0, 0,     0, -1, 0, 0,    0, 0, 1, 0,     0, 0, 0, -1),  # R22 = w^2 - x^2 + y^2 - z^2
    (0, -2, 0, 0,    0, 0, 0, 0,     0, 0, 0, 2,     0, 0, 0, 0),   # R23 = 2 (y z - w x)
    (0, 0, -2, 0,    0, 0, 0, 2,     0, 0, 0, 0,     0, 0, 0, 0),   # R31 = 2 (x z - w y)
    (0, 2, 0, 0,     0, 0, 0, 0,     0, 0, 0, 2,     0, 0, 0, 0),   # R32 = 2 (y z + w x)
    (1, 0, 0, 0,     0, -1, 0, 0,    0, 0, -1, 0,    0, 0, 0, 1),   # R33 = w^2 - x^2 - y^2 + z^2
]).T.contiguous().float()
"""From the products of (w, x, y, z) with itself, (16,), to the rotation matrix by rows, (9,), of a unit quaternion."""
_RATE = torch.tensor([
    #w:p  q  r    x:p  q  r    y:p  q  r    z:p  q  r
    (0, 0, 0,     -1, 0, 0,    0, -1, 0,    0, 0, -1),  # 2 w' = -x p - y q - z r
    (1, 0, 0,     0, 0, 0,     0, 0, 1,     0, -1, 0),  # 2 x' = w p + y r - z q
    (0, 1, 0,     0, 0, -1,    0, 0, 0,     1, 0, 0),   # 2 y' = w q - x r + z p
    (0, 0, 1,     0, 1, 0,     -1, 0, 0,    0, 0, 0),   # 2 z' = w r + x q - y p
]).T.contiguous() / 2
"""From the products of (w, x, y, z) with the body rates (p, q, r), (12,), to the rates of (w, x, y, z), (4,)."""
# fmt: on


class RigidBody(System):
    """Newton's and Euler's equations; a subclass gives the force and torque on the body.

    Stevens, Lewis and Johnson (2016), Aircraft Control and Simulation, section 1.7 (flat earth).
    """

    states: ClassVar[tuple[Variable, ...]] = (
        *(Variable(name, "m", -100.0, 100.0) for name in ("x", "y", "z")),
        *(Variable(name, "m/s", -30.0, 30.0) for name in ("x_dot", "y_dot", "z_dot")),
        *(Variable(name, "1", -1.0, 1.0) for name in ("q_w", "q_x", "q_y", "q_z")),
        *(Variable(name, "rad/s", -20.0, 20.0) for name in ("omega_x", "omega_y", "omega_z")),
    )
    loads: ClassVar[tuple[Variable, ...]] = (
        *(Variable(name, "N", -100.0, 100.0) for name in ("force_x", "force_y", "force_z")),
        *(Variable(name, "N m", -10.0, 10.0) for name in ("torque_x", "torque_y", "torque_z")),
    )
    """A force in world axes and a torque in body axes."""

    mass: float | Tensor  # kg
    gravity: float | Tensor  # m/s2

    def load_scale(self, unit: str) -> float:
        """For forces and torques, the weight over that of the default vehicle, at least 1; 1 for other units."""
        default = type(self)()
        ratio = float(self.mass * self.gravity) / float(default.mass * default.gravity)
        return max(1.0, ratio) if unit.startswith("N") else 1.0

    @abstractmethod
    def wrench(self, velocity: Tensor, rates: Tensor, command: Tensor) -> tuple[Tensor, Tensor]:
        """Force (B, 3) in N and torque (B, 3) in N m on the body, in body axes, without its weight.

        `velocity` (B, 3) and `rates` (B, 3) are in body axes, in m/s and rad/s.
        """

    @abstractmethod
    def inertia(self, like: Tensor) -> Tensor:
        """Moments of inertia in body axes, kg m2: (3, 3), or (B, 3, 3)."""

    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        velocity, attitude, rates = state[:, VELOCITY], state[:, ATTITUDE], state[:, RATES]
        turned = rotation(attitude)
        force, torque = self.wrench(matvec(turned.mT, velocity), rates, command)
        inertia = self.inertia(state)
        inverse = _inverse_inertia(self, state.dtype, state.device) if self.is_constant else inertia.inverse()
        whole = torque + load[:, 3:] - torch.linalg.cross(rates, matvec(inertia, rates))
        weight = as_column(self.gravity) * constant((0.0, 0.0, 1.0), state.dtype, state.device)
        acceleration = (matvec(turned, force) + load[:, :3]) / as_column(self.mass) - weight
        return torch.cat((velocity, acceleration, quaternion_rate(attitude, rates), matvec(inverse, whole)), 1)


def as_column(value: float | Tensor) -> float | Tensor:
    """A parameter, () or (B,), in a shape that multiplies (B, n)."""
    return value[:, None] if isinstance(value, Tensor) and value.dim() else value


def stack_parameters(values: Sequence[float | Tensor], like: Tensor) -> Tensor:
    """Parameters gathered in a tensor (n,), or (B, n) if one of them is (B,). It is not to be written to."""
    tensors = {i: value for i, value in enumerate(values) if isinstance(value, Tensor)}
    numbers = tuple(0.0 if isinstance(value, Tensor) else value for value in values)
    gathered = constant(numbers, like.dtype, like.device)
    if tensors:
        gathered = gathered.repeat(*torch.broadcast_shapes(*(value.shape for value in tensors.values())), 1)
        for i, value in tensors.items():
            gathered[..., i] = value
    return gathered


@lru_cache(256)
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Numbers as a tensor (n,), made once: an integration asks for the same ones thousands of times."""
    with torch.inference_mode(False):  # else no gradient could pass what is multiplied by it
        return torch.tensor(values, dtype=dtype, device=device)


@lru_cache(64)
def _inverse_inertia(system: RigidBody, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return system.inertia(torch.empty(0, dtype=dtype, device=device)).inverse()


def matvec(matrix: Tensor, vector: Tensor) -> Tensor:
    """A matrix (n, n), or one for each vector (..., n, n), times vectors (..., n)."""
    return (matrix @ vector[..., None])[..., 0] if matrix.dim() > 2 else vector @ matrix.mT


def rotation(attitude: Tensor) -> Tensor:
    """Rotation matrices (B, 3, 3) from body to world axes, of attitudes (B, 4) (`_ROTATION`)."""
    products = (attitude[:, :, None] * attitude[:, None]).flatten(1)
    unit = products / attitude.square().sum(-1, keepdim=True)
    return (unit @ _ROTATION.to(attitude)).unflatten(-1, (3, 3))


def quaternion_rate(attitude: Tensor, rates: Tensor) -> Tensor:
    """Time derivative (B, 4) of attitudes (B, 4) under body rates (B, 3): q' = q (0, rates) / 2 (`_RATE`)."""
    return (attitude[:, :, None] * rates[:, None]).flatten(1) @ _RATE.to(attitude)


def from_angles(angles: Tensor) -> Tensor:
    """Attitudes (B, 4) of roll, pitch and yaw (B, 3) in rad, turned about z, then y, then x.

    With z up, a positive pitch points the nose down.
    """
    (cr, cp, cy), (sr, sp, sy) = (angles / 2).cos().unbind(-1), (angles / 2).sin().unbind(-1)
    return torch.stack(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ),
        -1,
    )


def continuous_quaternion(values: Tensor) -> Tensor:
    """Quaternions in time (T, 4), or components of them (T, k), without jumps of sign: q and -q are one attitude."""
    jumps = (values[1:] * values[:-1]).sum(1) < 0
    return torch.cat([values[:1], values[1:] * torch.where(jumps, -1.0, 1.0).to(values).cumprod(0)[:, None]])

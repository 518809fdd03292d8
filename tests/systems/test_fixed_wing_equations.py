"""The fixed wing's motion against Beard and McLain's equations, written again from the book and solved by scipy."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from tests.wings import LOPSIDED, double, state_of
from visadapt.systems import FixedWing

FLIP = np.diag([1.0, -1.0, -1.0])
"""From z up to north, east, down and from (forward, left, up) to (forward, right, down), and back."""


def book_derivative(wing, t, x, command, force, torque):
    """Beard and McLain's equations (3.14) to (3.17) and section 4.2, written apart: 12 states, Euler angles, z down."""
    u, v, w, phi, theta, psi, p, q, r = x[3:]
    to_world = Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
    elevator, aileron, rudder = command[1:] * np.array([wing.max_elevator, wing.max_aileron, wing.max_rudder])
    airspeed = math.sqrt(u * u + v * v + w * w)
    attack, sideslip = math.atan2(w, u), math.asin(v / airspeed)
    a, s = (max(-wing.linear_range, min(wing.linear_range, angle)) for angle in (attack, sideslip))
    ph, qh, rh = (k * n / (2 * airspeed) for k, n in ((wing.span, p), (wing.chord, q), (wing.span, r)))

    def longitudinal(name):
        zero, slope, rate, surface = (
            getattr(wing, f"{name}_{c}") for c in ("zero", "attack", "pitch_rate", "elevator")
        )
        return zero + slope * a + rate * qh + surface * elevator

    def lateral(name):
        causes = ("zero", "sideslip", "roll_rate", "yaw_rate", "aileron", "rudder")
        return np.dot([getattr(wing, f"{name}_{c}") for c in causes], [1.0, s, ph, rh, aileron, rudder])

    pressure = 0.5 * wing.air_density * airspeed**2 * wing.wing_area
    lift, drag, side = pressure * longitudinal("lift"), pressure * longitudinal("drag"), pressure * lateral("side")
    thrust = wing.max_thrust * (command[0] + 1) / 2
    fx, fy, fz = to_world.T @ force + [
        thrust - wing.mass * wing.gravity * math.sin(theta) - drag * math.cos(attack) + lift * math.sin(attack),
        wing.mass * wing.gravity * math.cos(theta) * math.sin(phi) + side,
        wing.mass * wing.gravity * math.cos(theta) * math.cos(phi) - drag * math.sin(attack) - lift * math.cos(attack),
    ]
    l = torque[0] + pressure * wing.span * lateral("roll")  # noqa: E741
    m = torque[1] + pressure * wing.chord * longitudinal("pitch")
    n = torque[2] + pressure * wing.span * lateral("yaw")
    jx, jy, jz, jxz = wing.inertia_x, wing.inertia_y, wing.inertia_z, wing.inertia_xz
    gamma = jx * jz - jxz**2
    gamma1, gamma2 = jxz * (jx - jy + jz) / gamma, (jz * (jz - jy) + jxz**2) / gamma
    gamma3, gamma4, gamma5, gamma6 = jz / gamma, jxz / gamma, (jz - jx) / jy, jxz / jy
    gamma7, gamma8 = ((jx - jy) * jx + jxz**2) / gamma, jx / gamma
    return np.array(
        [
            *(to_world @ [u, v, w]),
            r * v - q * w + fx / wing.mass,
            p * w - r * u + fy / wing.mass,
            q * u - p * v + fz / wing.mass,
            p + q * math.sin(phi) * math.tan(theta) + r * math.cos(phi) * math.tan(theta),
            q * math.cos(phi) - r * math.sin(phi),
            (q * math.sin(phi) + r * math.cos(phi)) / math.cos(theta),
            gamma1 * p * q - gamma2 * q * r + gamma3 * l + gamma4 * n,
            gamma5 * p * r - gamma6 * (p * p - r * r) + m / jy,
            gamma7 * p * q - gamma1 * q * r + gamma4 * l + gamma8 * n,
        ]
    )


def matrix(attitude):
    return Rotation.from_quat(np.roll(attitude, -1)).as_matrix()


def to_book(state):
    turned = FLIP @ matrix(state[6:10]) @ FLIP
    yaw, pitch, roll = Rotation.from_matrix(turned).as_euler("ZYX")
    return np.concatenate((FLIP @ state[:3], turned.T @ FLIP @ state[3:6], [roll, pitch, yaw], FLIP @ state[10:]))


def from_book(x):
    """Position, velocity, rotation matrix and rates with z up, flat."""
    turned = Rotation.from_euler("ZYX", x[[8, 7, 6]]).as_matrix()
    return np.concatenate((FLIP @ x[:3], FLIP @ turned @ x[3:6], (FLIP @ turned @ FLIP).ravel(), FLIP @ x[9:]))


STARTS = {
    "cruise": (state_of((11.5, 0.0, 0.0)), (-0.5, 0.0, 0.0, 0.0), (0.0,) * 6),
    "full deflections": (state_of((14.0, 0.0, 1.0)), (1.0, -0.6, 1.0, -0.7), (0.0,) * 6),
    "banked in sideslip, a gust": (
        state_of((9.0, 3.0, -1.0), (0.6, 0.1, 0.3), (0.5, -0.4, 0.3)),
        (0.0, 0.3, -0.5, 0.2),
        (0.5, -1.0, 0.3, 0.01, -0.02, 0.03),
    ),
    "stalled": (state_of((5.0, 0.5, -3.0), (0.1, -0.5, 1.0)), (1.0, -1.0, 0.0, 0.5), (0.0,) * 6),
    "on its back": (state_of((13.0, 1.0, 0.0), (3.0, 0.0, -2.0), (1.0, 0.5, 0.0)), (-1.0, 0.8, 0.2, 0.0), (0.0,) * 6),
}


@pytest.mark.parametrize("wing", [FixedWing(), LOPSIDED])
def test_motion_agrees_with_the_equations_of_the_book_solved_apart(wing):
    starts, commands, loads = zip(*STARTS.values(), strict=True)
    state, command, load = torch.cat(starts), double(commands), double(loads)

    def derivative(_, y):
        return wing.derivative(double(y).reshape(state.shape), command, load).numpy().ravel()

    def solved(derivative, start):
        # Short steps, since the slope of a coefficient jumps at the end of its range.
        times = np.linspace(0, 1, 6)
        return solve_ivp(derivative, (0, 1), start, "DOP853", times, max_step=0.02, rtol=1e-9, atol=1e-9).y.T

    ours = solved(derivative, state.numpy().ravel()).reshape(-1, *state.shape)
    for i, (start, u, f) in enumerate(zip(state.numpy(), command.numpy(), load.numpy(), strict=True)):
        arguments = (u, FLIP @ f[:3], FLIP @ f[3:])
        book = solved(lambda t, x, arguments=arguments: book_derivative(wing, t, x, *arguments), to_book(start))
        for y, x in zip(ours[:, i], book, strict=True):
            flat = np.concatenate((y[:6], matrix(y[6:10]).ravel(), y[10:]))
            np.testing.assert_allclose(flat, from_book(x), rtol=1e-6, atol=1e-6)

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from tests.rigid_bodies import HEAVY, fly, random_states
from visadapt.systems import Quadrotor, RigidBody
from visadapt.systems.rigid_body import (
    ATTITUDE,
    RATES,
    VELOCITY,
    continuous_quaternion,
    from_angles,
    quaternion_rate,
    rotation,
)


@dataclass(frozen=True)
class Tumbling(RigidBody):
    """A body that nothing touches."""

    mass: float = 0.8
    gravity: float = 9.81
    actions: ClassVar = Quadrotor.actions

    def wrench(self, velocity, rates, command):
        return torch.zeros_like(velocity), torch.zeros_like(velocity)

    def inertia(self, like):
        return like.new_tensor(((0.02, 0.001, 0.0), (0.001, 0.03, -0.002), (0.0, -0.002, 0.045)))


def test_a_body_that_nothing_turns_keeps_its_angular_momentum_and_its_energy():
    system = Tumbling()
    start = random_states(3)
    start[:, RATES] *= 5
    states = fly(system, start, torch.zeros(10, 3, 4, dtype=torch.float64), period=0.1, substeps=100)

    def kept(state):
        spun = state[:, RATES] @ system.inertia(state)
        momentum = (rotation(state[:, ATTITUDE]) @ spun[..., None])[..., 0]
        height, speed = state[:, 2], state[:, VELOCITY]
        linear = system.mass * (speed.square().sum(1) / 2 + system.gravity * height)
        return torch.cat((momentum, (spun * state[:, RATES]).sum(1, keepdim=True) / 2, linear[:, None]), 1)

    assert (states[-1, :, RATES] - start[:, RATES]).abs().max() > 1
    torch.testing.assert_close(kept(states[-1]), kept(start), rtol=1e-8, atol=1e-9)


def test_loads_are_a_force_in_world_axes_and_a_torque_in_body_axes():
    state = random_states(5)
    command = random_states(5, seed=1)[:, :4]
    load = random_states(5, seed=2)[:, :6]
    change = HEAVY.derivative(state, command, load) - HEAVY.derivative(state, command, torch.zeros_like(load))
    torch.testing.assert_close(change[:, VELOCITY], load[:, :3] / 1.7)
    inertia = 1.7 * 0.3**2 / 12 * torch.tensor([4.5, 4.5, 7.0], dtype=torch.float64)
    torch.testing.assert_close(change[:, RATES], load[:, 3:] / inertia)


def test_physics_does_not_know_the_norm_of_the_quaternion_nor_its_sign():
    state, command, load = random_states(6), random_states(6, seed=1)[:, :4], random_states(6, seed=2)[:, :6]
    for factor in (0.3, -1.0, -4.0):
        scaled = state.clone()
        scaled[:, ATTITUDE] *= factor
        expected = HEAVY.derivative(state, command, load)
        expected[:, ATTITUDE] *= factor
        torch.testing.assert_close(HEAVY.derivative(scaled, command, load), expected)


def test_attitudes_agree_with_scipy():
    attitude, vector = random_states(20)[:, ATTITUDE], random_states(20, seed=1)[:, :3]
    own = Rotation.from_quat(attitude.numpy(), scalar_first=True)
    np.testing.assert_allclose(rotation(attitude), own.as_matrix(), atol=1e-12)
    angles = vector.clamp(-1.5, 1.5)
    made = Rotation.from_euler("ZYX", angles.flip(1).numpy())
    np.testing.assert_allclose(rotation(from_angles(angles)), made.as_matrix(), atol=1e-12)


NUMBERS = st.floats(-10, 10, allow_subnormal=False)
QUATERNIONS = st.tuples(*[NUMBERS] * 4).filter(lambda q: sum(each * each for each in q) > 1e-4)
VECTORS = st.tuples(*[NUMBERS] * 3)


def product(p, q):
    """Hamilton's product, (4,), of quaternions (w, x, y, z), with a scalar and a vector part."""
    cross = torch.linalg.cross(p[1:], q[1:])
    return torch.cat(((p[0] * q[0] - p[1:] @ q[1:])[None], p[0] * q[1:] + q[0] * p[1:] + cross))


@given(QUATERNIONS, VECTORS)
def test_a_vector_is_rotated_and_an_attitude_turns_by_the_quaternion_product(q, v):
    q, vector = torch.tensor(q, dtype=torch.float64), torch.tensor((0.0, *v), dtype=torch.float64)
    conjugate = q * torch.tensor([1, -1, -1, -1])
    sandwich = product(product(q, vector), conjugate) / q.square().sum()
    torch.testing.assert_close(rotation(q[None])[0] @ vector[1:], sandwich[1:], rtol=1e-12, atol=1e-12)
    rate = quaternion_rate(q[None], vector[None, 1:])[0]
    torch.testing.assert_close(rate, product(q, vector) / 2, rtol=1e-12, atol=1e-12)


def test_a_steady_turn_ends_where_scipy_says():
    rates = random_states(8)[:, :3]
    start = random_states(8, seed=1)[:, ATTITUDE]
    attitude, h = start, 0.001
    for _ in range(1000):
        middle = attitude + h / 2 * quaternion_rate(attitude, rates)
        attitude = attitude + h * quaternion_rate(middle, rates)
    # Rates are about the body's axes, so the turn comes first.
    expected = Rotation.from_quat(start.numpy(), scalar_first=True) * Rotation.from_rotvec(rates.numpy())
    np.testing.assert_allclose(rotation(attitude), expected.as_matrix(), atol=1e-5)
    torch.testing.assert_close(attitude.norm(dim=1), start.norm(dim=1), rtol=1e-6, atol=0)


def test_quaternions_whose_sign_jumps_are_made_continuous():
    angle = np.linspace(0, 1, 6)
    turning_by = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle])
    jumping = turning_by * np.array([1, 1, -1, -1, 1, 1])[:, None]
    np.testing.assert_allclose(continuous_quaternion(torch.from_numpy(jumping)), turning_by)

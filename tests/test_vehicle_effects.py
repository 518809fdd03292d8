import math

import pytest
import torch

from visadapt.effects import ConstantForce, LinearDrag, PeriodicForce
from visadapt.systems import Quadrotor
from visadapt.world import World


def flying(batch=3, seed=0):
    """States (batch, 13) of a vehicle under way, in float64."""
    generator = torch.Generator().manual_seed(seed)
    state = 0.3 * torch.randn(batch, 13, generator=generator, dtype=torch.float64)
    state[:, 3] += 5.0
    state[:, 6] += 1.0
    return state


def acceleration(world, state, command, time=0.0):
    """What a vehicle's velocity and rates (B, 6) change by in a second, under commands (B, 4)."""
    at = world.start(state)
    system = world.altered(state)
    load = world.load(type(at)(torch.full_like(at.time, time), at.state))
    change = system.derivative(state, command, load)
    return torch.cat((change[:, 3:6], change[:, 10:]), 1)


def pull(effects, system, state, time=0.0):
    """What effects add to `acceleration` (B, 6) at hover or cruise commands."""
    command = torch.zeros(len(state), 4, dtype=state.dtype)
    with_them, without = World(system, effects), World(system)
    return acceleration(with_them, state, command, time) - acceleration(without, state, command, time)


@pytest.mark.parametrize("vehicle", [Quadrotor(), Quadrotor(mass=2.0)], ids=lambda v: f"{v.name}{v.mass}")
class TestForcesOnBoth:
    def test_linear_drag_is_the_papers_with_coefficient_r_times_mass(self, vehicle):
        state = flying()
        added = pull([LinearDrag(coefficient=0.3 * vehicle.mass)], vehicle, state)
        torch.testing.assert_close(added[:, :3], -0.3 * state[:, 3:6], rtol=1e-6, atol=1e-7)
        assert added[:, 3:].abs().max() < 1e-12

    def test_two_cos_t_pushes_along_the_worlds_x(self, vehicle):
        force = PeriodicForce(amplitude=2.0, frequency=1 / (2 * math.pi), phase=0.0, offset=0.0)
        expected = torch.zeros(3, 6, dtype=torch.float64)
        for time in (0.0, 0.7, 3.0):
            expected[:, 0] = 2 * math.cos(time) / vehicle.mass
            torch.testing.assert_close(pull([force], vehicle, flying(), time), expected, rtol=1e-6, atol=1e-6)

    def test_a_constant_force_pushes_along_the_worlds_x(self, vehicle):
        added = pull([ConstantForce(force=1.5)], vehicle, flying())
        torch.testing.assert_close(added[:, 0], torch.full((3,), 1.5 / vehicle.mass, dtype=torch.float64))
        assert added[:, 1:].abs().max() < 1e-12

"""The power loop: as steady, closed and feasible as the benchmark says."""

import math

import pytest
import torch

from benchmarks.power_loop import LOOP_RADIUS, power_loop, smallest_loop
from tests.flying import fly_blind, states_on
from visadapt.systems import Quadrotor
from visadapt.systems.rigid_body import rotation
from visadapt.tasks.differential_flatness import demanded


@pytest.mark.parametrize("speed", [2.6, 5.0])
def test_what_a_power_loop_asks_for_flies_it_in_the_simulator(speed):
    assert fly_blind(power_loop(speed, period=0.02).as_many()).max() < 0.02


@pytest.mark.parametrize("speed", [2.6, 3.4, 4.1, 4.6, 5.0])
def test_a_power_loop_is_closed_steady_and_feasible(speed):
    loop = power_loop(speed, period=0.02)
    torch.testing.assert_close(loop.velocities.norm(dim=1), torch.full((len(loop.velocities),), speed))
    # Level in, level out, once around, at the height that it began with.
    for end in (loop.velocities[0], loop.velocities[-1]):
        assert end.tolist() == pytest.approx([speed, 0, 0], abs=1e-4)
    assert float(loop.positions[-1, 2]) == pytest.approx(0, abs=1e-4)
    assert (loop.positions[:, 1] == 0).all()
    inclination = torch.atan2(loop.velocities[:, 2], loop.velocities[:, 0])
    assert float((inclination.diff() + math.pi).remainder(2 * math.pi).sub(math.pi).sum()) == pytest.approx(
        2 * math.pi, abs=1e-3
    )
    # Most of the way is a circle of the radius.
    curved = loop.accelerations.norm(dim=1) / speed**2 * LOOP_RADIUS
    assert ((curved - 1).abs() < 1e-4).float().sum() * 0.02 > 5 * LOOP_RADIUS / speed
    assert 0 <= float(loop.positions[:, 2].max()) - 2 * LOOP_RADIUS < 0.2
    # Upright all along, within nine tenths of the commands.
    assert (rotation(states_on(loop)[:, 6:10])[:, 2, 2] > 0.5).all()
    assert smallest_loop(speed, Quadrotor()) < LOOP_RADIUS
    assert demanded(loop.accelerations, loop.jerks).rates.abs().max() < 0.45


def test_the_smallest_loop_is_where_the_top_turns_as_fast_as_allowed():
    # On a circle the thrust points along g z + a n, a = v^2 / R; at the top it turns by v / R a / (g - a).
    speed = 5.0
    radius = smallest_loop(speed, Quadrotor(), margin=1.0)
    a = speed**2 / radius
    # The command is a little ahead of the rate, and more.
    assert speed / radius * a / (9.81 - a) == pytest.approx(0.5, rel=1e-2)
    assert radius == pytest.approx(6.49, abs=0.01)
    # The rule for the radius of all loops.
    assert math.ceil(2 * smallest_loop(5.0, Quadrotor(), margin=0.9)) / 2 == LOOP_RADIUS
    # With faster rates, thrust decides: at least 2.21 is g - a at the top.
    assert smallest_loop(2.0, Quadrotor(max_rate=1e4), margin=1.0) == pytest.approx(4 / (9.81 - 2.21), rel=0.01)

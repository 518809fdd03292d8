import pytest
import torch

from tests.effects.test_effects import readings
from tests.worlds import run
from visadapt.effects import AttitudeOffset, PositioningDelay, RateOffset
from visadapt.systems import Quadrotor
from visadapt.systems.rigid_body import rotation
from visadapt.world import World

PERIOD = 0.1


def flight(rows=8):
    """Commands (rows, 2, 4) of two quadrotors, and their first states (2, 13), in float64."""
    generator = torch.Generator().manual_seed(0)
    state = torch.zeros(2, 13, dtype=torch.float64)
    state[:, 3:6] = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    state[:, 6] = 1.0
    state[:, 7:10] = 0.2 * torch.randn(2, 3, generator=generator, dtype=torch.float64)
    state[:, 10:] = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    return state, 0.3 * torch.randn(rows, 2, 4, generator=generator, dtype=torch.float64)


def read(effect, state):
    with torch.no_grad():
        return World(Quadrotor(), [effect.double()], PERIOD).reading(state)


def test_turned_axes_show_the_same_vectors_with_other_components():
    state, _ = flight()
    effect = AttitudeOffset(roll=0.1, pitch=-0.2, yaw=0.25)
    seen = read(effect, state)
    # The world's components of a body rate do not depend on the axes in which it is measured.
    rates = rotation(seen[:, 6:10]) @ seen[:, 10:, None]
    torch.testing.assert_close(rates, rotation(state[:, 6:10]) @ state[:, 10:, None])
    torch.testing.assert_close(seen[:, :6], state[:, :6])
    torch.testing.assert_close(seen[:, 6:10].norm(dim=1), state[:, 6:10].norm(dim=1))


@pytest.mark.parametrize(("angle", "column"), [("roll", 7), ("pitch", 8), ("yaw", 9)])
def test_a_level_vehicle_reads_the_angles_of_its_sensor(angle, column):
    level = torch.zeros(1, 13, dtype=torch.float64)
    level[:, 6] = 1.0
    seen = read(AttitudeOffset(**{"roll": 0.0, "pitch": 0.0, "yaw": 0.0, angle: 0.2}), level)
    expected = level.clone()
    expected[:, 6], expected[:, column] = torch.tensor([0.1]).cos().double(), torch.tensor([0.1]).sin().double()
    torch.testing.assert_close(seen, expected, atol=1e-7, rtol=0)


def test_gyroscopes_offsets_are_added_to_the_rates():
    state, _ = flight()
    seen = read(RateOffset(x=0.01, y=-0.02, z=0.03), state)
    added = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64).expand(2, 3)
    torch.testing.assert_close(seen - state, torch.cat((torch.zeros(2, 10, dtype=torch.float64), added), 1))


def test_late_positions_stand_beside_attitude_and_rates_of_now():
    state, actions = flight()
    world = World(Quadrotor(), [PositioningDelay(delay=PERIOD).double()], PERIOD)
    with torch.no_grad():
        true = run(World(Quadrotor(), (), PERIOD), state, actions)
        seen = readings(world, state, actions)
    torch.testing.assert_close(seen[1:, :, :6], true[:-1, :, :6])
    torch.testing.assert_close(seen[..., 6:], true[..., 6:])

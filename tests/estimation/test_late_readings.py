"""What a late sensor reads, from the state at present: against the motion itself, simulated in steps of 1 ms."""

import pytest
import torch

from visadapt.effects import AngleDelay, CoulombFriction, MeasurementDelay, PositionDelay
from visadapt.estimation.late_readings import Past, reading
from visadapt.estimation.linearise import linearise_reading
from visadapt.systems import CartPole
from visadapt.world import World

TICK = 0.001  # s, the step of the motion
PERIOD = 50  # ticks for which a command is held
LATE = {MeasurementDelay: [0, 1, 2, 3], PositionDelay: [0, 1], AngleDelay: [2, 3]}


def motion(effects=(), periods=8):
    """States (T + 1, 4) at every tick, and the command (n, 1) of every period."""
    generator = torch.Generator().manual_seed(3)
    commands = torch.rand(periods, 1, generator=generator, dtype=torch.float64) - 0.5
    at = torch.tensor([[0.1, 0.4, 0.1, -0.3]], dtype=torch.float64)
    world, rows = World(CartPole(), effects, period=TICK).double().requires_grad_(False), [at]
    for command in commands.repeat_interleave(PERIOD, 0):
        rows.append(world.integrate(torch.zeros(1).double(), rows[-1], command[None, None]))
    return torch.cat(rows), commands


def past_of(commands, index, count):
    """The `count` periods before the row `index`, of 50 ms each."""
    before = (index - 1 - torch.arange(count)).clamp_min(0)
    time = torch.tensor([index * PERIOD * TICK]).double()
    return Past(time, commands[before][None], torch.full((1, count), PERIOD * TICK).double())


@pytest.mark.parametrize("delay", [0.0, 0.007, 0.05, 0.086])
@pytest.mark.parametrize("sensor", LATE)
@pytest.mark.parametrize("friction", [[], [CoulombFriction(force=2.0)]])
def test_a_late_sensor_reads_the_motion_as_it_was_and_the_others_as_it_is(sensor, delay, friction):
    track, commands = motion(friction)
    world = World(CartPole(), [*friction, sensor(delay=delay)], 0.05, substeps=4).double().requires_grad_(False)
    for index in range(2, 8):
        seen = reading(world, track[None, PERIOD * index], past_of(commands, index, 3))[0]
        true = track[PERIOD * index].clone()
        true[LATE[sensor]] = track[PERIOD * index - round(delay / TICK), LATE[sensor]]
        torch.testing.assert_close(seen, true, rtol=0, atol=2e-3 if friction else 1e-5)


def test_before_the_episode_the_motion_is_that_under_its_first_command():
    track, commands = motion()
    world = World(CartPole(), [AngleDelay(delay=0.09)], 0.05).double().requires_grad_(False)
    seen = reading(world, track[None, PERIOD], past_of(commands, 1, 3))
    torch.testing.assert_close(seen[0, :2], track[PERIOD, :2])
    before, tick = track[:1], torch.full((1,), TICK).double()
    for _ in range(40):
        before = world.integrate(0 * tick, before, commands[None, 0], -tick)
    torch.testing.assert_close(seen[0, 2:], before[0, 2:], rtol=0, atol=1e-3)
    torch.testing.assert_close(reading(world, track[:1], None), track[:1], rtol=0, atol=0)


def test_the_derivative_by_the_delay_is_minus_the_rate_at_that_time():
    track, commands = motion()
    world = World(CartPole(), [AngleDelay(delay=0.0)], 0.05).double().requires_grad_(False)
    values = torch.tensor([0.02]).double()
    tangent = linearise_reading(world, values, track[None, PERIOD * 4], past_of(commands, 4, 2))
    then = track[PERIOD * 4 - 20]
    assert float(tangent.by_parameter[0, 2, 0]) == pytest.approx(-float(then[3]), rel=1e-3)
    torch.testing.assert_close(tangent.by_parameter[0, :2, 0], torch.zeros(2).double(), rtol=0, atol=1e-9)
    assert float(tangent.by_state[0, 2, 3]) == pytest.approx(-0.02, rel=0.1), "the angle 20 ms ago: theta - 0.02 rate"

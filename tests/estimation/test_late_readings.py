"""What late sensors read: against the motion itself, simulated in steps of 1 ms."""

from functools import cache

import pytest
import torch

from visadapt.effects import AngleDelay, CoulombFriction, MeasurementDelay, PositionDelay
from visadapt.estimation.candidate import CandidateModel, linearise
from visadapt.estimation.segments import cut
from visadapt.systems import CartPole
from visadapt.world import World

TICK = 0.001  # s, the step of the motion
STEADY = torch.full((40,), 50)  # ticks from each row to the next
UNSTEADY = torch.tensor(
    [50, 57, 50, 130, 52, 50, 20, 58, 50, 54, 50, 53, 50, 56, 50, 50, 140, 50, 55, 50, 51, 50, 59, 50]
)
LATE = {MeasurementDelay: [0, 1, 2, 3], PositionDelay: [0, 1], AngleDelay: [2, 3]}
FRICTION = 2.0  # N; the cart stops and starts again several times


@cache
def motion(ticks, *friction):
    """States (T, 4) at every tick under these kinds of friction, and its rows: all read without delay, commands held
    from each to the next."""
    generator = torch.Generator().manual_seed(3)
    commands = torch.rand(len(ticks), 1, generator=generator, dtype=torch.float64) - 0.5
    at = torch.tensor([[0.1, 0.4, 0.1, -0.3]], dtype=torch.float64)
    effects = [kind(force=FRICTION) for kind in friction]
    world, states = World(CartPole(), effects, period=TICK).double().requires_grad_(False), [at]
    for command in commands.repeat_interleave(ticks, 0):
        states.append(world.integrate(torch.zeros(1).double(), states[-1], command[None, None]))
    track, index = torch.cat(states), ticks.cumsum(0) - ticks
    stamps = TICK * index.double()
    period = float(stamps.diff().median())
    return track, cut([track[index]], [torch.ones(len(index), 4)], [commands], [stamps], (0, 1, 2, 3), period, 15)


def at(track, time):
    return track[(time / TICK).round().long().clamp(0, len(track) - 1)]


@pytest.mark.parametrize("delay", [0.0, 0.007, 0.05, 0.086])
@pytest.mark.parametrize("sensor", LATE)
@pytest.mark.parametrize("friction", [[], [CoulombFriction]])
@pytest.mark.parametrize("ticks", [STEADY, UNSTEADY], ids=["steady", "unsteady"])
def test_a_late_sensor_reads_the_motion_as_it_was_also_through_stops(ticks, friction, sensor, delay):
    track, rows = motion(ticks, *friction)
    if friction:
        assert int((track[1:, 1] == 0).sum()) > 5
    model = CandidateModel(CartPole(), [*friction, sensor], rows)
    theta = torch.tensor([FRICTION] * len(friction) + [delay]).double()
    seen, (times, there) = model.measure(theta, at(track, rows.time)), read_at(model, theta)
    for channel in range(4):
        shown = at(track, times[..., channel] - delay * (channel in LATE[sensor]))[..., channel]
        torch.testing.assert_close(seen[..., channel][there], shown[there], rtol=0, atol=2e-3)


@pytest.mark.parametrize("sensor", LATE)
@pytest.mark.parametrize("ticks", [STEADY, UNSTEADY], ids=["steady", "unsteady"])
def test_between_rows_a_late_sensor_reads_what_is_interpolated(ticks, sensor):
    """As the screening does, which tries many delays: each reading in its own row, or rows earlier."""
    track, rows = motion(ticks)
    model, delays = CandidateModel(CartPole(), [sensor], rows), torch.tensor([[0.0], [0.007], [0.086]]).double()
    for later in ([0] * 4, [1, 1, 2, 2]):
        seen = model.read_along(delays, at(track, rows.time), later)
        for channel, by in enumerate(later):
            read = rows.later(rows.time[..., None], [by])[..., 0]
            shown = read - delays[:, :, None] * (channel in LATE[sensor])
            first, last = (rows.time.where(rows.inside > 0, end).aminmax(dim=1)[k] for k, end in enumerate((9, -9)))
            there = (shown >= first[:, None]) & (shown <= last[:, None]) & (read > 0) & (rows.inside > 0)
            assert there.sum() > 40
            assert not seen[..., channel][there].isnan().any()
            error = (seen[..., channel] - at(track, shown)[..., channel])[there].abs()
            # Of up to 7 rad and 8 rad/s, in rows up to 0.14 s apart.
            mean, largest = (2e-3, 0.03) if channel in (0, 2) else (0.02, 0.3)
            assert error.mean() < mean
            assert error.max() < largest


def read_at(model, theta):
    """(W, T, 4) when the readings are read that show each row's state; which rows (W, T) have one of each sensor."""
    rows = model.rows
    times = rows.later(rows.time[..., None].expand(-1, -1, 4), model.rows_later(theta))
    return times, (model.shown(theta)[1] > 0).all(-1)


def test_every_reading_is_shown_once_but_for_those_of_before_the_episode():
    _, rows = motion(STEADY)
    model = CandidateModel(CartPole(), [PositionDelay], rows)
    measured, used = model.shown(torch.tensor([0.12]).double())
    assert used.sum((0, 1)).tolist() == [37, 37, 40, 40], "0.12 s are in the third row"
    torch.testing.assert_close(measured[..., 0][used[..., 0] > 0], rows.measured[..., 0][rows.inside > 0][3:])
    torch.testing.assert_close(measured[..., 2], rows.measured[..., 2])


@pytest.mark.parametrize("delay", [0.0, 0.02, 0.05])
def test_derivatives_are_those_of_the_motion(delay):
    track, rows = motion(STEADY, CoulombFriction)
    model = CandidateModel(CartPole(), [CoulombFriction, AngleDelay], rows)
    theta, state = torch.tensor([FRICTION, delay]).double(), at(track, rows.time)
    found = linearise(model, theta, state)
    (times, there), step = read_at(model, theta), 1e-3
    rate = at(track, times[..., 2] - delay)[..., 3]
    torch.testing.assert_close(found.sensing_by_parameter[..., 2, 1][there], -rate[there], rtol=0, atol=0.05)
    assert not found.sensing_by_parameter[..., :2, 1].any(), "the position is not late"
    moved = theta + torch.tensor([step, 0.0]).double()
    by_force = (model.measure(moved, state) - found.measured) / step
    torch.testing.assert_close(found.sensing_by_parameter[..., 0], by_force, rtol=0, atol=1e-3)
    pushed = model.measure(theta, state + torch.tensor([0.0, 0.0, 0.0, step]).double())
    torch.testing.assert_close(found.sensing[..., 3], (pushed - found.measured) / step, rtol=0, atol=5e-3)

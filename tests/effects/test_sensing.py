import math

import pytest
import torch

from tests.effects.test_effects import PERIOD, inputs, readings, world_of
from tests.worlds import Mass, columns, run
from visadapt.effects import (
    ActuatorDelay,
    AngleOffset,
    Dropout,
    FrozenZone,
    MeasurementDelay,
    PositionOffset,
    SensorScale,
    Spring,
)
from visadapt.systems import CartPole
from visadapt.world import World


def read(effect, rows, generator=None):
    """What is read of the rows (T, n_state) of one episode."""
    effect = effect.double().requires_grad_(False)
    rows = torch.tensor(rows, dtype=torch.float64)
    memory, seen = effect.memory(rows[:1], PERIOD), []
    for row in rows:
        out, memory = effect.apply_to(row[None], memory, PERIOD, generator)
        seen.append(out[0])
    return torch.stack(seen)


class TestMeasurementDelay:
    def test_a_delay_of_whole_rows_is_the_rows_before_and_the_first_until_then(self):
        state, actions = inputs(3)
        true = run(world_of(), state, actions)
        seen = readings(world_of(MeasurementDelay(delay=2 * PERIOD).double()), state, actions)
        torch.testing.assert_close(seen[2:], true[:-2], rtol=0, atol=1e-6)
        torch.testing.assert_close(seen[:2], true[:1].expand(2, -1, -1), rtol=0, atol=1e-6)

    @pytest.mark.parametrize("delay", [0.0, 0.004, 0.013, 0.049, 0.077])
    def test_any_delay_is_the_motion_that_long_ago(self, delay):
        state, actions = inputs(3)
        fine = World(CartPole(), period=0.001)
        track = run(fine, state, actions.repeat_interleave(50, 0))
        world = World(CartPole(), [MeasurementDelay(delay=delay).double()], PERIOD, "rk4", 50)
        seen = readings(world, state, actions)
        for k in range(len(actions) + 1):
            then = track[max(round(50 * k - 1000 * delay), 0)]
            torch.testing.assert_close(seen[k], then, rtol=0, atol=2e-3)
            torch.testing.assert_close(seen[k][:, ::2], then[:, ::2], rtol=0, atol=2e-5)

    @pytest.mark.parametrize("delay", [0.02, 0.05, 0.13])
    def test_from_rest_it_cannot_be_told_from_a_delay_of_the_actuator(self, delay):
        _, actions = inputs(3)
        rest = torch.zeros(3, 4, dtype=torch.float64)
        sensor, actuator = (
            readings(World(CartPole(), [effect(delay=delay).double()], PERIOD, "rk4", 5), rest, actions)
            for effect in (MeasurementDelay, ActuatorDelay)
        )
        assert actuator.abs().max() > 0.1
        torch.testing.assert_close(sensor, actuator, rtol=0, atol=2e-3)
        torch.testing.assert_close(sensor[..., ::2], actuator[..., ::2], rtol=0, atol=2e-5)

    @pytest.mark.parametrize("delay", [-0.01, math.nan])
    def test_a_negative_delay_is_an_error(self, delay):
        with pytest.raises(ValueError, match="measurement_delay: delay must not be negative, got"):
            world_of(MeasurementDelay(delay=delay)).start(columns(0, 0, 0, 0))


class TestFrozenZone:
    def test_angle_and_its_velocity_hold_their_last_values_from_outside(self):
        angles = [0.2, 0.08, 0.02, -0.04, -0.12, -0.03, 0.04, 0.3]
        rows = [[0.1 * k, 1.0, angle, k] for k, angle in enumerate(angles)]
        seen = read(FrozenZone(start=-0.05, end=0.1), rows)
        kept = [0, 0, 0, 0, 4, 4, 4, 7]
        assert seen[:, 2].tolist() == pytest.approx([angles[k] for k in kept], abs=1e-4)
        assert seen[:, 3].tolist() == pytest.approx(kept, abs=1e-3)
        assert seen[:, :2].tolist() == [row[:2] for row in rows]

    def test_an_episode_that_begins_inside_reads_its_first_angle_until_it_is_out(self):
        seen = read(FrozenZone(start=-0.1, end=0.1), [[0, 0, 0.02, 0.5], [0, 0, 0.05, 0.6], [0, 0, 0.2, 0.7]])
        assert seen[:, 2].tolist() == pytest.approx([0.02, 0.02, 0.2], abs=1e-6)

    def test_it_sees_the_true_angle_whatever_else_the_sensor_does(self):
        state = columns(0.0, 0.0, 0.0, 0.0).repeat(2, 1)
        state[1, 2] = 0.3
        world = world_of(AngleOffset(offset=0.3).double(), FrozenZone(start=-0.1, end=0.1).double()).requires_grad_(
            False
        )
        at = world.step(world.measure(world.start(state))[1], torch.full((2, 1), 0.5, dtype=torch.float64))
        seen, _ = world.measure(at)
        assert float(seen[0, 2]) == pytest.approx(0.3, abs=1e-6), "frozen at 0, and 0.3 more"
        assert float(seen[1, 2]) == pytest.approx(float(at.state[1, 2]) + 0.3, abs=1e-6)


def test_scales_and_offsets_of_a_sensor_are_a_straight_line():
    row = [[0.4, -1.0, 0.2, 3.0]]
    assert read(SensorScale(position=2.0, angle=0.5), row)[0].tolist() == pytest.approx([0.8, -2.0, 0.1, 1.5])
    assert read(AngleOffset(offset=0.05), row)[0].tolist() == pytest.approx([0.4, -1.0, 0.25, 3.0])
    assert read(PositionOffset(offset=-0.1), row)[0].tolist() == pytest.approx([0.3, -1.0, 0.2, 3.0])
    world = world_of(AngleOffset(offset=0.1).double(), SensorScale(position=1.0, angle=2.0).double()).requires_grad_(
        False
    )
    assert float(world.measure(world.start(columns(0, 0, 0.2, 0)))[0][0, 2]) == pytest.approx(0.5)


def test_a_position_offset_shows_only_against_a_place_that_is_known():
    state, actions = inputs(3)
    offset = PositionOffset(offset=0.2).double()
    shifted = state + columns(0.2, 0, 0, 0)
    torch.testing.assert_close(readings(world_of(offset), state, actions), run(world_of(), shifted, actions))
    spring = Spring(stiffness=20.0, rest=0.0).double()
    tied = readings(world_of(offset, spring), state, actions) - run(world_of(spring), shifted, actions)
    assert tied.abs().max() > 0.05


class TestDropout:
    def test_lost_rows_repeat_the_row_measured_last(self):
        rows = [[k, 10 * k, 100 * k, 1000 * k] for k in range(2000)]
        seen = read(Dropout(rate=0.3), rows, torch.Generator().manual_seed(0))
        lost = seen[:, 0] != torch.arange(2000)
        assert 0.25 < float(lost.double().mean()) < 0.35
        assert torch.equal(seen[1:][lost[1:]], seen[:-1][lost[1:]])
        assert torch.equal(seen[~lost], torch.tensor(rows, dtype=torch.float64)[~lost])

    def test_the_first_row_of_an_episode_is_never_lost(self):
        world = world_of(Dropout(rate=1.0), AngleOffset(offset=0.25))
        seen, at = world.measure(world.start(columns(0.1, 0.2, 0.0, 0.4)), torch.Generator())
        assert seen[0].tolist() == pytest.approx([0.1, 0.2, 0.25, 0.4])
        again, _ = world.measure(world.step(at, columns(0.5)), torch.Generator())
        assert torch.equal(again, seen)

    def test_the_generator_decides_alone(self):
        rows = [[k, 0, 0, 0] for k in range(50)]
        one, same, other = (read(Dropout(rate=0.5), rows, torch.Generator().manual_seed(s)) for s in (0, 0, 1))
        assert torch.equal(one, same)
        assert not torch.equal(one, other)

    def test_each_row_of_a_batch_loses_its_own_at_its_own_rate(self):
        world = World(Mass(), [Dropout(rate=torch.tensor([0.0, 1.0]))], PERIOD).requires_grad_(False)
        generator = torch.Generator().manual_seed(0)
        _, at = world.measure(world.start(torch.zeros(2, 4)), generator)
        for _ in range(5):
            seen, at = world.measure(world.step(at, torch.ones(2, 1)), generator)
        assert float(seen[0, 0]) > 0
        assert float(seen[1, 0]) == 0

    def test_without_a_generator_it_says_what_is_missing(self):
        world = world_of(Dropout(rate=0.5))
        with pytest.raises(ValueError, match=r"dropout is random: it needs a torch\.Generator"):
            world.measure(world.start(columns(0, 0, 0, 0)))

"""Readings that a sensor repeats, told from those that an encoder's steps make equal."""

import math

import pytest
import torch

from visadapt.estimation.repeated_readings import find_repeats, zone

COUNTS = torch.tensor([1e-4, 2 * math.pi / 4096], dtype=torch.float64)  # m and rad
ANGLE = (2, 3)  # columns of the state


def moving(rows=600, period=0.05, noise=0.0):
    """Position and angle (T, 2) of a cart-pole that swings, seen through encoders."""
    time = period * torch.arange(rows).double()
    motion = torch.stack((0.3 * (2.1 * time).sin(), 0.1 * (5.3 * time).sin() + 0.02 * (11.0 * time).sin()), 1)
    motion = motion + noise * torch.randn(motion.shape, generator=torch.Generator().manual_seed(0)).double()
    return (motion / COUNTS).round() * COUNTS


def with_repeats(values, repeated, columns):
    out = values.clone()
    for row in repeated.nonzero()[:, 0].tolist():
        out[row, columns] = out[row - 1, columns]
    return out


@pytest.mark.parametrize("period", [0.02, 0.05])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_turning_points_of_an_encoder_are_measurements(period, noise):
    values = moving(period=period, noise=noise)
    assert bool((values.diff(dim=0)[:, 1] == 0).any())  # equal readings, which the steps explain
    found = find_repeats([values], (0, 2), ANGLE)
    assert not bool(found.lost[0].any() | found.frozen[0].any())
    assert bool((found.used[0] == 1).all())


def test_a_machine_at_rest_that_then_starts_has_lost_no_rows():
    values = torch.cat((moving()[:1].expand(40, -1), moving()[5:]))
    assert not bool(find_repeats([values], (0, 2), ANGLE).lost[0].any())


@pytest.mark.parametrize("rate", [0.1, 0.45])
@pytest.mark.parametrize("swing", [1.0, 0.1])
def test_lost_rows_of_an_encoder_are_found(rate, swing):
    """Also where the pole moves by few steps of its encoder from row to row, and the cart by many."""
    values = moving()
    values[:, 1] = (swing * values[:, 1] / COUNTS[1]).round() * COUNTS[1]
    lost = torch.rand(len(values), generator=torch.Generator().manual_seed(1)) < rate
    lost[0] = lost[-1] = False
    found = find_repeats([with_repeats(values, lost, [0, 1])], (0, 2), ANGLE).lost[0]
    assert int((found & ~lost).sum()) <= 2
    assert int((lost & ~found).sum()) <= 0.05 * int(lost.sum())


def test_an_angle_that_stands_still_in_a_zone_of_an_encoder_is_found():
    values = moving()
    frozen = (values[:, 1] > 0.02) & (values[:, 1] < 0.05)
    frozen[0] = False
    found = find_repeats([with_repeats(values, frozen, [1])], (0, 2), ANGLE).frozen[0]
    assert int((found & ~frozen).sum()) <= 2
    assert int((frozen & ~found).sum()) <= 0.1 * int(frozen.sum())


def beside_a_slow_position(values, repeated):
    """What is found where these rows of the angle repeat the one before, and the position is read in every third row
    and, with the angle, where that is not repeated."""
    usable = torch.ones_like(values)
    usable[:, 0] = torch.arange(len(values)) % 3 == 0
    return find_repeats([with_repeats(values, repeated, [1])], (0, 2), ANGLE, [usable])


def test_a_zone_is_found_beside_a_slow_position():
    values = moving()
    frozen = (values[:, 1] > 0.02) & (values[:, 1] < 0.05)
    frozen[0] = False
    found = beside_a_slow_position(values, frozen)
    assert not bool(found.lost[0].any())
    assert int((frozen & ~found.frozen[0]).sum()) <= 0.1 * int(frozen.sum())


def test_lost_rows_are_found_beside_a_slow_position():
    values = moving()
    lost = torch.rand(len(values), generator=torch.Generator().manual_seed(1)) < 0.15
    lost[::3] = False  # no new position is read in a row that is lost
    found = beside_a_slow_position(values, lost)
    assert not bool(found.frozen[0].any())
    assert int((lost & ~found.lost[0]).sum()) <= 0.1 * int(lost.sum())


@pytest.mark.parametrize("rate", [0.1, 0.3])
def test_an_angle_that_is_missed_now_and_then_stands_still_in_no_zone(rate):
    values = moving()
    missed = torch.rand(len(values), generator=torch.Generator().manual_seed(1)) < rate
    missed[0] = False
    found = find_repeats([with_repeats(values, missed, [1])], (0, 2), ANGLE)
    assert not bool(found.frozen[0].any() | found.lost[0].any())
    left_out = found.used[0][:, 1] == 0
    assert int((missed & ~left_out).sum()) <= 0.15 * int(missed.sum())
    assert bool((found.used[0][:, 0] == 1).all())


def test_a_slow_motion_through_that_zone_is_not_measured_there():
    fast, slow = moving(), moving()
    slow[:, 1] = ((0.035 + 0.02 * (0.2 * torch.arange(len(slow)) * 0.05).sin()) / COUNTS[1]).round() * COUNTS[1]
    held = [(each[:, 1] > 0.02) & (each[:, 1] < 0.05) for each in (fast, slow)]
    for each in held:
        each[0] = False
    episodes = [with_repeats(values, frozen, [1]) for values, frozen in zip((fast, slow), held, strict=True)]
    repeats = find_repeats(episodes, (0, 2), ANGLE)
    assert not bool(repeats.used[1][held[1], 1].any())
    assert bool(repeats.silent[1][held[1]].any())  # nor do they say where the sensor stands still


@pytest.mark.parametrize("turns", [0, -1])
def test_a_zone_may_hold_the_hanging_pole(turns):
    angle = 2 * math.pi * turns + torch.linspace(2.5, 3.8, 400, dtype=torch.float64)
    first, last = 2 * math.pi * turns + 3.0, 2 * math.pi * turns + 3.4
    edges, deviations = zone((angle > first) & (angle < last), angle, 1e-3)
    assert edges.tolist() == pytest.approx([first, last], abs=0.005)
    assert (deviations < 0.005).all()


def test_a_machine_that_starts_slowly_from_a_few_rows_at_rest_has_lost_none():
    position = torch.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 4.0, 7.0]).double() * COUNTS[0]
    # A filter's velocity moves in far finer steps, so it leaves its rest at speed.
    velocity = torch.tensor([0.0, 0.0, 0.0, 1.9e-3, 3.8e-3, 7.1e-3, 1.1e-2]).double()
    rows = torch.stack((position, velocity), 1)
    rows = torch.cat((rows, rows[-1] + torch.stack((0.01 * torch.arange(1, 90), 0.3 + 1e-3 * torch.arange(1, 90)), 1)))
    assert not bool(find_repeats([rows], (0, 1), ANGLE).lost[0].any())

"""The instants at which a controller sent its commands, from rows of a clock that is not its own."""

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from visadapt.recordings.command_clock import in_gaps, instants, means_until_next, sent_by_clock

ROW = 0.01
TIME = ROW * np.arange(1000.0)


def logged(sent, commands, time=TIME):
    """(T, 2) what rows at these times show: the last command that was sent."""
    return commands[np.searchsorted(sent, time, side="right") - 1]


def steady(period, offset, lost=(), seed=0):
    """Times and pairs of commands of a controller from before 0 to 12 s; some are `lost`, as where two are equal."""
    sent = np.arange(-1, 12 / period) * period + offset * period
    commands = np.random.default_rng(seed).uniform(-1, 1, (len(sent), 2))
    for k in lost:
        commands[k] = commands[k - 1]
    return sent, commands


@settings(max_examples=50, deadline=None)
@given(st.integers(120, 690).map(lambda k: k / 97.3), st.floats(0, 1), st.lists(st.integers(2, 140), max_size=5))
def test_a_steady_clock_is_found(rows, offset, lost):
    assume(abs(rows / round(rows) - 1) > 0.06)  # else it may be the rows' clock
    sent, commands = steady(rows * ROW, offset, lost if rows > 2 else ())
    shown = logged(sent, commands)
    found = instants(TIME, shown)
    assert found is not None
    changes = np.diff(found)
    np.testing.assert_allclose(changes / (rows * ROW), np.round(changes / (rows * ROW)), rtol=0.002)
    means = sent_by_clock(TIME, shown)
    true = np.column_stack([means_until_next(TIME, sent, each) for each in commands.T])
    errors = [np.sqrt(np.mean((each - true)[3:-8] ** 2)) for each in (means, shown)]
    assert errors[0] < 0.3 * errors[1]


def test_rows_that_were_lost_and_stamps_that_are_rounded_hide_no_clock():
    time = np.round(np.delete(np.arange(1000) / 120, [200, 201, 202, 203, 204, 600]), 3)
    sent, commands = steady(0.02, 0.3)
    found = instants(time, logged(sent, commands, time))
    assert found is not None
    np.testing.assert_allclose((found - sent[1]) / 0.02, np.round((found - sent[1]) / 0.02), atol=0.15)


@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize("unsteady", [0.0, 0.3])
def test_a_controller_in_the_loop_of_the_rows_has_no_clock_of_its_own(every, unsteady):
    generator = np.random.default_rng(0)
    time = np.cumsum(ROW * (1 + unsteady * generator.uniform(0, 1, 1000)))
    commands = generator.uniform(-1, 1, (len(time[::every]), 2))
    assert instants(time, logged(time[::every], commands, time)) is None


def test_commands_that_change_at_random_have_no_clock():
    sent = np.concatenate(([-1.0], np.sort(np.random.default_rng(0).uniform(0, 10, 400))))
    assert instants(TIME, logged(sent, np.random.default_rng(1).uniform(-1, 1, (len(sent), 2)))) is None


def test_rows_in_gaps_of_a_steady_controller_are_told():
    sent = np.delete(np.arange(0, 10, 0.02), slice(100, 150))
    gap = in_gaps(TIME, sent)
    np.testing.assert_array_equal(gap, (TIME >= 2.0 - 1e-9) & (TIME < 3.0 - 1e-9))
    assert not in_gaps(TIME, np.sort(np.random.default_rng(0).uniform(0, 10, 100))).any()  # sent when it changes
    assert not in_gaps(TIME, np.array([0.0, 5.0])).any()

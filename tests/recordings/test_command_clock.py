"""Commands of a controller whose clock is not that of the rows: each acts when it was sent, not when a row shows it."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from visadapt.recordings.clock import RawEpisode
from visadapt.recordings.command_clock import means_until_next, with_controllers_clock

ROW = 0.01


def logged(sent, commands, time):
    """Rows at these times, each with the last command that was sent."""
    held = commands[np.searchsorted(sent, time, side="right") - 1]
    return RawEpisode(Path("run.csv"), time, held[:, None], np.zeros((len(time), 0)), ())


def steady(period, offset, lost=(), seed=0):
    """Times and commands of a controller from before 0 to 12 s; some are `lost`, as where two are equal."""
    sent = np.arange(-1, 12 / period) * period + offset * period
    commands = np.random.default_rng(seed).uniform(-1, 1, len(sent))
    for k in lost:
        commands[k] = commands[k - 1]
    return sent, commands


def read(raw):
    notes = []
    return with_controllers_clock(raw, lambda text, where: notes.append(text)), notes


@settings(max_examples=50, deadline=None)
@given(st.integers(120, 690).map(lambda k: k / 97.3), st.floats(0, 1), st.lists(st.integers(2, 140), max_size=5))
def test_commands_act_from_when_they_were_sent(rows, offset, lost):
    sent, commands = steady(rows * ROW, offset, lost if rows > 2 else ())
    time = ROW * np.arange(1000)
    found, notes = read(logged(sent, commands, time))
    if abs(rows / round(rows) - 1) < 0.06:  # it may be the rows' clock
        return
    assert float(notes[0].split()[3]) == pytest.approx(rows * ROW, rel=0.01)
    true = means_until_next(time, sent, commands)
    error = np.abs(found.action[:, 0] - true)[3:-8]
    as_logged = np.abs(logged(sent, commands, time).action[:, 0] - true)[3:-8]
    assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean(as_logged**2))
    assert found.stamped_commands


@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize("unsteady", [0.0, 0.3])
def test_a_controller_in_the_loop_of_the_rows_is_left_as_it_is(every, unsteady):
    generator = np.random.default_rng(0)
    time = np.cumsum(ROW * (1 + unsteady * generator.uniform(0, 1, 1000)))
    raw = logged(time[::every], generator.uniform(-1, 1, len(time[::every])), time)
    found, notes = read(raw)
    assert not notes
    assert found is raw


def test_commands_that_change_at_random_are_left_as_they_are():
    sent = np.concatenate(([-1.0], np.sort(np.random.default_rng(0).uniform(0, 10, 400))))
    raw = logged(sent, np.random.default_rng(1).uniform(-1, 1, len(sent)), ROW * np.arange(1000))
    assert read(raw)[0] is raw

"""Readings that only the library's own interface lets through end a candidate of the search, not the diagnosis."""

import numpy as np
import pytest

from tests.recorded import STATES, a_run
from visadapt.diagnosis import diagnose
from visadapt.diagnosis.search.fitted_models import NoFitError
from visadapt.effects import EFFECTS
from visadapt.recordings import Episode, Recording, RecordingError
from visadapt.systems import CartPole
from visadapt.world import World

CATALOGUE = [EFFECTS[name] for name in ("constant_force", "cart_mass", "position_delay")]


def diagnosed(**columns):
    table = {**a_run(0.1, 1e-3, rows=60), **columns}
    states = np.column_stack([table[name] for name in STATES])
    episode = Episode(table["time"], table["command"][:, None], states)
    return diagnose(Recording((episode,), STATES, 0.05, ("run.csv",)), World(CartPole()), CATALOGUE)


def with_one(name, value):
    values = a_run(0.1, 1e-3, rows=60)[name].copy()
    values[30] = value
    return {name: values}


@pytest.mark.parametrize(("name", "value"), [("x", 1e18), ("theta", 1e18), ("x_dot", 1e5)])
def test_a_large_reading_is_not_explained(name, value):
    assert diagnosed(**with_one(name, value)).verdict in ("unexplained", "no_gap")


@pytest.mark.parametrize("name", ["x", "x_dot", "theta_dot"])
def test_a_reading_that_nothing_can_be_computed_of_is_one_line(name):
    with pytest.raises(
        NoFitError, match="the likelihood of a cartpole on this recording is not finite; check units"
    ) as caught:
        diagnosed(**with_one(name, 1e300))
    assert "\n" not in str(caught.value)


def test_states_of_no_noise_under_no_command():
    time = 0.05 * np.arange(60)
    columns = {"x": 0.3 * np.sin(time), "theta": 0.1 * np.sin(3 * time), "command": 0 * time}
    rates = {"x_dot": 0.3 * np.cos(time), "theta_dot": 0.3 * np.cos(3 * time)}
    assert diagnosed(**columns, **rates).verdict == "unexplained"


def test_a_recording_made_in_python_is_checked_too():
    episode = Episode(0.05 * np.arange(50), np.zeros((50, 2)), np.zeros((50, 4)))
    with pytest.raises(RecordingError, match="episode 0 has 4 columns of states; one for each of x, theta, the"):
        Recording((episode,), ("x", "theta"), 0.05, ("run.csv",))
    with pytest.raises(RecordingError, match="a recording needs at least one episode"):
        Recording((), STATES, 0.05, ())
    with pytest.raises(RecordingError, match="the recording has 2 commands in a row; a cartpole has 1: command"):
        diagnose(Recording((episode,), STATES, 0.05, ("run.csv",)), World(CartPole()), CATALOGUE)

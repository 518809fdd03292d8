"""Readings of a stuck sensor are set aside; an episode is split where a position is suddenly elsewhere; what a machine
does by itself is left alone."""

import numpy as np
import pytest

import visadapt as va
from tests.own_systems import Pendulum
from tests.recorded import a_run, load, write

ROWS = 200


@pytest.fixture(scope="module")
def run():
    return a_run(0.1, 1e-3, rows=ROWS, period=0.02)


def with_x(run, x):
    return {**run, "x": x}


def moved(rows, amplitude=0.3):
    """A cart that moves back and forth, with the noise of its sensor."""
    time = 0.02 * np.arange(rows)
    return amplitude * np.sin(4 * time) + 3e-4 * np.random.default_rng(1).normal(size=rows)


def test_what_a_stuck_sensor_repeats_is_set_aside(file, run):
    x = moved(ROWS)
    true, x[61:75] = x.copy(), x[60]
    recording = load(write(file, with_x(run, x)), columns={"x_dot": ""})
    (episode,), (usable,) = recording.episodes, (read.all(1) for read in recording.usable)
    assert np.flatnonzero(~usable).tolist() == list(range(61, 75))
    np.testing.assert_allclose(episode.state[usable, 0], true[usable])
    np.testing.assert_allclose(np.diff(episode.state[60:76, 0]), (true[75] - true[60]) / 15)
    (said,) = (one for one in recording.warnings if "stuck" in one)
    assert said.startswith(f"{file}: row 62 (line 63), column 'x', and 13 rows after it: x repeats a reading")


def test_an_angle_that_sticks_is_set_aside_where_no_effect_does_that(file):
    time = 0.02 * np.arange(ROWS)
    angle = 3.0 + np.sin(4 * time)  # beyond half a turn, where an angle is read with the other sign
    angle[61:75] = angle[60]
    read = {"time": time, "angle": (angle + np.pi) % (2 * np.pi) - np.pi, "rate": 4 * np.cos(4 * time)}
    recording = va.load_recording(write(file, {**read, "torque": np.sin(3 * time)}), Pendulum())
    (usable,) = (read.all(1) for read in recording.usable)
    assert np.flatnonzero(~usable).tolist() == list(range(61, 75))
    assert any("its sensor stuck" in said for said in recording.warnings)


def test_an_angle_that_rests_where_it_begins_a_new_turn_does_not_stick(file):
    time, count = 0.02 * np.arange(2 * ROWS), 2 * np.pi / 1024
    angle = np.pi + np.round(0.5 * np.exp(-2 * time) * np.cos(8 * time) / count) * count
    read = {"time": time, "angle": (angle + np.pi) % (2 * np.pi) - np.pi, "torque": np.zeros(2 * ROWS)}
    assert not va.load_recording(write(file, read), Pendulum()).usable


def test_a_cart_that_dry_friction_holds_has_no_stuck_sensor(file, run):
    time = 0.02 * np.arange(ROWS)
    stays = np.clip(time - 1.2, 0, None)
    x = np.round(np.where(time < 0.9, 0.3 * np.sin(4 * time), 0.3 * np.sin(3.6)) - 0.4 * stays**2, 4)
    recording = load(write(file, with_x(run, x)), columns={"x_dot": ""})
    assert not recording.usable


@pytest.mark.parametrize(("name", "size"), [("x", 0.03), ("theta", -0.05)])
def test_an_episode_is_split_where_a_position_is_suddenly_elsewhere(file, run, name, size):
    column = np.array(run[name])
    column[120:] += size
    recording = load(write(file, {**run, name: column}))
    assert [len(episode.time) for episode in recording.episodes] == [120, ROWS - 120]
    assert recording.episodes[1].time[0] == pytest.approx(2.4)
    (said,) = (one for one in recording.warnings if "suddenly" in one)
    row, by = said.split(", by ")
    assert row.endswith(f"row 121 (line 122), column '{name}'")
    assert float(by.split()[0]) == pytest.approx(size, abs=0.003)


def test_what_an_estimator_corrects_all_the_time_is_left_in_one_piece(file):
    run = a_run(0.1, 1e-3, rows=3 * ROWS, period=0.02)
    x = run["x"] + 0.06 * (np.arange(3 * ROWS) // 40 % 2)
    recording = load(write(file, with_x(run, x)))
    assert len(recording.episodes) == 1
    (said,) = (one for one in recording.warnings if "estimator" in one)
    assert "positions jump in 14 rows" in said


def test_a_hit_is_no_jump_of_the_sensor(file, run):
    x = moved(ROWS, 0.02)
    x[100:] += 0.02 * 5.0 * np.arange(100)  # at 5 m/s from one row to the next
    assert len(load(write(file, with_x(run, x)), columns={"x_dot": ""}).episodes) == 1


@pytest.mark.parametrize("written", ["zeros", "the last readings"])
def test_what_is_written_while_no_sensor_answers_is_set_aside(file, run, written):
    columns = {name: np.array(run[name]) for name in ("x", "x_dot", "theta", "theta_dot")}
    for values in columns.values():
        values[80:120] = 0.0 if written == "zeros" else values[79]
    recording = load(write(file, {**run, **columns}))
    (usable,) = (read.all(1) for read in recording.usable)
    assert np.flatnonzero(~usable).tolist() == list(range(80, 120))
    (said,) = (one for one in recording.warnings if "no sensor answered" in one)
    assert said.startswith(f"{file}: row 81 (line 82), and 39 rows after it: every reading is repeated, then jumps")


@pytest.mark.parametrize("rate", [0.05, 0.3, 0.6])
def test_rows_that_are_lost_one_by_one_are_no_outage(file, run, rate):
    lost = np.random.default_rng(0).random(ROWS) < rate
    rows = np.maximum.accumulate(np.where(lost, 0, np.arange(ROWS)))
    kept = {name: np.array(values)[rows] for name, values in run.items() if name not in ("time", "command")}
    assert not load(write(file, {**run, **kept})).usable

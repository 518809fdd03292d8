"""Sensors slower than the rows: what a table repeats, or leaves empty, between two readings is not used as one."""

from pathlib import Path

import numpy as np
import pytest

from tests.recorded import a_run, load, refuses, write
from visadapt.diagnosis import diagnose
from visadapt.effects import Dropout, FrozenZone, PositionDelay, ViscousFriction
from visadapt.recordings.clock import RawEpisode
from visadapt.recordings.slow_sensors import without_held_readings
from visadapt.systems import CartPole
from visadapt.world import World

ROWS = 400
EVERY_4 = np.arange(ROWS) % 4 == 0
OF_60_HZ = np.diff(np.floor(0.6 * np.arange(ROWS + 1) + 0.5), prepend=-1)[:-1] > 0  # in rows of 100 Hz
POSITIONS_ALONE = {"x_dot": "", "theta_dot": ""}


@pytest.fixture(scope="module")
def run():
    return a_run(0.1, 1e-3, rows=ROWS, period=0.02)


def held(values, fresh):
    return np.asarray(values)[np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), 0))]


def with_empty(values, empty):
    return ["" if missing else str(value) for value, missing in zip(values, empty, strict=True)]


def usable(recording, name):
    (read,) = recording.usable
    return read[:, recording.measured.index(name)]


@pytest.mark.parametrize("fresh", [EVERY_4, OF_60_HZ], ids=["every 4th row", "60 Hz in rows of 100 Hz"])
@pytest.mark.parametrize("empty", [False, True], ids=["held", "empty cells"])
def test_only_readings_are_used_and_the_others_lie_between(file, run, fresh, empty):
    x = with_empty(run["x"], ~fresh) if empty else held(run["x"], fresh)
    recording = load(write(file, {**run, "x": x}), columns=POSITIONS_ALONE)
    np.testing.assert_array_equal(usable(recording, "x"), fresh)
    assert usable(recording, "theta").all()
    between = np.interp(run["time"], run["time"][fresh], run["x"][fresh])
    np.testing.assert_allclose(recording.episodes[0].state[:, 0], between)
    (said,) = (one for one in recording.warnings if "not measured" not in one)
    assert (f"cells are empty, of x in {(~fresh).sum()} of {ROWS} rows: not read there" in said) == empty


@pytest.mark.parametrize(
    ("every", "missed"), [(1.05, 0.0), (1.11, 0.0), (1.5, 0.0), (1.5, 0.1), (2.6, 0.1), (9.7, 0.0), (9.7, 0.1)]
)
def test_a_clock_of_its_own_and_readings_that_are_missed(file, run, every, missed):
    """Over three episodes, each too short to tell."""
    rng = np.random.default_rng(0)
    stamps = every * np.arange(int(ROWS / every))
    stamps = stamps[rng.uniform(size=len(stamps)) >= missed]
    fresh = np.isin(np.arange(ROWS), np.ceil(stamps))
    fresh[[0, 133, 266]] = True
    table = {"episode": np.minimum(np.arange(ROWS) // 133, 2), **run, "theta": held(run["theta"], fresh)}
    recording = load(write(file, table), columns=POSITIONS_ALONE)
    read = np.concatenate([each[:, 1] for each in recording.usable])
    assert (read != fresh).sum() <= 3  # at the ends of episodes


def test_two_logs_joined_row_by_row_keep_their_stamps(file, run):
    """Each row has one sensor; those of the second log come 2 ms later."""
    time = 0.02 * np.repeat(np.arange(ROWS // 2), 2) + 0.002 * (np.arange(ROWS) % 2)
    first = np.arange(ROWS) % 2 == 0
    table = {"time": time, "x": with_empty(run["x"], ~first), "theta": with_empty(run["theta"], first)}
    recording = load(write(file, {**table, "command": with_empty(run["command"], ~first)}), columns=POSITIONS_ALONE)
    np.testing.assert_allclose(recording.episodes[0].time, time, atol=1e-9)
    assert recording.period == pytest.approx(0.01)
    np.testing.assert_array_equal(usable(recording, "x"), first)


@pytest.mark.parametrize("share", [0.03, 0.1, 0.3, 0.7])
def test_rows_that_are_lost_at_random_are_no_slow_sensor(file, run, share):
    fresh = np.random.default_rng(0).uniform(size=ROWS) > share
    lost = {name: held(run[name], fresh) for name in ("x", "theta")}
    assert not load(write(file, {**run, **lost}), columns=POSITIONS_ALONE).usable


def test_a_few_readings_that_are_rounded_to_the_last_one_are_no_slow_sensor():
    values = np.random.default_rng(0).standard_normal(1200).cumsum()
    for row in (82, 766, 934, 1134):
        values[row] = values[row - 1]
    raw = RawEpisode(Path("run.csv"), np.linspace(0.0, 23.98, 1200), np.zeros((1200, 1)), values[:, None], ("theta",))
    said = []
    (found,) = without_held_readings([raw], CartPole(), lambda text, where: said.append(text))
    assert found.usable is None
    assert said == []


def test_a_position_that_grows_steadily_is_held_as_the_other_is(file, run):
    """As the fixes of an aircraft in steady flight, whose steps are all alike, as an encoder's."""
    x = 0.5 + 1e-3 * np.arange(ROWS)
    fixes = {"x": held(x, EVERY_4), "theta": held(run["theta"], EVERY_4)}
    recording = load(write(file, {**run, **fixes}), columns=POSITIONS_ALONE)
    np.testing.assert_array_equal(usable(recording, "x"), EVERY_4)
    np.testing.assert_array_equal(usable(recording, "theta"), EVERY_4)


def test_where_a_motion_turns_round_an_encoder_reads_the_same_twice(file, run):
    x = np.round(0.3 * np.sin(2 * np.pi * (np.arange(ROWS) + 0.5) / 40) / 1e-4) * 1e-4
    assert (np.diff(x) == 0).sum() > 15
    assert not load(write(file, {**run, "x": x}), columns=POSITIONS_ALONE).usable


def of_a_cart_that_rests(step):
    return np.round(0.3 * np.sin(3 * np.minimum(0.02 * np.arange(ROWS), 6)) / step) * step


def test_an_encoder_that_rests_is_read_there_too(file, run):
    x = of_a_cart_that_rests(1e-3)
    assert not load(write(file, {**run, "x": x}), columns=POSITIONS_ALONE).usable
    read = usable(load(write(file, {**run, "x": held(x, EVERY_4)}), columns=POSITIONS_ALONE), "x")
    assert read[320:].sum() == pytest.approx(20, abs=1)
    assert (read[:300] <= EVERY_4[:300]).all()


def test_rates_that_were_derived_from_what_is_held_are_left_out(file, run):
    x, theta = held(run["x"], EVERY_4), held(run["theta"], EVERY_4)
    derived = {"x": x, "x_dot": np.gradient(x, 0.02), "theta": theta, "theta_dot": np.diff(theta, prepend=0.1) / 0.02}
    recording = load(write(file, {**run, **derived}))
    assert recording.measured == ("x", "theta")
    assert sum("derived on the rig" in said for said in recording.warnings) == 2
    slow = {"x": x, "theta": theta}  # with rates from sensors of their own
    assert len(load(write(file, {**run, **slow})).measured) == 4


def test_commands_hold_until_the_next(file, run):
    given = np.arange(ROWS) % 5 == 3
    recording = load(write(file, {**run, "command": with_empty(run["command"], ~given)}))
    (episode,) = recording.episodes
    np.testing.assert_allclose(episode.action[:, 0], held(run["command"], given)[3:])
    assert any("rows before the first command are left out: 3" in said for said in recording.warnings)


def test_an_outlier_of_a_slow_sensor_is_set_aside(file, run):
    x = np.array(run["x"])
    x[80] = 9.0
    assert not usable(load(write(file, {**run, "x": held(x, EVERY_4)}), columns=POSITIONS_ALONE), "x")[80:84].any()


def test_a_slow_sensor_that_is_suddenly_elsewhere_splits_the_episode(file, run):
    x = np.array(run["x"]) + 0.3 * (np.arange(ROWS) >= 200)
    recording = load(write(file, {**run, "x": held(x, EVERY_4)}), columns=POSITIONS_ALONE)
    assert [len(episode.time) for episode in recording.episodes] == [200, 200]


def test_a_few_empty_cells_are_refused(file, run):
    empty = np.isin(np.arange(ROWS), [30, 40])
    table = {**run, "x": with_empty(run["x"], np.isin(np.arange(ROWS), [30, 40, 50]))}
    assert np.flatnonzero(~usable(load(write(file, table)), "x")).tolist() == [30, 40, 50]
    refuses(r"row 31 \(line 32\), column 'x' is empty or nan", write(file, {**run, "x": with_empty(run["x"], empty)}))


@pytest.mark.parametrize("slow", [("x",), ("theta",), ("x", "theta")])
def test_what_is_held_is_no_effect(file, run, slow):
    table = {**run, **{name: held(run[name], EVERY_4) for name in slow}}
    recording = load(write(file, table), columns=POSITIONS_ALONE)
    found = diagnose(recording, World(CartPole()), [Dropout, FrozenZone, PositionDelay, ViscousFriction])
    assert (found.verdict, found.causes) == ("no_gap", ())

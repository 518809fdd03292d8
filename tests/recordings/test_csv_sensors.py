"""Sensors that are dead, frozen or absurd are named; single outliers are set aside; clocks in other units are told."""

import numpy as np
import pytest

from tests.recorded import STATES, a_run, load, refuses, write


@pytest.fixture(scope="module")
def run():
    return a_run(0.1, 1e-3, rows=120)


def changed(table, **columns):
    """The table with some columns as functions of what they were."""
    return {name: columns.get(name, np.asarray)(np.array(values)) for name, values in table.items()}


def at(row, value):
    def put(values):
        values[row] = value
        return values

    return put


def still(values):
    return 0 * values


def frozen(values):
    values[60:] = values[60]
    return values


def short_step(time):
    time[60:] -= time[60] - time[59] - 1e-9
    return time


def in_bursts(time):
    return np.repeat(time[::4], 4) + np.tile(1e-5 * np.arange(4), len(time) // 4)


EVERY_STATE = dict.fromkeys(STATES, still)
SMALL = dict.fromkeys(STATES, lambda values: 1e-12 * values)


def noise(seed):
    return lambda values: 0.1 * np.random.default_rng(seed).normal(size=len(values))


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        (EVERY_STATE, "no state ever changes; a recording of something that moves is right"),
        (SMALL, "no state ever changes"),
        ({**EVERY_STATE, "command": still}, "no state ever changes"),
        (
            {"x": still, "x_dot": still},
            r"row 1 \(line 2\), column 'x' is 0, as in every row, .* is the sensor dead, or does the machine stick\?",
        ),
        ({"x": lambda x: 0 * x + 0.3}, "column 'x' is 0.3, as in the 119 rows after it"),
        ({"theta": lambda x: 0 * x + 0.01}, "column 'theta' is 0.01, as in every row"),
        ({"x": frozen}, r"row 61 \(line 62\), column 'x' is .*, as in the 59 rows after it, .*: the sensor was frozen"),
        ({"x": lambda x: x + 1e9}, r"row \d+ .*, column 'x' is 1e\+09 m; within about \[-1.5, 1.5\] is right"),
        ({"x": lambda x: x + 1e4}, "column 'x' is 10000"),
        ({"x_dot": lambda x: x + 1e9}, r"column 'x_dot' is 1e\+09 m/s"),
        ({"x": at(slice(50, 60), 1e5)}, r"row 51 \(line 52\), column 'x' is 100000 m"),
        ({"x": at(0, 1e300)}, r"row 1 \(line 2\), column 'x' is 1e\+300 m"),
        ({"theta_dot": at(119, -1e18)}, r"row 120 \(line 121\), column 'theta_dot' is -1e\+18 rad/s"),
        (
            {"x": lambda x: x + np.where(np.arange(len(x)) % 10 == 5, 1e5, 0)},
            "column 'x' is 1000.*, far off the rows before and after, and 10% of the column lie as far off",
        ),
    ],
)
def test_what_no_sensor_reads(file, run, columns, says):
    refuses(says, write(file, changed(run, **columns)))


@pytest.mark.parametrize("name", ["x_dot", "theta_dot"])
def test_a_rate_that_never_changes_is_left_out(file, run, name):
    recording = load(write(file, changed(run, **{name: still})))
    assert recording.measured == tuple(one for one in STATES if one != name)
    assert f"{name} never changes although its position does: a dead sensor; it was left out" in recording.warnings[0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("x", v) for v in (2, 1e5, 1e18, 1e300)),
        *(("theta", v) for v in (5, 1e300)),
        ("x_dot", 50),
        ("theta_dot", 1e300),
    ],
)
def test_an_outlier_is_set_aside(file, run, name, value):
    recording = load(write(file, changed(run, **{name: at(50, value)})))
    (episode,), (usable,) = recording.episodes, (read.all(1) for read in recording.usable)
    assert np.flatnonzero(~usable).tolist() == [50]
    said = f"{file}: row 51 (line 52), column '{name}': {value:g}: lies far off the rows before and after: an outlier"
    assert recording.warnings[0].startswith(said)
    true = np.column_stack([run[one] for one in STATES])
    np.testing.assert_allclose(episode.state[usable], true[usable])
    np.testing.assert_allclose(episode.state[50], (true[49] + true[51]) / 2)
    np.testing.assert_allclose(episode.action[:, 0], run["command"])


def test_some_outliers_in_a_row(file, run):
    recording = load(write(file, changed(run, x=at(slice(50, 53), 120))))
    assert [np.flatnonzero(~read.all(1)).tolist() for read in recording.usable] == [[50, 51, 52]]
    assert (
        "row 51 (line 52), column 'x': 120 and 2 more: lies far off the rows before and after" in recording.warnings[0]
    )


def test_rows_after_an_outlier_keep_their_places(file, run):
    table = changed(run, x=at(50, 1e5), theta=at(80, 1e5))
    warnings = load(write(file, table)).warnings
    assert "row 51 (line 52), column 'x': 100000" in warnings[0]
    refuses(r"row 91 \(line 92\), column 'command' is 7", write(file, changed(table, command=at(90, 7.0))))


def test_what_is_fast_but_possible_stays(file):
    """A motor that starts and stops within a row, and an angle that wraps to and fro: no outliers."""
    hanging = a_run(np.pi, 1e-3, rows=120)
    hanging["x_dot"] = hanging["x_dot"] + np.where(np.arange(120) == 60, 1.4, 0)
    recording = load(write(file, hanging))
    assert (len(recording.episodes), recording.warnings) == (1, ())


@pytest.mark.parametrize(
    ("clock", "says"),
    [
        (lambda t: 2e-5 * t, "rows are 1e-06 s apart; 0.0001 to 0.1667 s are right"),
        (lambda t: 2e-8 * t, "rows are 1e-09 s apart"),
        (lambda t: 1e300 * t, r"rows are 5e\+298 s apart"),
        (lambda t: 1e3 * t, "50 s apart; .* in milliseconds"),
        (lambda t: 1e6 * t, "in microseconds"),
        (lambda t: 1e9 * (t + 1.7e9), "in nanoseconds"),
        (lambda t: t / 60, "by it x, theta change 60 times as fast as their rates say: the clock is in minutes"),
        (lambda t: t / 3600, "rows are 1.389e-05 s apart; .* in minutes or hours"),
        (lambda t: t / 86400, "in hours or days"),
        (short_step, "only 1e-09 s after the row before"),
    ],
)
def test_clocks_that_are_not_in_seconds(file, run, clock, says):
    refuses(f"column 'time'.*{says}", write(file, changed(run, time=clock)))


def test_rows_that_are_stamped_as_they_arrive_in_bursts_are_evenly_spaced(file, run):
    recording = load(write(file, changed(run, time=in_bursts)))
    assert recording.period == pytest.approx(0.05, rel=1e-3)
    assert np.ptp(np.diff(recording.episodes[0].time)) < 1e-9
    assert "rows arrive in bursts and are stamped as they arrive" in recording.warnings[0]


def test_a_clock_in_minutes_where_no_rate_is_measured(file, run):
    table = {name: values for name, values in changed(run, time=lambda t: t / 60).items() if "_dot" not in name}
    refuses("at least 0.5 s, with a clock in seconds, is right", write(file, table))
    longer = {name: np.tile(values, 20) for name, values in table.items()}
    longer["time"] = np.arange(2400) * 0.05 / 60
    longer["x"] = np.sin(0.5 * longer["time"] * 60)
    refuses("column 'x' .* metres are right .*; or is the clock not in seconds", write(file, longer))


def test_a_position_of_noise_alone(file, run):
    (warning,) = load(write(file, changed(run, x=lambda x: 1e-5 * noise(1)(x)))).warnings
    assert "x jumps about from row to row and does not move" in warning


def test_a_sensor_that_is_dead_in_one_of_several_files_is_named_with_that_file(tmp_path):
    moves, dead = (a_run(0.05, 1e-3, seed=seed) for seed in (0, 1))
    other = write(tmp_path / "moves.csv", moves)
    refuses(
        r"dead\.csv: row 1 \(line 2\), column 'theta' is .* as in every row, .* is the sensor dead",
        other,
        write(tmp_path / "dead.csv", dead | {"theta": still(dead["theta"])}),
    )
    recording = load(other, write(tmp_path / "rate.csv", dead | {"x_dot": still(dead["x_dot"])}))
    assert recording.measured == ("x", "theta", "theta_dot")
    assert any("rate.csv: x_dot never changes although its position does" in text for text in recording.warnings)


def test_an_angle_that_stands_still_in_one_of_several_episodes_is_read(file):
    """As where the sensor has a zone in which it stands still."""
    moves, still_there = (a_run(0.05, 1e-3, seed=seed) for seed in (0, 1))
    still_there["theta"] = still(still_there["theta"])
    table = {name: np.concatenate((moves[name], still_there[name])) for name in moves}
    table["episode"] = np.repeat((0, 1), [len(moves["time"]), len(still_there["time"])])
    assert len(load(write(file, table)).episodes) == 2
    table["theta"] = still(table["theta"])
    refuses("column 'theta' is .*, as in every row", write(file, table))

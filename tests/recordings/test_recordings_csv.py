import time as stopwatch
from dataclasses import replace

import numpy as np
import pytest
import torch

from visadapt.recordings import Episode, RecordingError, load_recording, write_csv, write_recording
from visadapt.systems import CartPole
from visadapt.world import World

STATES = ("x", "x_dot", "theta", "theta_dot")
HEADER = ("time", *STATES, "command")


def a_table(rows=41, period=0.05, seed=0, noise=1e-3):
    """Columns by name; each rate is the derivative of its variable."""
    time = np.arange(rows) * period
    rng = np.random.default_rng(seed)
    table = {
        "time": time,
        "x": 0.3 * np.sin(2 * time),
        "x_dot": 0.6 * np.cos(2 * time),
        "theta": 0.1 * np.sin(5 * time + 1),
        "theta_dot": 0.5 * np.cos(5 * time + 1),
        "command": np.sin(7 * time),
    }
    for name in STATES:
        table[name] = table[name] + noise * rng.normal(size=rows)
    return table


def a_run(start, noise, rows=200, period=0.05, seed=0):
    """The cart-pole itself under a controller and excitation, from an angle `start`; wrapped, noisy."""
    rng = np.random.default_rng(seed)
    world = World(CartPole(), period=period, substeps=4).double()
    now = world.start(torch.tensor([[0.1, 0.0, start, 0.0]], dtype=torch.float64))
    log, push = [], 0.0
    gains = torch.tensor([0.05, 0.1, 1.5, 0.3], dtype=torch.float64)
    for row in range(rows):
        if row % 3 == 0:
            push = rng.uniform(-0.2, 0.2)
        balance = float(now.state[0] @ gains) if start < 1 else 0.0
        command = float(np.clip(balance + push, -1, 1))
        log.append([*now.state[0].tolist(), command])
        with torch.no_grad():
            now = world.step(now, torch.tensor([[command]], dtype=torch.float64))
    values = np.array(log)
    values[:, :4] += noise * rng.normal(size=(rows, 4)) * [0.5, 3, 1, 3]
    values[:, 2] = (values[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return {"time": np.arange(rows) * period, **dict(zip(HEADER[1:], values.T, strict=True))}


def write(path, table, separator=",", end="\n", before="", encoding="utf-8"):
    rows = zip(*(table[name] for name in table), strict=True)
    lines = [separator.join(table), *(separator.join(str(cell) for cell in row) for row in rows)]
    path.write_bytes((before + end.join(lines) + end).encode(encoding))
    return path


def load(*paths, columns=None, system=None):
    return load_recording(paths, system or CartPole(), columns)


def refuses(match, *paths, columns=None):
    with pytest.raises(RecordingError, match=match) as caught:
        load(*paths, columns=columns)
    assert "\n" not in str(caught.value)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "run.csv"


class TestColumns:
    def test_our_own_names(self, file):
        table = a_table()
        recording = load(write(file, table))
        assert recording.measured == STATES
        assert recording.period == pytest.approx(0.05)
        assert recording.samples == 40
        assert recording.warnings == ()
        episode = recording.episodes[0]
        np.testing.assert_array_equal(episode.state, np.column_stack([table[name] for name in STATES]))
        np.testing.assert_array_equal(episode.action[:, 0], table["command"])
        np.testing.assert_allclose(episode.time, table["time"], atol=1e-12)

    def test_any_order_and_case_and_columns_of_no_interest(self, file):
        table = a_table()
        shuffled = {"Note": ["ok"] * 41, **{name.upper(): table[name] for name in reversed(HEADER)}}
        np.testing.assert_array_equal(
            load(write(file, shuffled)).episodes[0].state, np.column_stack([table[name] for name in STATES])
        )

    @pytest.mark.parametrize(
        "names",
        [
            ("position", "positionD", "angle", "angleD", "Q"),
            ("cart_position", "cart_velocity", "pole_angle", "angular_velocity", "control"),
            ("s", "velocity", "ANGLE", "angled", "u"),
        ],
    )
    def test_well_known_names(self, file, names):
        table = a_table()
        foreign = dict(zip(("time", *names), table.values(), strict=True))
        assert load(write(file, foreign)).measured == STATES

    def test_our_own_name_comes_before_a_well_known_one(self, file):
        table = a_table()
        recording = load(write(file, table | {"position": np.zeros(41)}))
        np.testing.assert_array_equal(recording.episodes[0].state[:, 0], table["x"])

    def test_names_that_the_user_gives(self, file):
        table = a_table()
        foreign = {
            "when": table["time"],
            "a": table["x"],
            "b": table["theta"],
            "theta": table["x"],
            "c": table["command"],
        }
        recording = load(write(file, foreign), columns={"time": "when", "x": "a", "theta": "B", "command": "c"})
        assert recording.measured == ("x", "theta")
        np.testing.assert_array_equal(recording.episodes[0].state[:, 1], table["theta"])

    @pytest.mark.parametrize("missing", ["time", "x", "theta", "command"])
    def test_a_missing_column(self, file, missing):
        table = a_table()
        del table[missing]
        refuses(f"run.csv: column '{missing}' is missing; it has .*--columns {missing}=", write(file, table))

    def test_what_the_user_names_is_not_there(self, file):
        write(file, a_table())
        refuses("no column 'pos' for x; it has time, x", file, columns={"x": "pos"})
        refuses("cartpole has no 'speed'; it has episode, time, x", file, columns={"speed": "x_dot"})

    def test_two_columns_that_could_be_one(self, file):
        table = a_table()
        table["angle"] = table["pole_angle"] = table.pop("theta")
        refuses("'angle', 'pole_angle' could each be theta; say which: --columns theta=", write(file, table))

    def test_velocities_may_be_missing(self, file):
        table = a_table()
        del table["x_dot"], table["theta_dot"]
        recording = load(write(file, table))
        assert recording.measured == ("x", "theta")
        assert recording.episodes[0].state.shape == (41, 2)

    def test_a_force_in_newton(self, file):
        table = a_table()
        table["force"] = 30 * table.pop("command")
        recording = load(write(file, table))
        np.testing.assert_allclose(recording.episodes[0].action[:, 0], table["force"] / 30)
        assert "divided by max_force, 30 N" in recording.warnings[0]

    def test_a_force_that_never_exceeds_one_is_the_command(self, file):
        table = a_table()
        table["force"] = table.pop("command")
        assert load(write(file, table)).warnings == ()


class TestText:
    @pytest.mark.parametrize(
        "form",
        [
            {"separator": ";"},
            {"end": "\r\n"},
            {"encoding": "utf-8-sig"},
            {"before": "# a rig\n\n# 0.05 s\n"},
            {"separator": ";", "end": "\r\n", "encoding": "utf-8-sig", "before": "# a; b, c\r\n"},
        ],
    )
    def test_forms_of_the_same_table(self, file, form):
        table = a_table()
        state = load(write(file, table, **form)).episodes[0].state
        np.testing.assert_array_equal(state, np.column_stack([table[name] for name in STATES]))

    def test_comments_between_rows_and_quotes(self, file):
        lines = write(file, a_table()).read_text().splitlines()
        lines.insert(20, "# paused, resumed")
        file.write_text("\n".join(lines).replace("theta_dot", '"theta_dot"'))
        assert load(file).samples == 40

    @pytest.mark.parametrize(
        ("cell", "message"),
        [
            ("nan", "column 'theta' is nan; a finite number is right"),
            ("inf", "column 'theta' is inf"),
            ("", "column 'theta' is empty"),
            ("oops", "column 'theta' is 'oops'; a number is right"),
            ('"0,12"', "column 'theta' is '0,12'; a decimal point is right"),
        ],
    )
    def test_a_cell_that_is_no_number(self, file, cell, message):
        table = {name: list(values) for name, values in a_table().items()}
        table["theta"][6] = cell
        refuses(rf"run.csv: row 7 \(line 9\), {message}", write(file, table, before="# a comment\n"))

    def test_a_torn_last_line(self, file):
        content = write(file, a_table()).read_text()
        file.write_text(content[:-30])
        refuses(r"row 41 \(line 42\) is cut short: 5 of 6 cells; is the file torn", file)

    def test_a_row_that_is_too_long(self, file):
        lines = write(file, a_table()).read_text().splitlines()
        lines[5] += ",1"
        file.write_text("\n".join(lines))
        refuses(r"row 5 \(line 6\) has 7 cells, the line of names 6", file)

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"", "is empty"),
            (b"\n# only a comment\n", "is empty"),
            (b"time,x,theta,command\n", "has no rows"),
            (b"0.0,1,2,3\n0.1,1,2,3\n", "line 1 holds numbers where the columns' names belong"),
            (b"\xff\xfe\x00time", "not text in UTF-8"),
        ],
    )
    def test_no_table_at_all(self, file, content, message):
        file.write_bytes(content)
        refuses(message, file)


class TestClock:
    @pytest.mark.parametrize(("later", "problem"), [(0.2, "repeats itself"), (0.1, "runs backward")])
    def test_a_clock_that_does_not_run_forward(self, file, later, problem):
        table = a_table()
        table["time"][5] = later
        refuses(rf"row 6 \(line 7\), column 'time': the clock {problem}", write(file, table))

    def test_a_clock_that_jitters_a_little_is_a_steady_one(self, file):
        table = a_table(rows=200, period=0.0203)
        table["time"] = 1234.5 + table["time"] + np.random.default_rng(0).normal(0, 0.0003, 200)
        recording = load(write(file, table))
        assert recording.period == pytest.approx(0.0203, rel=1e-3)
        assert recording.warnings == ()
        assert recording.episodes[0].time[0] == 0
        np.testing.assert_allclose(np.diff(recording.episodes[0].time), recording.period)

    def test_a_missing_row_splits_the_episode(self, file):
        table = {name: np.delete(values, 30) for name, values in a_table(rows=81).items()}
        recording = load(write(file, table))
        assert [episode.samples for episode in recording.episodes] == [29, 49]
        assert recording.episodes[1].time[0] == pytest.approx(31 * 0.05)
        assert recording.warnings == (f"{file}, row 31 (line 32): rows are missing here; the episode was split",)

    def test_an_irregular_clock_is_resampled(self, file):
        rng = np.random.default_rng(0)
        time = np.cumsum(rng.uniform(0.02, 0.08, 400))
        table = {
            "time": time,
            "x": 0.3 * np.sin(2 * time),
            "theta": 0.1 * np.sin(3 * time),
            "command": np.where(time % 2 < 1, 0.5, -0.5),
        }
        recording = load(write(file, table))
        assert "irregular clock; resampled to one row every" in " ".join(recording.warnings)
        for episode in recording.episodes:
            moments = episode.time + time[0]
            np.testing.assert_allclose(episode.state[:, 1], 0.1 * np.sin(3 * moments), atol=1e-3)
            assert set(np.unique(episode.action)) == {-0.5, 0.5}

    def test_milliseconds(self, file):
        table = a_table()
        table["time"] = table["time"] * 1000
        refuses("column 'time': rows are 50 s apart.*milliseconds", write(file, table))

    def test_an_episode_of_another_period_is_left_out(self, tmp_path):
        for number, period in enumerate((0.05, 0.02, 0.05)):
            write(tmp_path / f"{number}.csv", a_table(period=period))
        recording = load(tmp_path)
        assert [source[-5:] for source in recording.sources] == ["0.csv", "2.csv"]
        assert "left out, since its rows are not 0.05 s apart" in recording.warnings[0]


class TestEpisodes:
    def test_a_column_of_episodes(self, file):
        first, second = a_table(), a_table(rows=31)
        table = {"episode": [3] * 41 + [4] * 31, **{name: np.r_[first[name], second[name]] for name in HEADER}}
        recording = load(write(file, table))
        assert [episode.samples for episode in recording.episodes] == [40, 30]
        assert recording.sources == (f"{file}, episode 3", f"{file}, episode 4")

    def test_rows_are_counted_in_the_file(self, file):
        first, second = a_table(), a_table(rows=31)
        table = {"episode": [3] * 41 + [4] * 31, **{name: np.r_[first[name], second[name]] for name in HEADER}}
        table["x"][50] = np.nan
        refuses(r"episode 4: row 51 \(line 52\), column 'x' is nan", write(file, table))

    def test_three_rows(self, file):
        refuses("run.csv: too short: 3 rows, 0.1 s; .* at least 0.5 s", write(file, a_table(rows=3)))

    def test_a_short_episode_is_left_out(self, tmp_path):
        write(tmp_path / "a.csv", a_table())
        write(tmp_path / "b.csv", a_table(rows=10))
        recording = load(tmp_path)
        assert len(recording.episodes) == 1
        assert recording.warnings == (
            f"{tmp_path / 'b.csv'}, from row 1 (line 2) on: shorter than 0.5 s, so it is left out",
        )

    def test_half_a_second_is_enough(self, file):
        assert load(write(file, a_table(rows=11))).samples == 10

    def test_warnings_of_one_kind_are_one_line(self, tmp_path):
        write(tmp_path / "a.csv", a_table())
        for name in "bcde":
            write(tmp_path / f"{name}.csv", a_table(rows=10))
        (warning,) = load(tmp_path).warnings
        assert "b.csv, from row 1 (line 2) on and 3 more: " in warning


class TestPaths:
    def test_a_folder_several_files_and_one(self, tmp_path):
        for name in "cab":
            write(tmp_path / f"{name}.csv", a_table())
        (tmp_path / "README.md").write_text("not a recording")
        assert [source[-5:] for source in load(tmp_path).sources] == ["a.csv", "b.csv", "c.csv"]
        assert [s[-5:] for s in load(tmp_path / "b.csv", tmp_path / "a.csv").sources] == ["b.csv", "a.csv"]

    def test_a_folder_without_recordings(self, tmp_path):
        refuses("a folder without recordings; files that end in .csv", tmp_path)

    def test_a_path_that_is_not_there(self, tmp_path):
        refuses("none.csv: there is no such file or folder", tmp_path / "none.csv")

    def test_a_folder_with_one_torn_file(self, tmp_path):
        for name in "abc":
            write(tmp_path / f"{name}.csv", a_table())
        torn = tmp_path / "b.csv"
        torn.write_text(torn.read_text()[:-30])
        refuses(r"b.csv: row 41 \(line 42\) is cut short", tmp_path)

    def test_a_state_that_only_some_files_have_is_not_used(self, tmp_path):
        whole, part = a_table(), a_table(seed=1)
        del part["x_dot"]
        recording = load(write(tmp_path / "a.csv", whole), write(tmp_path / "b.csv", part))
        assert recording.measured == ("x", "theta", "theta_dot")
        np.testing.assert_array_equal(recording.episodes[0].state[:, 1], whole["theta"])
        assert recording.warnings == (
            f"{tmp_path / 'b.csv'}: has no column 'x_dot', so that of the other files is not used",
        )


class TestUnits:
    @pytest.mark.parametrize("columns", [("theta",), ("theta_dot",), ("theta", "theta_dot")])
    @pytest.mark.parametrize("start", [0.03, 0.2, 3.0])
    @pytest.mark.parametrize("noise", [1e-3, 9e-3])
    def test_degrees(self, file, columns, start, noise):
        table = a_run(start=start, noise=noise)
        for name in columns:
            table[name] = np.degrees(table[name])
        refuses("run.csv: .*theta.*radians are right", write(file, table))

    @pytest.mark.parametrize("start", [0.03, 0.2, 3.0])
    @pytest.mark.parametrize("noise", [1e-3, 9e-3])
    @pytest.mark.parametrize("rates", [False, True])
    def test_radians(self, file, start, noise, rates):
        for seed in range(5):
            table = a_run(start=start, noise=noise, seed=seed)
            if not rates:
                del table["x_dot"], table["theta_dot"]
            assert load(write(file, table)).warnings == ()

    @pytest.mark.parametrize("start", [0.03, 0.2, 3.0])
    @pytest.mark.parametrize("noise", [1e-3, 9e-3])
    def test_degrees_without_velocities(self, file, start, noise):
        table = a_run(start=start, noise=noise)
        table["theta"] = np.degrees(table["theta"])
        del table["x_dot"], table["theta_dot"]
        refuses("column 'theta' .*radians are right", write(file, table))

    @pytest.mark.parametrize("scale", [100, 1000])
    def test_lengths_in_smaller_units(self, file, scale):
        table = a_table(rows=200)
        table["x"] = table["x"] * scale
        refuses("column 'x' is .* metres are right", write(file, table))

    def test_a_pole_that_turns_over_is_unwrapped(self, file):
        table = a_table(rows=200)
        angle = np.pi * (1 + np.sin(1.5 * table["time"])) + 0.5
        table["theta"] = (angle + np.pi) % (2 * np.pi) - np.pi
        table["theta_dot"] = 1.5 * np.pi * np.cos(1.5 * table["time"])
        state = load(write(file, table)).episodes[0].state[:, 2]
        assert np.abs(np.diff(state)).max() < 1
        np.testing.assert_allclose(np.cos(state), np.cos(angle), atol=1e-12)

    def test_a_pole_that_was_swung_up_is_upright_at_0(self, file):
        table = a_table(rows=200)
        angle = -np.pi * (1.5 + 0.5 * np.tanh(table["time"] - 8))  # hangs for most of the time
        table["theta"] = (angle + np.pi) % (2 * np.pi) - np.pi
        del table["theta_dot"]
        state = load(write(file, table)).episodes[0].state[:, 2]
        assert abs(state[-1]) < 0.1

    def test_an_angle_that_goes_round_several_times(self, file):
        table = a_table(rows=200)
        table["theta"], table["theta_dot"] = 3 * table["time"], np.full(200, 3.0)
        assert load(write(file, table)).samples == 199

    @pytest.mark.parametrize(("one", "other"), [("x", "theta"), ("x", "x_dot"), ("theta", "theta_dot")])
    def test_columns_that_changed_places(self, file, one, other):
        table = a_table(rows=200)
        table[one], table[other] = table[other], table[one]
        refuses(f"column '{one}' and column '{other}' have evidently changed places", write(file, table))

    @pytest.mark.parametrize("start", [0.03, 0.2])
    @pytest.mark.parametrize("rates", [False, True])
    def test_columns_that_changed_places_together(self, file, start, rates):
        table = a_run(start=start, noise=1e-3)
        table["x"], table["theta"] = table["theta"], table["x"]
        table["x_dot"], table["theta_dot"] = table["theta_dot"], table["x_dot"]
        if not rates:
            del table["x_dot"], table["theta_dot"]
        refuses("column 'x' answers the command as theta should, and column 'theta' as x", write(file, table))

    def test_a_column_is_called_what_the_file_calls_it(self, file):
        table = a_run(start=0.1, noise=1e-3)
        table["pole_angle"] = np.degrees(table.pop("theta"))
        refuses(r"column 'pole_angle' \(theta\) .* radians are right", write(file, table))

    def test_metres_that_wrap(self, file):
        table = a_table(rows=200)
        angle = np.pi * np.sin(1.5 * table["time"]) + np.pi
        table["theta"], table["x"] = table["x"], (angle + np.pi) % (2 * np.pi) - np.pi
        del table["x_dot"], table["theta_dot"]
        refuses("column 'x' jumps by .*did two columns change places", write(file, table))

    def test_noise_is_no_reason_to_refuse(self, file):
        load(write(file, a_table(rows=400, noise=9e-3)))


class TestCommands:
    def test_all_out_of_range(self, file):
        table = a_table()
        table["command"] = 30 * table["command"]
        refuses(r"row \d+ \(line \d+\), column 'command' is -?\d.*within \[-1, 1\] is right", write(file, table))

    def test_a_little_out_of_range(self, file):
        table = a_table()
        table["command"] = 1.1 * table["command"]
        (warning,) = load(write(file, table)).warnings
        assert "of command lie outside, up to" in warning

    def test_never_changing(self, file):
        table = a_table()
        table["command"] = np.zeros(41)
        (warning,) = load(write(file, table)).warnings
        assert "command never changes" in warning
        assert "cannot be told from nothing" in warning


class TestSize:
    def test_a_million_rows(self, file):
        rows = 10**6
        table = a_table(rows=1000, period=0.01)
        block = np.column_stack([table[name] for name in HEADER[1:]])
        line = "\n".join("{},%.9g,%.9g,%.9g,%.9g,%.9g" % tuple(row) for row in block)  # noqa: UP031
        count = iter(range(rows))
        body = "\n".join([line] * (rows // 1000)).split("\n")
        file.write_text(
            "episode,time,x,x_dot,theta,theta_dot,command\n"
            + "\n".join(f"{n // 1000},{text.format(n % 1000 / 100)}" for n, text in zip(count, body, strict=True))
        )
        start = stopwatch.perf_counter()
        recording = load(file)
        assert recording.samples == rows - 1000
        assert stopwatch.perf_counter() - start < 60


class TestRoundTrip:
    def episodes(self):
        tables = [a_table(rows=rows, seed=rows) for rows in (11, 41, 23)]
        return [
            Episode(
                time=table["time"],
                action=table["command"][:, None],
                state=np.column_stack([table[name] for name in STATES]),
            )
            for table in tables
        ]

    def assert_same(self, recording):
        assert recording.warnings == ()
        for back, episode in zip(recording.episodes, self.episodes(), strict=True):
            np.testing.assert_allclose(back.time, episode.time, atol=1e-12)
            np.testing.assert_array_equal(back.state, episode.state)
            np.testing.assert_array_equal(back.action, episode.action)

    def test_csv(self, file):
        write_csv(file, self.episodes(), STATES, ["command"])
        self.assert_same(load(file))

    def test_hdf5_with_and_without_names(self, tmp_path):
        path = tmp_path / "a.h5"
        write_recording(path, self.episodes())
        self.assert_same(load(path))
        order = [2, 3, 0, 1]
        turned = [replace(episode, state=episode.state[:, order]) for episode in self.episodes()]
        write_recording(path, turned, [STATES[index] for index in order], ["command"])
        self.assert_same(load(path))

    def test_hdf5_that_does_not_fit(self, tmp_path):
        path = tmp_path / "a.h5"
        write_recording(path, [replace(episode, state=episode.state[:, :3]) for episode in self.episodes()])
        refuses("a.h5, episode 0: 3 columns of state and 1 of action", path)
        frames = [replace(e, state=None, frame=np.zeros((len(e.time), 2, 2), np.uint8)) for e in self.episodes()]
        write_recording(path, frames)
        refuses("holds frames alone; states are needed", path)
        path.write_bytes(path.read_bytes()[:500])
        refuses("a.h5: not a readable HDF5 file, or cut short", path)

    def test_what_cannot_be_written(self, file):
        with pytest.raises(RecordingError, match="at least one episode"):
            write_csv(file, [], STATES, ["command"])
        with pytest.raises(RecordingError, match="4 columns of state and 1 of action; there are names for 3 and 1"):
            write_csv(file, self.episodes(), STATES[:3], ["command"])
        frames = replace(self.episodes()[0], state=None, frame=np.zeros((11, 2, 2), np.uint8))
        with pytest.raises(RecordingError, match="episode 0 has no states"):
            write_csv(file, [frames], STATES, ["command"])
        assert not file.exists()

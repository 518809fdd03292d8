import numpy as np
import pytest

from tests.recorded import HEADER, a_table, load, refuses, write


class TestClock:
    @pytest.mark.parametrize(("later", "problem"), [(0.2, "repeats itself"), (0.1, "runs backward")])
    def test_a_clock_that_does_not_run_forward(self, file, later, problem):
        table = a_table()
        table["time"][5] = later
        refuses(rf"row 6 \(line 7\), column 'time': the clock {problem}", write(file, table))

    def test_stamps_of_an_epoch_are_shown_whole(self, file):
        table = a_table()
        table["time"] = 1.7e9 + np.round(table["time"], 3)
        table["time"][5] -= 0.08
        refuses(r"the clock runs backward \(from 1700000000.2 s to 1700000000.17 s\)", write(file, table))

    def test_long_numbers_of_episodes_are_told_apart(self, file):
        table = {"episode": [20240601] * 41 + [20240602] * 41, **{name: [*c, *c] for name, c in a_table().items()}}
        sources = load(write(file, table)).sources
        assert [source.rpartition(" ")[2] for source in sources] == ["20240601", "20240602"]

    def test_rounded_stamps_are_those_of_a_steady_clock(self, file):
        table = a_table(rows=200, period=0.0203)
        table["time"] = np.round(1234.5 + table["time"], 3)
        recording = load(write(file, table))
        assert recording.period == pytest.approx(0.0203, rel=1e-3)
        assert recording.warnings == ()
        assert recording.episodes[0].time[0] == 0
        np.testing.assert_allclose(np.diff(recording.episodes[0].time), recording.period)

    def test_so_are_those_in_single_precision(self, file):
        table = a_table(rows=200, period=0.0203)
        table["time"] = (1e5 + table["time"]).astype(np.float32).astype(float)  # in steps of 1/128 s
        recording = load(write(file, table))
        assert recording.period == pytest.approx(0.0203, rel=1e-3)
        assert recording.warnings == ()

    def test_equal_stalls_are_treated_alike_whatever_their_rounding(self, file):
        table = a_table(rows=100)
        table["time"] = 0.05 * np.arange(100) + 0.1 * (np.arange(100)[:, None] >= range(10, 94, 12)).sum(1)
        recording = load(write(file, table))
        assert len(recording.episodes) in (1, 8)

    def test_a_missing_row_splits_the_episode(self, file):
        table = {name: np.delete(values, 30) for name, values in a_table(rows=81).items()}
        recording = load(write(file, table))
        assert [episode.samples for episode in recording.episodes] == [29, 49]
        assert recording.episodes[1].time[0] == pytest.approx(31 * 0.05)
        assert recording.warnings == (f"{file}, row 31 (line 32): rows are missing here; the episode was split",)

    def test_a_fast_loop_that_stalls_for_some_milliseconds_is_one_episode(self, file):
        table = {name: np.delete(values, [300, 301]) for name, values in a_table(rows=600, period=0.002).items()}
        (episode,) = load(write(file, table)).episodes
        np.testing.assert_allclose(episode.time, table["time"], atol=1e-6)

    def test_rows_of_an_unsteady_clock_keep_their_stamps(self, file):
        time = np.cumsum(np.random.default_rng(0).uniform(0.04, 0.06, 400))
        table = {"time": time, "x": 0.3 * np.sin(2 * time), "theta": 0.1 * np.sin(3 * time), "command": np.sin(time)}
        recording = load(write(file, table))
        (episode,) = recording.episodes
        np.testing.assert_allclose(episode.time, time - time[0], atol=1e-6)
        np.testing.assert_allclose(episode.state[:, 1], table["theta"], atol=1e-6)
        assert recording.period == pytest.approx(0.05, abs=0.002)
        assert "an unsteady clock: its steps last 0.04 to 0.0599 s" in " ".join(recording.warnings)

    def test_milliseconds(self, file):
        table = a_table()
        table["time"] = table["time"] * 1000
        refuses("column 'time': rows are 50 s apart.*milliseconds", write(file, table))

    def test_an_episode_of_another_period_is_left_out(self, file):
        tables = [a_table(period=period) for period in (0.05, 0.02, 0.05)]
        numbers = np.repeat([0, 1, 2], [len(table["time"]) for table in tables])
        table = {"episode": numbers, **{name: np.concatenate([one[name] for one in tables]) for name in HEADER}}
        recording = load(write(file, table))
        assert [source[-9:] for source in recording.sources] == ["episode 0", "episode 2"]
        assert "left out, since its rows are not 0.05 s apart" in " ".join(recording.warnings)

    @pytest.mark.parametrize(
        ("scale", "says"),
        [(3, "0.15 s apart, those of .*0.csv 0.05 s; .* in seconds, are"), (1000, "50 s apart; .*milliseconds")],
    )
    def test_a_file_of_another_period(self, tmp_path, scale, says):
        for number, factor in enumerate((1, scale, 1)):
            table = a_table(seed=number)
            write(tmp_path / f"{number}.csv", {**table, "time": factor * table["time"]})
        refuses(f"1.csv: column 'time': rows are {says}", tmp_path)


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
        refuses(r"episode 4: row 51 \(line 52\), column 'x' is empty or nan", write(file, table))

    @pytest.mark.parametrize("rows", [1, 2, 3])
    def test_a_few_rows(self, file, rows):
        refuses(rf"run.csv: too short: {rows} rows, .* s; .* at least 0.5 s", write(file, a_table(rows=rows)))

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
        for seed, name in enumerate("bcde"):
            write(tmp_path / f"{name}.csv", a_table(rows=10, seed=seed))
        (warning,) = load(tmp_path).warnings
        assert "b.csv, from row 1 (line 2) on and 3 more: " in warning

"""Recordings too long to be held, or to be diagnosed: stretches spread evenly over them, and a warning."""

import numpy as np
import pytest
import torch

from tests.diagnosed import record
from tests.recorded import HEADER, STATES, a_table, load, refuses, write
from visadapt.diagnosis.search.preparation import prepare
from visadapt.effects import ActuatorDelay
from visadapt.estimation.candidate import CandidateModel
from visadapt.recordings import Episode, load_recording, write_recording
from visadapt.recordings.thinning import STRETCH, spread
from visadapt.systems import CartPole

ROWS = 4 * STRETCH
TABLE = a_table(ROWS, period=0.01)


@pytest.fixture(autouse=True)
def half_of_it(monkeypatch):
    """No more than half of the rows can be held."""
    monkeypatch.setattr("visadapt.recordings.loading.MOST_BYTES", ROWS // 2 * 8 * len(HEADER))


def a_file(path):
    """The table as CSV or as HDF5."""
    if path.suffix == ".csv":
        return write(path, TABLE)
    state = np.column_stack([TABLE[name] for name in STATES])
    write_recording(path, [Episode(TABLE["time"], TABLE["command"][:, None], state)], STATES, ["command"])
    return path


@pytest.mark.parametrize("name", ["run.csv", "run.h5"])
def test_of_a_file_that_is_too_long_every_second_stretch_is_read_and_a_warning_says_so(tmp_path, name):
    found = load(a_file(tmp_path / name))
    assert f"{name}: 20,000 rows are more than can be held: 10,000 of them are used" in found.warnings[0]
    assert [len(episode.time) for episode in found.episodes] == [STRETCH, STRETCH]
    for episode, first in zip(found.episodes, (0, 2 * STRETCH), strict=True):
        assert episode.time[0] == pytest.approx(TABLE["time"][first])
        np.testing.assert_array_equal(episode.state[:, 0], TABLE["x"][first : first + STRETCH])


def test_two_files_share_what_can_be_held(tmp_path):
    paths = [write(tmp_path / f"{k}.csv", {**TABLE, "x": TABLE["x"] + k * 1e-3}) for k in range(2)]
    assert load(*paths).samples == pytest.approx(ROWS // 2, rel=0.1)


def test_what_is_left_out_is_looked_at_and_rows_are_those_of_the_file(tmp_path):
    path = write(tmp_path / "run.csv", {**TABLE, "x": [*TABLE["x"][: STRETCH + 1], "?", *TABLE["x"][STRETCH + 2 :]]})
    refuses(r"row 5002 \(line 5003\), column 'x' is '\?'", path)
    path = write(tmp_path / "run.csv", {**TABLE, "x": np.where(np.arange(ROWS) == 2 * STRETCH + 1, np.nan, TABLE["x"])})
    refuses(r"row 10002 \(line 10003\), column 'x' is empty or nan", path)


def test_reading_tells_how_far_it_is(tmp_path):
    told = []
    load_recording(a_file(tmp_path / "run.csv"), CartPole(), progress=lambda *report: told.append(report))
    assert [stage for stage, *_ in told] == ["reading run.csv (MB)"] * 4
    assert [done for _, done, _, _ in told] == sorted(done for _, done, _, _ in told)


def test_rows_for_a_diagnosis_are_spread_evenly_and_keep_their_times(tmp_path):
    whole = load(a_file(tmp_path / "run.csv"))
    part = spread(whole, 1000, 200, 50)
    usable = [read.all(1) for read in part.usable]
    assert sum(rows.sum() for rows in usable) == pytest.approx(1000, abs=20)
    assert {rows.sum() for rows in usable} == {200}
    begins = [episode.time[rows.argmax()] for episode, rows in zip(part.episodes, usable, strict=True)]
    assert begins == pytest.approx([0, 24, 48, 122, 148], abs=5)
    assert [source.rpartition(", ")[2] for source in part.sources] == [f"from {time:.1f} s" for time in begins]
    assert "10,000 rows are more than a diagnosis looks at: 1,000 of them were used" in part.warnings[-1]
    assert spread(whole, 20_000, 200, 50) is whole


def test_the_commands_before_a_stretch_are_in_the_memory_of_what_is_late():
    rows = prepare(spread(record(episodes=1, rows=400), 120, 40, 20), CartPole()).rows
    assert rows.inside.sum() == 120
    model = CandidateModel(CartPole(), (ActuatorDelay,), rows)
    acting = model.commands(torch.tensor([[0.15]], dtype=torch.float64))[0, :, 0].mean((1, 2))
    given = torch.stack([rows.command[k, max(0, first - 3)] for k, first in zip(rows.episode, rows.first, strict=True)])
    later = rows.first > 0
    assert later.sum() >= 2
    torch.testing.assert_close(acting[later], given[later, 0])

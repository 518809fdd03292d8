import io
import sys

import pytest

from visadapt import progress


@pytest.fixture
def clock(monkeypatch):
    """Seconds, set by hand, that the report reads."""
    now = [100.0]
    monkeypatch.setattr("visadapt.progress.time.monotonic", lambda: now[0])
    return now


def lines(clock, monkeypatch, seconds_a_step, steps, order=None):
    """What is printed of a stage of some steps; they are reported in the `order` of their numbers, or in another."""
    out = io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    with progress.reporting() as report:
        for done in order or range(1, steps + 1):
            report("perception", done, steps, 0.5)
            clock[0] += seconds_a_step
    return out.getvalue().splitlines()


def test_without_a_terminal_a_slow_stage_prints_a_line_every_half_minute(clock, monkeypatch):
    printed = lines(clock, monkeypatch, 0.5, 4000)
    assert printed[0] == "perception: 61 of 4000 steps, loss 0.5, 32 min left"
    assert printed[-1] == "perception: 4000 of 4000 steps, loss 0.5"
    # Half a minute is 60 steps here; the tenths between these lines add some.
    assert 4000 / 60 <= len(printed) <= 4000 / 60 + 10


def test_a_quicker_one_a_line_every_tenth(clock, monkeypatch):
    printed = lines(clock, monkeypatch, 0.1, 1000)
    assert [line.split()[1] for line in printed] == [str(100 * k) for k in range(1, 11)]
    assert printed[0].endswith("89 s left")


def test_and_one_of_a_second_no_more_than_its_last(clock, monkeypatch):
    assert lines(clock, monkeypatch, 0.001, 1000) == ["perception: 1000 of 1000 steps, loss 0.5"]


def test_a_stage_may_go_back(clock, monkeypatch):
    """As a search does that goes on from a smaller set."""
    assert lines(clock, monkeypatch, 40, 6, order=(4, 5, 3, 2, 6)) == [
        "perception: 5 of 6 steps, loss 0.5, 20 s left",
        "perception: 6 of 6 steps, loss 0.5",
    ]

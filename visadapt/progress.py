"""Progress on the terminal: for each stage a bar with its loss and the time left."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress as Bars,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn as TimeLeftColumn,
)

Report = Callable[[str, int, int, float], None]
"""Called with (stage, steps done, steps in total, loss); the loss is nan where a stage has none."""

Progress = Callable[[int, int, float], None]
"""Called with (steps done, steps in total, loss): the report of one stage."""

SECONDS_APART, SECONDS_AT_MOST = 5.0, 30.0
"""s from one line of a log to the next: at least, and at most, if steps are reported that often."""


class _Log:
    """The report where no terminal is attached: a line every tenth of a stage or 30 s, and one when it is done."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.stage = ""
        self.first = self.last = (0.0, 0.0)
        """(s, share done) where this process took the stage up, or where it began again, and of its last line"""

    def __call__(self, stage: str, done: int, total: int, loss: float) -> None:
        now, share = time.monotonic(), done / total
        if stage != self.stage or share <= self.first[1]:
            self.stage, self.first = stage, (now, (done - 1) / total)
            self.last = self.first
        waited, advanced = now - self.last[0], int(10 * share) > int(10 * self.last[1])
        if done < total and waited < SECONDS_AT_MOST and (waited < SECONDS_APART or not advanced):
            return
        self.last = now, share
        line = f"{stage}: {done} of {total} steps" + ("" if math.isnan(loss) else f", loss {loss:.4g}")
        if done < total:
            left = (now - self.first[0]) * (1 - share) / (share - self.first[1])
            line += f", {left / 60:.0f} min left" if left >= 120 else f", {left:.0f} s left"
        self.console.print(line, soft_wrap=True, highlight=False)


@contextmanager
def reporting() -> Iterator[Report]:
    """A report that shows one bar per stage; without a terminal it prints lines for a log."""
    console = Console()
    if not console.is_terminal:
        yield _Log(console)
        return
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]:<9.4g}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeLeftColumn(),
    )
    stages: dict[str, TaskID] = {}
    with Bars(*columns, console=console) as bars:

        def report(stage: str, done: int, total: int, loss: float) -> None:
            if stage not in stages:
                for earlier in stages.values():
                    bars.stop_task(earlier)
                stages[stage] = bars.add_task(stage, total=total, loss=loss)
            bars.update(stages[stage], completed=done, total=total, loss=loss)

        yield report


def staged(report: Report | None, stage: str) -> Progress | None:
    """The report of one stage; None if `report` is."""
    if report is None:
        return None
    return lambda done, total, loss: report(stage, done, total, loss)

"""Progress on the terminal: for each stage a bar with its loss and the time left."""

from __future__ import annotations

import math
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


@contextmanager
def reporting() -> Iterator[Report]:
    """A report that shows one bar per stage; without a terminal it prints one line when a stage is done."""
    console = Console()
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
    with Bars(*columns, console=console, disable=not console.is_terminal) as bars:

        def report(stage: str, done: int, total: int, loss: float) -> None:
            if stage not in stages:
                for earlier in stages.values():
                    bars.stop_task(earlier)
                stages[stage] = bars.add_task(stage, total=total, loss=loss)
            bars.update(stages[stage], completed=done, total=total, loss=loss)
            if done == total and not console.is_terminal:
                console.print(f"{stage}: {done} steps" + ("" if math.isnan(loss) else f", loss {loss:.4g}"))

        yield report


def staged(report: Report | None, stage: str) -> Progress | None:
    """The report of one stage; None if `report` is."""
    if report is None:
        return None
    return lambda done, total, loss: report(stage, done, total, loss)

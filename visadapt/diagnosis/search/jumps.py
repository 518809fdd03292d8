"""The search made again with another process noise, where something strong is left unexplained.

A load that is missing from a model moves all joints through the mass matrix, and so does process noise. But a machine
whose parts bend, or whose motors are late, misses its model in each velocity by itself; taken for loads, that falsifies
masses and inertias: of a real double pendulum inertias and a motor were named that closed nothing of the gap. There
process noise is a jump of each velocity, and the sets found with it are taken where they are clearly likelier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from visadapt.diagnosis.search.all_rows import on_all_rows
from visadapt.diagnosis.search.coloured import with_coloured_noise
from visadapt.diagnosis.search.model_comparison import ModelComparison, compare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import Effect
from visadapt.estimation.segments import Segments
from visadapt.progress import Progress

CLEARLY = 50.0
"""Log posterior odds from which the sets found with jumps are taken: 3,400 on the double pendulum, 12 on a recording of
a cart-pole of which either noise is as good."""


def or_with_jumps(
    search: Search,
    comparison: ModelComparison,
    rows: Segments,
    searched: Tensor,
    catalogue: Sequence[type[Effect]],
    progress: Progress | None = None,
) -> tuple[Search, ModelComparison]:
    """The search and its comparison, or those with jumps of the velocities as process noise, if their best set is
    clearly likelier.

    Tried where `search` has coloured noise: there something strong is unexplained. `searched` are the windows of
    `rows`, by index, in which sets of the `catalogue` are looked for.
    """
    if search.rows.colour is None:
        return search, comparison
    rows = replace(rows, jumps=True)
    other = Search(search.system, rows.select(searched), catalogue, jobs=search.jobs)
    other.run(progress)
    if len(searched) < rows.shape[0]:
        other = on_all_rows(other, rows)
    other, found = with_coloured_noise(other, compare(other), searched, progress)
    likelier = found.best.log_odds > comparison.best.log_odds + CLEARLY
    return (other, found) if likelier else (search, comparison)

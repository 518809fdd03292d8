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
"""Log posterior odds from which the sets found with jumps are taken: 3,400 on the double pendulum. On recordings of a
cart-pole of which either noise is as good they are behind by 6 to 186."""


def or_with_jumps(
    white: Search,
    found: tuple[Search, ModelComparison],
    rows: Segments,
    searched: Tensor,
    catalogue: Sequence[type[Effect]],
    progress: Progress | None = None,
) -> tuple[Search, ModelComparison]:
    """The search and the comparison that were `found`, or those with jumps of the velocities as process noise.

    Tried where what was found has coloured noise: there something strong is unexplained. Jumps are taken if, both with
    white noise, their best set is clearly likelier than that of the search `white`. `searched` are the windows of
    `rows`, by index, in which sets of the `catalogue` are looked for.
    """
    if found[0].rows.colour is None:
        return found
    rows = replace(rows, jumps=True)
    other = Search(white.system, rows.select(searched), catalogue, jobs=white.jobs)
    other.run(progress)
    other = on_all_rows(other, rows)
    if other.best.log_odds < white.best.log_odds + CLEARLY:
        return found
    return with_coloured_noise(other, compare(other), searched, progress)

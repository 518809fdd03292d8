"""How long a diagnosis will take, said before it begins."""

from __future__ import annotations

import time

from visadapt.diagnosis.search.search import Search
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.likelihood import differentiate
from visadapt.estimation.segments import Segments

SEARCH_STEPS = {0.0: 2, 10.0: 20}
"""Duration of a search per effect of the catalogue, in steps of a fit of the source to the rows searched; by the log
likelihood that the best effect promises. Measured on recordings with hidden effects of many sizes."""

FINAL_STEPS = {0.0: 80, 10.0: 120}  # Duration of the fits to all rows and of the predictions, in steps on all rows

LONGEST = 30  # Times the expected duration, at most, that a diagnosis took where much stayed unexplained

SHARED = 0.6  # Speed that each process beyond the first adds, as a share of that of the first


def expected(search: Search, rows: Segments) -> float:
    """Expected duration in s, from a step of a fit that is timed here, and from what the best effect promises.

    Within a factor of about three where one effect or two explain the gap: one takes less, two take more. Recordings of
    a real machine that several effects separate from its simulator, and of which much stays unexplained, took four to
    six times as long (a double pendulum, 3,988 and 3,990 rows); those of a motor whose cogging no effect explains, 26
    times.

    Args:
        search: before it has run; it may be on some of the rows.
        rows: all rows.
    """
    model, fits = CandidateModel(search.system, (), search.rows), search.source.fits
    began = time.perf_counter()
    differentiate([model], fits)
    step = time.perf_counter() - began
    promised = search.promised()
    searching, final = (
        max(steps for least, steps in table.items() if promised >= least) for table in (SEARCH_STEPS, FINAL_STEPS)
    )
    effort = searching * len(search.catalogue) + final * rows.shape[0] / search.rows.shape[0]
    return step * effort / (1 + SHARED * (search.jobs - 1))


def announcement(rows: Segments, effects: int, seconds: float, jobs: int) -> str:
    """The size of the problem and its expected duration, in one line.

    >>> import torch
    >>> from visadapt.estimation.segments import cut
    >>> ones = [torch.ones(120, 2).double()]
    >>> rows = cut(ones, ones, ones, [torch.arange(120.0)], (0, 2), 1.0, 120)
    >>> announcement(rows, 24, 87.0, 2)
    '120 rows of 2 channels, 24 effects: about 90 s on 2 cores, up to 45 min where much stays unexplained'
    """
    count, channels = int(rows.inside.sum()), len(rows.channels)
    rounded = float(f"{seconds:.1g}") if seconds < 100 else float(f"{seconds:.2g}")
    cores = "1 core" if jobs == 1 else f"{jobs} cores"
    longest = LONGEST * rounded
    most = f"{longest:.2g} s" if longest < 120 else f"{round(longest / 60)} min"
    about = f"about {rounded:g} s on {cores}, up to {most} where much stays unexplained"
    return f"{count:,} rows of {channels} channels, {effects} effects: {about}"

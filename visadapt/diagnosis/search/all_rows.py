"""A search on some of the rows of a long recording, continued on all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.diagnosis.search.search import MAX_EFFECTS, Search
from visadapt.estimation.fit_states import CAREFUL, FINAL, Effects
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.segments import Segments

FINALISTS = 4  # Sets at most that are fitted to all rows

MAX_ADDED, TRIED = 2, 2
MIN_GAIN = 6.0
"""Effects at most that are then added to the best set, how many are tried for each, and the log likelihood that they
must promise: less would not outweigh the prior odds."""


def best_on_all_rows(
    search: Search, rows: Segments, effort: tuple[int, int] = CAREFUL, others: int = FINALISTS - 1
) -> Search:
    """The best set of a search, and at most `others` close to it, fitted to all rows."""
    whole = Search(search.system, rows, search.catalogue, search.source.fits, search.jobs)
    close = [each for each in search.near_best() if each.effects][: 1 + others]

    def starts(group: Sequence[ScoredModel]) -> list[tuple[Effects, FitState]]:
        # From the states of the best set so far, which a start from the readings would first have to find.
        return [(each.effects, replace(each.fits, state=whole.best.fits.state)) for each in group]

    # The states of a source that is far off are far off too: a fit from there may fall behind before it comes near.
    (found,) = whole.fit(starts(close[:1]), effort, to_the_end=True) or [whole.source]
    if found.fits.likelihood < whole.source.fits.likelihood:
        # Its states are far off for the little process noise that it had on the rows searched.
        noisier = replace(found.fits, state=whole.source.fits.state, log_process=whole.source.fits.log_process)
        whole.fit([(found.effects, noisier)], effort, to_the_end=True)
    if len(close) > 1:
        whole.fit_at_rest(whole.best)  # the others start from its states
    whole.fit(starts(close[1:]), FINAL)
    whole.exchange_in_rejected()
    return whole


def on_all_rows(search: Search, rows: Segments) -> Search:
    """The best sets of a search, fitted to all rows, then with further effects; the search itself if it has all rows.

    All rows show weaker effects than the rows searched do.
    """
    if search.rows.shape[0] == rows.shape[0]:
        return search
    whole = best_on_all_rows(search, rows)
    for _ in range(MAX_ADDED):
        before = whole.best
        promising = [one for one in whole.candidates(before) if one.gain > MIN_GAIN]
        if not promising or len(before.effects) >= MAX_EFFECTS:
            break
        whole.extend([before], min(len(promising), TRIED))
        if whole.best is before:
            break
        whole.fit([(whole.best.effects, whole.best.fits)], FINAL)
    return whole

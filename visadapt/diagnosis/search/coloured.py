"""The search gone on with coloured noise, where what it leaves unexplained is not white.

A real machine resonates, and its model does not: white noise that is as strong as that at every frequency hides what
the model gets right at others, and parameters take up what they can of the rest. So the search goes on from the best
sets with the colour of the best one's innovations as noise (`estimation/colour.py`).
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from visadapt.diagnosis.search.all_rows import on_all_rows
from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.diagnosis.search.model_comparison import MIN_LEFTOVER, ModelComparison, compare, compare_coloured
from visadapt.diagnosis.search.search import Search
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.colour import Colour, colour_of
from visadapt.estimation.kalman import forward
from visadapt.estimation.likelihood import linear_problem, variances
from visadapt.progress import Progress

ROUNDS = 2  # Searches with coloured noise at most; the last has the colour of what the best set of the first leaves

START_FROM = 4  # Best sets of a search from which the next one begins


def with_coloured_noise(
    search: Search, comparison: ModelComparison, searched: Tensor, progress: Progress | None = None
) -> tuple[Search, ModelComparison]:
    """The search and its comparison gone on with coloured noise, where something is unexplained that is not white; else
    as they are.

    The best set that is found only so is tried with white noise too, where it may explain all. What is unexplained is
    what the best set with white noise leaves. `searched` are the windows, by index, in which sets are looked for.
    """
    found, other = comparison, search
    for made in range(ROUNDS):
        coloured_by = found.best
        colour = colour_left_by(search, coloured_by) if comparison.leftover > MIN_LEFTOVER else None
        if colour is None:
            break
        rows = replace(search.rows, colour=colour)
        begin = [(each.effects, each.fits.on(searched)) for each in other.close()[:START_FROM]]
        other = Search(search.system, rows.select(searched), search.catalogue, jobs=search.jobs)
        other.go_on_from(begin, progress)
        other = on_all_rows(other, rows)
        found = compare_coloured(other, comparison)
        # The source predicts as it was fitted, with noise of its own.
        other.fitted[frozenset()] = search.source
        if search.resume(found.best):
            comparison = found = compare(search)
            other = search
        elif made and found.best.names == coloured_by.names:
            break
    return other, found


def colour_left_by(search: Search, best: ScoredModel) -> Colour | None:
    """The colour of the innovations of a model with white noise, or with that of an earlier colour."""
    model = CandidateModel(search.system, best.effects, search.rows)
    problem = linear_problem([model], best.fits).data()
    innovations = forward(problem, *variances(model, best.fits, problem)).white[..., 0]
    return colour_of(
        innovations, search.rows.inside, search.rows.period, best.fits.log_process[0], best.fits.log_noise[0]
    )

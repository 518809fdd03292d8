"""The search continued with coloured noise, where what it leaves unexplained is not white.

A real machine has resonances that its model lacks. White noise strong enough for a resonance is as strong at every
other frequency: it hides what the model gets right there, and parameters absorb what they can of the rest. So the
search continues from the best sets, with noise that has the colour of the best set's innovations
(`estimation/colour.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from torch import Tensor

from visadapt.diagnosis.search.all_rows import best_on_all_rows, on_all_rows
from visadapt.diagnosis.search.fitted_models import MIN_LEFTOVER, ScoredModel
from visadapt.diagnosis.search.model_comparison import ModelComparison, compare, compare_coloured
from visadapt.diagnosis.search.search import Search
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.colour import Colour, colour_of
from visadapt.estimation.fit_states import FINAL
from visadapt.estimation.kalman import forward
from visadapt.estimation.likelihood import linear_problem, variances
from visadapt.progress import Progress

START_FROM = 4  # Best sets of a search from which the next one begins

REACH = 0.3  # Prediction times that the autoregression of coloured noise reaches back at most


def with_coloured_noise(
    search: Search, comparison: ModelComparison, searched: Tensor, progress: Progress | None = None
) -> tuple[Search, ModelComparison]:
    """The search and its comparison continued with coloured noise, if what is unexplained is not negligible and not
    white; else unchanged.

    The most probable set is also fitted with white noise, where it may explain everything; what counts as unexplained
    is what the best set with white noise leaves. `searched` are the indices of the windows in which sets are looked
    for.
    """
    # Too little has no colour that could be told: of two effects found to 0.01 %, one came out 1.6 % off with it.
    colour = None
    if comparison.leftover > MIN_LEFTOVER and not comparison.negligible:
        colour = colour_left_by(search, comparison.best)
    if colour is None:
        return search, comparison
    found = continued(search, colour, partial(colour_left_by, search), searched, progress)
    compared = compare_coloured(found, comparison)
    if search.resume(compared.best):
        comparison = compare(search)
        if comparison.leftover <= MIN_LEFTOVER:
            return search, comparison
        compared = compare_coloured(found, comparison)
    # The source predicts as it was fitted, with noise of its own.
    found.fitted[frozenset()] = search.source
    return found, compared


def continued(
    search: Search,
    colour: Colour,
    left_by: Callable[[ScoredModel], Colour | None],
    searched: Tensor,
    progress: Progress | None,
) -> Search:
    """A search continued with noise of a colour, then on all rows.

    First, sets only grow from the best ones. Then, with the colour that is `left_by` the set so found, sets near the
    best are tried too. `searched` are the indices of the windows in which sets are looked for.
    """
    begin = [(each.effects, each.fits.on(searched)) for each in search.near_best()[:START_FROM]]
    rows = replace(search.rows, colour=colour)
    grown = Search(search.system, rows.select(searched), search.catalogue, jobs=search.jobs)
    grown.go_on_from(begin, exchange=False, progress=progress)
    begin = [(each.effects, each.fits) for each in grown.near_best()[:START_FROM]]
    colour = left_by(best_on_all_rows(grown, rows, FINAL, others=0).best) or colour
    rows = replace(search.rows, colour=colour)
    found = Search(search.system, rows.select(searched), search.catalogue, jobs=search.jobs)
    found.go_on_from(begin, exchange=True, progress=progress)
    return on_all_rows(found, rows)


def colour_left_by(search: Search, best: ScoredModel, own: bool = False) -> Colour | None:
    """The colour of the innovations of a model with white noise, or with that of an earlier colour; with `own`, each
    channel follows its own past alone."""
    model = CandidateModel(search.system, best.effects, search.rows)
    problem = linear_problem([model], best.fits).data()
    innovations = forward(problem, *variances(model, best.fits, problem)).white[..., 0]
    longest = REACH * search.system.prediction_time / search.rows.period
    return colour_of(innovations, search.rows.inside, longest, best.fits.log_process[0], best.fits.log_noise[0], own)

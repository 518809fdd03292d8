"""The search continued with errors of readings that last for several rows, where these leave nothing unexplained.

What a state estimator wrote, such as the Kalman filter of a flight controller, is not off by another centimetre in
every row, but by the same one for a second. White noise cannot describe that: process noise then follows the errors,
as if a load moved the machine, and nothing explains that load. Here the readings are described without process noise,
by errors of which each follows its own past (an autoregression of the innovations, `estimation/colour.py`).

A load that is missing from the model moves a position and its velocity together, through the machine's dynamics. So
process noise, whose innovations are described in the same way, is then the likelier description, and the search goes on
as before. In flights simulated with an estimator's errors and nothing else, errors of readings led by 9 to 580 in log
likelihood; in flights with white noise and an unknown load, process noise led by 200 to 560.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from torch import Tensor

from visadapt.diagnosis.search.coloured import colour_left_by, continued
from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.diagnosis.search.model_comparison import ModelComparison, compare_coloured
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.search.unexplained import SmoothFunction, smooth_functions
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.colour import Colour
from visadapt.estimation.fit_states import CAREFUL
from visadapt.estimation.likelihood import differentiate
from visadapt.progress import Progress

CLEARLY = 50.0  # Log likelihood that correlated errors must add to white noise

LEAD = 3.0  # Log likelihood by which they must be likelier than process noise

MOST_LAGS = 3
"""Lags, in rows, of the autoregression at most. An estimator's errors fade; those that need more lags swing, as an
error does that depends on the state."""

MANY_ROWS = 2.0  # Rows that errors of readings must last for to be told of

FEWEST_SENSORS = 2
"""States whose readings must err so, since an estimator errs in several: one sensor alone may err by where it is, as an
encoder does that is off its axis."""

MOST_DECAY = 0.99  # Sum of an autoregression's coefficients at most: windows are too short to show slower errors


def with_correlated_errors(
    search: Search, comparison: ModelComparison, searched: Tensor, progress: Progress | None = None
) -> tuple[Search, ModelComparison] | None:
    """The search and its comparison continued with correlated errors of readings, where something is unexplained and
    these leave nothing so; else None. `searched` are the indices of the windows in which sets are looked for."""
    if not comparison.unexplained(False):
        return None
    colour = _errors_beside(search, comparison.best)
    if colour is None:
        return None
    found = continued(search, colour, partial(_errors_beside_set, search), searched, progress)
    compared = compare_coloured(found, comparison)
    if _errors_beside_set(search, compared.best) is None:
        return None
    compared = replace(compared, leftover=0.0, functions=_not_such_errors(found, compared.best))
    return None if compared.unexplained(False) else (found, compared)


def lasting(search: Search) -> dict[tuple[str, ...], float]:
    """How long the errors of a search with correlated errors last, in s, by the states that one kind of sensor reads:
    those kinds whose errors last for more than MANY_ROWS."""
    rows = search.rows
    assert rows.colour is not None
    decay = _decay(rows.colour)
    out = {}
    for kind in search.profile.sensors:
        read = [k for k, channel in enumerate(rows.channels) if channel in kind]
        if not read:
            continue
        count = 1 / (1 - float(decay[read].mean().clamp(max=MOST_DECAY)))  # the sum of the response to one new error
        if count > MANY_ROWS:
            out[tuple(search.system.states[rows.channels[k]].name for k in read)] = count * rows.period
    return out


def _decay(errors: Colour) -> Tensor:
    """(m,) sums of each channel's coefficients: 0 for white noise, near 1 for errors that last long."""
    return errors.coefficients.diagonal(dim1=1, dim2=2).sum(0)


def _errors_beside_set(search: Search, found: ScoredModel) -> Colour | None:
    """As `_errors_beside`, of a set that was fitted with correlated errors."""
    # From process noise that a load may need: that of the set is almost none.
    start = search.source.fits.log_process, search.source.fits.log_noise
    fits = replace(found.fits, log_process=start[0], log_noise=start[1])
    return _errors_beside(search, search.fit([(found.effects, fits)], CAREFUL)[0])


def _errors_beside(search: Search, found: ScoredModel) -> Colour | None:
    """The colour of errors of readings beside a set that was fitted with white noise, where these are clearly likelier
    than that noise, and than process noise."""
    quiet = replace(found, fits=search.without_process_noise([found])[0].fits)
    errors = colour_left_by(search, quiet, own=True)
    if errors is None or len(errors.coefficients) > MOST_LAGS:
        return None
    if int((_decay(errors) > 1 - 1 / MANY_ROWS).sum()) < FEWEST_SENSORS:
        return None
    likelihood = _likelihood(search, quiet, errors)
    if likelihood < float(found.fits.likelihood[0]) + CLEARLY:
        return None
    loads = colour_left_by(search, found, own=True)
    if loads is None:
        return errors
    more = (len(errors.coefficients) - len(loads.coefficients)) * len(search.rows.channels)
    return errors if likelihood - more > _likelihood(search, found, loads) + LEAD else None


def _likelihood(search: Search, found: ScoredModel, colour: Colour) -> float:
    """Log likelihood of a fitted set with noise of a colour."""
    model = CandidateModel(search.system, found.effects, replace(search.rows, colour=colour))
    return float(differentiate([model], found.fits).likelihood.sum())


def _not_such_errors(found: Search, best: ScoredModel) -> list[SmoothFunction]:
    """Functions added to the best set, the largest log odds first: those that are likelier than every error of a
    reading that depends on time alone, as slow errors of an estimator do; the least likely one where none is."""
    model = CandidateModel(found.system, best.effects, found.rows)
    functions = smooth_functions(model, best.fits, best.fits.state[0])
    slow = max((one.log_odds for one in functions if one.of_reading and one.variable == "time"), default=0.0)
    return [one for one in functions if one.log_odds > slow] or functions[-1:]

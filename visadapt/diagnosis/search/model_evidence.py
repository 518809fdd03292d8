"""The posterior odds of a fitted set of effects, by Laplace's approximation of its marginal likelihood."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from visadapt.estimation.fit_states import Effects, posterior, widths
from visadapt.estimation.likelihood import FitState

MAX_VARIANCE_RATIO = 0.1
"""Posterior over prior variance of a parameter, above which the recording counts as uninformative about it."""

PRIOR_DECADES = 3  # Decades over which the prior of a strength is spread

LOG_PRIOR_ODDS = -1.0  # Log prior odds that there is one more effect, shared evenly by all effects of the catalogue


def log_posterior_odds(effects: Effects, fits: FitState, catalogue: int) -> float:
    """Log posterior odds of a set, up to a constant; -inf where the recording is uninformative about an effect.

    The prior of a strength is uniform in its logarithm (Jeffreys), over PRIOR_DECADES and on either side of neutral;
    that of a shape is uniform in its range. `catalogue` is the number of effects searched. See MacKay (2003),
    Information Theory, Inference and Learning Algorithms, chapter 28.
    """
    table = [p for e in effects for p in e.table]
    if not math.isfinite(fits.likelihood[0]):
        return -math.inf  # a set whose fit ended in no numbers
    if not table:
        return float(fits.likelihood[0])
    width = widths(effects)
    precision, information = posterior(effects, fits)
    variance = torch.linalg.inv_ex(information).inverse.diagonal()
    if not bool((variance > 0).all()) or _uninformed(effects, fits, variance, precision):
        return -math.inf
    density = -width.log()
    for k, parameter in enumerate(table):
        if parameter.neutral is not None:
            size = max(abs(float(fits.theta[0, k]) - parameter.neutral), math.sqrt(float(variance[k])))
            sides = 1 + (parameter.low < parameter.neutral < parameter.high)
            density[k] = -math.log(sides * PRIOR_DECADES * math.log(10) * size)
    occam = (
        float(density.sum())
        + 0.5 * len(table) * math.log(2 * math.pi)
        - 0.5 * float(torch.linalg.slogdet(information)[1])
    )
    return float(fits.likelihood[0]) + min(0.0, occam) + len(effects) * (LOG_PRIOR_ODDS - math.log(max(1, catalogue)))


def _uninformed(effects: Effects, fits: FitState, variance: Tensor, precision: Tensor) -> bool:
    """Whether, for any effect, all strengths are within a standard deviation or two of neutral, or all of several
    shapes are undetermined, or a simpler effect does the same."""
    first = 0
    for effect in effects:
        if effect.is_simpler(fits.theta[0, first : first + len(effect.table)].tolist()):
            return True
        strengths, shapes = [], []
        several_shapes = sum(parameter.neutral is None for parameter in effect.table) > 1
        for k, parameter in enumerate(effect.table, first):
            undetermined = float(variance[k] * precision[k]) > MAX_VARIANCE_RATIO
            if parameter.neutral is None:
                shapes.append(undetermined)
            else:
                size = abs(float(fits.theta[0, k]) - parameter.neutral)
                # Of an effect for a moment, or in a narrow place, the recording shows force times width, and neither by
                # itself: a blow, which the report gives as a push.
                deviations = 2 if undetermined or several_shapes else 1
                strengths.append(size < deviations * math.sqrt(float(variance[k])))
        first += len(effect.table)
        # A single shape may be undetermined by trading off with another effect's strength: a spring's rest and a force.
        if (strengths and all(strengths)) or (len(shapes) > 1 and all(shapes)):
            return True
    return False

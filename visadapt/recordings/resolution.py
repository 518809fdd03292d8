"""The step of a sensor, from what it read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NEAR_MULTIPLES, FEWEST_MULTIPLES, MOST_STEPS_APART = 20, 20, 1024
"""A sensor's step is sought from differences of readings up to so many times the smallest, where there are at least so
many; the smallest is at most so many steps."""

MAX_REMAINDER = 0.1
"""Mean distance of differences from whole numbers of a sensor's steps, in steps; 0.25 by chance."""

ROUNDING_ERROR = 1e-6
"""In a reading's unit; smaller differences between readings come from arithmetic, such as wrapping an angle."""


def smallest_step(readings: NDArray[np.floating]) -> float:
    """A sensor's resolution: the largest step of which differences between readings (N,) are multiples; 0 if all
    readings are equal.

    Of a shaft that turns one way, no two readings may be as close as one step. Where no step shows, it is smaller than
    all that were tried.
    """
    apart = np.diff(np.unique(readings))
    apart = apart[apart > ROUNDING_ERROR]
    if not len(apart):
        return 0.0
    least = float(apart.min())
    near = apart[apart <= NEAR_MULTIPLES * least]
    if len(near) < FEWEST_MULTIPLES:
        return least
    tried = least / np.arange(1, MOST_STEPS_APART + 1)
    tried = tried[tried > 10 * ROUNDING_ERROR]
    multiples = near / tried[:, None]
    fits = np.abs(multiples - multiples.round()).mean(1) < MAX_REMAINDER
    if not len(tried):
        return least
    return float(tried[fits.argmax()] if fits.any() else tried[-1])

"""Runs of equal values."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray


def runs(values: NDArray[Any]) -> Iterator[tuple[int, int]]:
    """The first row and the one after the last of each run of equal values (T,).

    >>> list(runs(np.array([0.1, 0.1, 0.3])))
    [(0, 2), (2, 3)]
    """
    return pairwise([0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)])

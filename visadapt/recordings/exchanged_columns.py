"""Whether columns of a recording are exchanged: two states', or two commands', judged by the source physics."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.clock import RawEpisode
from visadapt.recordings.physics import (
    EXPLAINED_CORRELATION,
    EXPLAINED_ERROR,
    LONGEST_DELAY,
    OTHERS_ERROR_RATIO,
    Agreement,
    Columns,
    agreements,
    can_decide,
    period_of,
    unchanged,
    with_opposite,
)
from visadapt.systems import System

WEAKER, MOST_SIGNS = (0.3, 0.5, 0.7, 0.85), 5
"""Factors of one command that are tried before two are called exchanged, and how many may have the other sign."""


def exchanged(episodes: Sequence[RawEpisode], system: System, one: str, other: str) -> bool:
    """Whether the source explains both accelerations with two columns (and their rates) exchanged, and not as they are.

    A delayed command could look like that, so every delay up to `LONGEST_DELAY` is tried for the columns as
    they are. False where that cannot be decided.
    """
    if not can_decide(episodes, system, (one, other)):
        return False
    rate, other_rate = system.rate_of(one) or "", system.rate_of(other) or ""
    to = {one: other, other: one, rate: other_rate, other_rate: rate}

    def swapped(columns: Columns) -> Columns:
        return {to.get(name, name): values for name, values in columns.items()}

    def correlations(found: Mapping[str, Agreement]) -> tuple[float, float]:
        return found[one].correlation, found[other].correlation

    crossed = agreements(episodes, system, swapped)
    if not all(1 / 4 < crossed[name].slope < 4 for name in (one, other)):
        return False
    period = min(period_of(raw) for raw in episodes)
    latest = round(LONGEST_DELAY * system.prediction_time / period)
    as_given = [correlations(agreements(episodes, system, delay=k * period)) for k in range(latest + 1)]
    explained = min(correlations(crossed))
    return explained > EXPLAINED_CORRELATION and max(map(min, as_given)) < 0.7 * explained and max(as_given[0]) < 0


def exchanged_commands(episodes: Sequence[RawEpisode], system: System) -> tuple[str, str] | None:
    """Two commands of one unit with which the source explains every acceleration if they are exchanged, and not as they
    are, late, weaker or with other signs, nor with a joint's sign turned, as where exchanged wheels turn a robot the
    other way; None where there are none, or where that cannot be decided."""
    names = [variable.name for variable in system.states if system.rate_of(variable.name)]
    count = len(system.actions)
    pairs = [(i, k) for i, k in combinations(range(count), 2) if system.actions[i].unit == system.actions[k].unit]
    if not pairs or not can_decide(episodes, system, names):
        return None
    identity = np.eye(count)

    def error(
        commands: NDArray[np.float64] = identity,
        changed: Callable[[Columns], Columns] = unchanged,
        delay: float = 0.0,
    ) -> float:
        given = [replace(raw, action=raw.action @ commands) for raw in episodes]
        errors = [one.error for one in agreements(given, system, changed, delay).values()]
        return max(errors) if errors and all(map(math.isfinite, errors)) else math.inf

    there, (i, k) = min((error(_exchanging(count, *pair)), pair) for pair in pairs)

    def others() -> Iterator[float]:
        """Errors of all that is as simple; the first are those that are the quickest to tell."""
        for signs in product((1.0, -1.0), repeat=min(count, MOST_SIGNS)):
            yield error(np.diag(np.append(signs, np.ones(count - len(signs)))))
        for weak, factor in product(range(count), WEAKER):
            yield error(np.diag(np.where(np.arange(count) == weak, factor, 1.0)))
        for joint in system.coordinates:
            turned = {system.states[column].name for column in joint if column is not None}
            yield error(changed=partial(with_opposite, names=turned))
        period = min(period_of(raw) for raw in episodes)
        for late in range(1, 1 + round(LONGEST_DELAY * system.prediction_time / period)):
            yield error(delay=late * period)

    if not there < EXPLAINED_ERROR or any(not other > OTHERS_ERROR_RATIO * there for other in others()):
        return None
    return system.actions[i].name, system.actions[k].name


def _exchanging(count: int, i: int, k: int) -> NDArray[np.float64]:
    """The matrix that exchanges commands i and k of `count`."""
    out = np.eye(count)
    out[[i, k]] = out[[k, i]]
    return out

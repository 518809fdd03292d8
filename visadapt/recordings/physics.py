"""What the source physics says of a recording's columns: their unit, and whether two changed places.

The numbers alone often do not tell: 5 may be radians or degrees. But a command's effect on an angle is 57 times as
large in degrees, and a cart that is pushed accelerates the other way than its pole. So accelerations from second
differences are compared with the source's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from visadapt.recordings.clock import Rows
from visadapt.systems import System

DEGREE = math.pi / 180
STRIDE = 0.05
"""s between the three points of a second difference: closer ones would show noise rather than motion."""
LONGEST_DELAY = 0.25
"""s by which a command may act late."""
ROWS = 20_000
"""At most so many are looked at."""
EXPLAINED = 0.5
"""Correlation of seen and predicted accelerations above which the source explains them."""

Columns = Mapping[str, NDArray[np.float64]]


def are_degrees(rows: Rows, measured: Sequence[str], system: System) -> bool:
    """Whether the source explains the angle's acceleration if its unit is the degree, and not if it is the radian.

    False where nothing can be said: a command that never changes, a recording too short or too noisy, a system
    without just one angle.
    """
    angles = [variable.name for variable in system.states if variable.unit == "rad"]
    columns = _columns(rows, measured)
    if len(angles) != 1 or not _can_say(rows, system, angles):
        return False
    radians, radian_slope = _fits(rows, columns, system)[angles[0]]
    scaled = {name: values * (DEGREE if name.startswith(angles[0]) else 1) for name, values in columns.items()}
    degrees, slope = _fits(rows, scaled, system)[angles[0]]
    return degrees > EXPLAINED and 1 / 3 < slope < 3 and (degrees > radians + 0.2 or radian_slope > 10)


def changed_places(rows: Rows, measured: Sequence[str], system: System, one: str, other: str) -> bool:
    """Whether the source explains both accelerations with the columns (and their rates) exchanged, and not as they are.

    A command that acts late could look like that, so every delay up to `LONGEST_DELAY` is tried for the columns as
    they are. False where nothing can be said.
    """
    if not _can_say(rows, system, (one, other)):
        return False
    columns = _columns(rows, measured)
    to = {one: other, other: one, f"{one}_dot": f"{other}_dot", f"{other}_dot": f"{one}_dot"}
    exchanged = {to.get(name, name): values for name, values in columns.items()}
    fits = _fits(rows, exchanged, system)
    if not all(1 / 4 < fits[name][1] < 4 for name in (one, other)):
        return False
    period = float(np.median(np.diff(rows.time[:ROWS])))
    as_it_is = [_fits(rows, columns, system, late) for late in range(round(LONGEST_DELAY / period) + 1)]
    best = max(min(fits[one][0], fits[other][0]) for fits in as_it_is)
    explained = min(fits[one][0], fits[other][0])
    return explained > EXPLAINED and best < 0.7 * explained and max(as_it_is[0][one][0], as_it_is[0][other][0]) < 0


def _columns(rows: Rows, measured: Sequence[str]) -> Columns:
    return {name: values[:ROWS] for name, values in zip(measured, rows.state.T, strict=True)}


def _can_say(rows: Rows, system: System, names: Sequence[str]) -> bool:
    states = [variable.name for variable in system.states]
    return (
        all(f"{name}_dot" in states for name in names)
        and rows.time[min(len(rows.time), ROWS) - 1] - rows.time[0] > 40 * STRIDE
        and float(np.ptp(rows.action[:ROWS], axis=0).max()) > 0
    )


def _fits(rows: Rows, columns: Columns, system: System, late: int = 0) -> dict[str, tuple[float, float]]:
    """For each variable that has a rate: correlation of its acceleration with the source's, and slope over it.

    Args:
        rows: their clock and commands.
        columns: the measured states, in the unit and under the name to be tried.
        system: the source.
        late: rows by which the commands act late.
    """
    names = [variable.name for variable in system.states]
    angles = [variable.name for variable in system.states if variable.unit == "rad"]
    columns = {name: np.unwrap(values) if name in angles else values for name, values in columns.items()}
    time, action = rows.time[:ROWS], rows.action[:ROWS]
    period = float(np.median(np.diff(time)))
    stride = max(1, round(STRIDE / period))
    span = 2 * stride * period
    # Three points with equal weights: their noise is then uncorrelated with that of their second difference.
    middle = {
        name: (values[: -2 * stride] + values[stride:-stride] + values[2 * stride :]) / 3
        for name, values in columns.items()
    }
    for name, values in columns.items():
        middle.setdefault(f"{name}_dot", (values[2 * stride :] - values[: -2 * stride]) / span)
    # The mean command over the span.
    action = np.vstack([np.repeat(action[:1], late, axis=0), action[: len(action) - late]])
    kernel = np.ones(2 * stride) / (2 * stride)
    action = np.column_stack([np.convolve(column[:-1], kernel, "valid") for column in action.T])
    state = np.column_stack([middle[name] for name in names])
    load = torch.zeros(len(state), len(system.loads), dtype=torch.float64)
    predicted = system.derivative(torch.from_numpy(state), torch.from_numpy(action), load).numpy()
    fits = {}
    for name, values in columns.items():
        if f"{name}_dot" in names:
            seen = (values[2 * stride :] - 2 * values[stride:-stride] + values[: -2 * stride]) / (span / 2) ** 2
            fits[name] = _fit(seen, predicted[:, names.index(f"{name}_dot")])
    return fits


def _fit(seen: NDArray[np.float64], predicted: NDArray[np.float64]) -> tuple[float, float]:
    """Correlation and slope of what was seen over what was predicted."""
    if seen.std() == 0 or predicted.std() == 0:
        return 0.0, 0.0
    correlation = float(np.corrcoef(seen, predicted)[0, 1])
    return correlation, correlation * float(seen.std() / predicted.std())

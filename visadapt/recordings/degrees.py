"""Whether angles are in degrees, judged by the source physics: for small angles the numbers alone do not tell."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from visadapt.recordings.clock import Rows
from visadapt.systems import System

DEGREE = math.pi / 180
STRIDE = 0.1
"""s over which accelerations are taken from differences: over less, noise would outweigh motion."""
ROWS = 20_000
"""At most so many are looked at."""


def are_degrees(rows: Rows, measured: Sequence[str], system: System) -> bool:
    """Whether the source explains the angle's acceleration if its unit is the degree, and not if it is the radian.

    A command's effect on an angle is 57 times as large in degrees, and the sine of an angle in degrees is noise. So
    accelerations from second differences are compared with the source's, in both units. False where nothing can be
    said: a command that never changes, a recording too short or too noisy, a system without just one angle.
    """
    names = [variable.name for variable in system.states]
    angles = [variable.name for variable in system.states if variable.unit == "rad"]
    if len(angles) != 1 or angles[0] not in measured or f"{angles[0]}_dot" not in names:
        return False
    time, period = rows.time[:ROWS], float(np.median(np.diff(rows.time[:ROWS])))
    stride = max(1, round(STRIDE / period / 2))
    if len(time) < 10 * stride or np.ptp(rows.action[:ROWS], axis=0).max() == 0:
        return False
    columns = {name: values[:ROWS] for name, values in zip(measured, rows.state.T, strict=True)}
    # Three points with equal weights: noise is then uncorrelated with that of their second difference.
    middle = {
        name: (values[: -2 * stride] + values[stride:-stride] + values[2 * stride :]) / 3
        for name, values in columns.items()
    }
    span = 2 * stride * period
    for name, values in columns.items():
        if f"{name}_dot" in names and f"{name}_dot" not in columns:
            middle[f"{name}_dot"] = (values[2 * stride :] - values[: -2 * stride]) / span
    angle = columns[angles[0]]
    seen = (angle[2 * stride :] - 2 * angle[stride:-stride] + angle[: -2 * stride]) / (span / 2) ** 2
    state = np.column_stack([middle[name] for name in names])
    # The command that acts over the span, on average: rows t - stride to t + stride.
    kernel = np.ones(2 * stride) / (2 * stride)
    action = np.column_stack([np.convolve(column[: len(time) - 1], kernel, "valid") for column in rows.action[:ROWS].T])
    unit = np.array([DEGREE if variable.unit.startswith("rad") else 1.0 for variable in system.states])
    column = names.index(f"{angles[0]}_dot")
    radians = _fit(seen, _rate(system, state, action)[:, column])
    degrees = _fit(seen, _rate(system, state * unit, action)[:, column] / DEGREE)
    explained = degrees[0] > 0.5 and 1 / 3 < degrees[1] < 3
    return explained and (degrees[0] > radians[0] + 0.2 or radians[1] > 10)


def _rate(system: System, state: NDArray[np.float64], action: NDArray[np.float64]) -> NDArray[np.float64]:
    load = torch.zeros(len(state), len(system.loads), dtype=torch.float64)
    return system.derivative(torch.from_numpy(state), torch.from_numpy(action), load).numpy()


def _fit(seen: NDArray[np.float64], predicted: NDArray[np.float64]) -> tuple[float, float]:
    """Correlation and slope of what was seen over what was predicted."""
    if seen.std() == 0 or predicted.std() == 0:
        return 0.0, 0.0
    correlation = float(np.corrcoef(seen, predicted)[0, 1])
    return correlation, correlation * float(seen.std() / predicted.std())

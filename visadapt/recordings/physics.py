"""Units and order of a recording's columns, judged by the source physics.

The numbers alone often do not decide: 5 may be radians or degrees. But a command's effect on an angle is 57 times as
large in degrees, and a cart that is pushed accelerates opposite to its pole. So accelerations, which are second
differences of positions or differences of measured rates, are compared with the source's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from visadapt.recordings.clock import RawEpisode
from visadapt.systems import System

DEGREE = math.pi / 180
DIFFERENCE = 0.1
"""Prediction times between rows whose difference is taken: over less, noise would outweigh motion."""
LONGEST_DELAY = 0.5
"""Longest delay of the command, in prediction times, that is tried before columns are called exchanged."""
LEAST_DURATION = 4.0
"""Prediction times that the episodes must last together for their units and order to be judged."""
MOST_ROWS = 20_000
"""Rows of an episode that are used, for speed."""
EXPLAINED_ERROR, OTHERS_ERROR_RATIO = 0.75, 1.5
"""Mean square error of predicted accelerations, as a share of the measured ones' mean square, below which an angle with
another zero or sign explains these; and how many times as large the error of the angle as it is must be."""
EXPLAINED_CORRELATION = 0.5
"""Correlation of measured and predicted accelerations above which the source explains them."""

TURNS = ("omega_x", "omega_y", "omega_z")
"""Rates of turn of a vehicle, which are no variable's rate, and whose changes are judged as accelerations are."""

Columns = Mapping[str, NDArray[np.float64]]


class Agreement(NamedTuple):
    """How measured accelerations follow those that the source predicts."""

    correlation: float
    slope: float  # of the measured over the predicted; 0 where either never changes

    @property
    def opposite(self) -> Agreement:
        """That of a variable with the other sign."""
        return Agreement(-self.correlation, -self.slope)

    @property
    def error(self) -> float:
        """Mean square of what the prediction misses, over that of the measured values."""
        size = self.correlation / self.slope if self.slope else 0.0  # of the predicted over the measured values
        return 1 - 2 * self.correlation * size + size**2


def same_after_a_turn(system: System, name: str) -> bool:
    """Whether the source's physics are the same a whole turn further in an angle: not so for a drum on a spring."""
    generator = torch.Generator().manual_seed(0)
    low = torch.tensor([state.low for state in system.states]).double()
    high = torch.tensor([state.high for state in system.states]).double()
    state = low + (high - low) * torch.rand(8, len(low), generator=generator, dtype=torch.float64)
    action = state.new_zeros(len(state), len(system.actions))
    load = state.new_zeros(len(state), len(system.loads))
    further = state.clone()
    further[:, system.index(name)] += 2 * math.pi
    here, there = system.derivative(state, action, load), system.derivative(further, action, load)
    return torch.allclose(here, there, rtol=1e-6, atol=1e-9)


def are_degrees(episodes: Sequence[RawEpisode], system: System) -> bool:
    """Whether the source explains the angle's acceleration if the angle is in degrees, and does not if in radians.

    False where that cannot be decided: the command never changes, the episodes of a file are together too short or too
    noisy, a velocity is neither measured nor a position's rate, or the system does not have exactly one angle.
    """
    if (angle := _only_angle(episodes, system)) is None:
        return False
    angular = (angle, system.rate_of(angle))

    def scaled(columns: Columns) -> Columns:
        return {name: values * (DEGREE if name in angular else 1) for name, values in columns.items()}

    radians, degrees = agreements(episodes, system)[angle], agreements(episodes, system, scaled)[angle]
    explained = degrees.correlation > EXPLAINED_CORRELATION and 1 / 3 < degrees.slope < 3
    return explained and (degrees.correlation > radians.correlation + 0.2 or radians.slope > 10)


def is_half_a_turn_off(episodes: Sequence[RawEpisode], system: System) -> bool:
    """Whether the source explains the angle's acceleration half a turn further, and neither as it is nor with the other
    sign; False where that cannot be decided, as in `are_degrees`."""
    if (angle := _only_angle(episodes, system)) is None:
        return False
    rate = system.rate_of(angle)

    def further(columns: Columns) -> Columns:
        return {name: values + math.pi if name == angle else values for name, values in columns.items()}

    negated = partial(with_opposite, names=(angle, rate or angle))

    def error(changed: Callable[[Columns], Columns]) -> float:
        return agreements(episodes, system, changed)[angle].error

    there = error(further)
    return there < EXPLAINED_ERROR and all(
        error(changed) > OTHERS_ERROR_RATIO * there for changed in (unchanged, negated)
    )


def is_turned_round(episodes: Sequence[RawEpisode], system: System, name: str) -> bool:
    """Whether the source explains a variable's acceleration with the other sign, and not as it is; False where that
    cannot be decided, as in `are_degrees`."""
    if not can_decide(episodes, system, [name]):
        return False
    found = agreements(episodes, system)[name]
    there = found.opposite.error
    return there < EXPLAINED_ERROR and found.error > OTHERS_ERROR_RATIO * there


def is_in_newtons(episodes: Sequence[RawEpisode], system: System, largest: float) -> bool:
    """Whether a command that stays within [-1, 1] moves the system as a force in N does, instead of as a share of the
    `largest` force in N; False where that cannot be decided."""
    names = [variable.name for variable in system.states if system.rate_of(variable.name)]
    if not can_decide(episodes, system, names):
        return False
    found = agreements(episodes, system).values()
    slopes = [one.slope for one in found if one.correlation > EXPLAINED_CORRELATION]
    return bool(slopes) and all(1 / 3 < slope * largest < 3 for slope in slopes)


def _only_angle(episodes: Sequence[RawEpisode], system: System) -> str | None:
    """The system's angle, by which its unit and zero are judged; None where it has none or several, or where that
    cannot be decided."""
    angles = [variable.name for variable in system.states if variable.unit == "rad"]
    return angles[0] if len(angles) == 1 and can_decide(episodes, system, angles) else None


def can_decide(episodes: Sequence[RawEpisode], system: System, names: Sequence[str]) -> bool:
    """Whether episodes are long enough, their commands change, and all states are known, to judge these variables."""
    judged = judged_episodes(episodes, system)
    duration = sum(float(raw.time[:MOST_ROWS][-1] - raw.time[0]) for raw in judged)
    measured = episodes[0].measured
    known = {*measured, *(system.rate_of(name) for name in measured)}
    return (
        all(system.rate_of(name) for name in names)
        and known >= {state.name for state in system.states}
        and duration > LEAST_DURATION * system.prediction_time
        and float(np.ptp(np.vstack([raw.action[:MOST_ROWS] for raw in judged]), axis=0).max()) > 0
    )


def judged_episodes(episodes: Sequence[RawEpisode], system: System) -> list[RawEpisode]:
    """The episodes that are long enough for second differences after the longest delay."""
    latest = LONGEST_DELAY * system.prediction_time
    return [raw for raw in episodes if len(raw.time) > 2 * rows_apart(raw, system) + 1 + round(latest / period_of(raw))]


def period_of(raw: RawEpisode) -> float:
    """s between the rows of an episode, in the median."""
    return float(np.median(np.diff(raw.time[:MOST_ROWS])))


def rows_apart(raw: RawEpisode, system: System) -> int:
    """Rows between those whose difference is taken."""
    return max(1, round(DIFFERENCE * system.prediction_time / period_of(raw)))


def unchanged(columns: Columns) -> Columns:
    """The columns as they are."""
    return columns


def with_opposite(columns: Columns, names: Collection[str]) -> Columns:
    """Columns of which some have the other sign."""
    return {name: -values if name in names else values for name, values in columns.items()}


def agreements(
    episodes: Sequence[RawEpisode],
    system: System,
    changed: Callable[[Columns], Columns] = unchanged,
    delay: float = 0.0,
) -> dict[str, Agreement]:
    """For each variable with a rate, and each rate or speed of no variable: how its acceleration follows the source's.

    `changed` gives the measured states the units and names to be tried; `delay` is by how many s the commands
    act late.
    """
    found = _of_all(episodes, system, changed, delay)
    return {name: _agreement(measured, predicted) for name, (measured, predicted) in found.items()}


def missed(episodes: Sequence[RawEpisode], system: System, names: Sequence[str]) -> list[float]:
    """For each of some variables, the mean square of what the source's accelerations miss of the measured ones, offsets
    included; of those by rates, where these are measured."""
    found = _of_all(episodes, system)
    return [float(np.square(found[name][0][-1] - found[name][1]).mean()) for name in names]


def _of_all(
    episodes: Sequence[RawEpisode],
    system: System,
    changed: Callable[[Columns], Columns] = unchanged,
    delay: float = 0.0,
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """As `_accelerations`, of all episodes that are judged, one after the other."""
    each = []
    for raw in judged_episodes(episodes, system):
        columns = changed({name: values[:MOST_ROWS] for name, values in raw.states.items()})
        each.append(_accelerations(raw, columns, system, delay))
    return {
        name: (
            np.concatenate([one[name][0] for one in each], axis=-1),
            np.concatenate([one[name][1] for one in each], axis=-1),
        )
        for name in each[0]
    }


def _accelerations(
    raw: RawEpisode, columns: Columns, system: System, delay: float
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Of an episode of T rows, by name of each variable with a rate: accelerations (1 or 2, T) from its readings and
    from those of its rate, and accelerations (T,) as predicted."""
    names = [variable.name for variable in system.states]
    angles = [variable.name for variable in system.states if variable.unit == "rad"]
    columns = {name: np.unwrap(values) if name in angles else values for name, values in columns.items()}
    action = raw.action[:MOST_ROWS]
    stride = rows_apart(raw, system)
    span = 2 * stride * period_of(raw)
    # The mean of three points has noise that is uncorrelated with that of their second difference.
    middle = {
        name: (values[: -2 * stride] + values[stride:-stride] + values[2 * stride :]) / 3
        for name, values in columns.items()
    }
    rates = {name: rate for name in columns if (rate := system.rate_of(name))}
    for name, rate in rates.items():
        middle.setdefault(rate, (columns[name][2 * stride :] - columns[name][: -2 * stride]) / span)
    # The mean command over the span.
    late = round(delay / period_of(raw))
    action = np.vstack([np.repeat(action[:1], late, axis=0), action[: len(action) - late]])
    kernel = np.ones(2 * stride) / (2 * stride)
    action = np.column_stack([np.convolve(column[:-1], kernel, "valid") for column in action.T])
    state = np.column_stack([middle[name] for name in names])
    load = torch.zeros(len(state), len(system.loads), dtype=torch.float64)
    predicted = system.derivative(torch.from_numpy(state), torch.from_numpy(action), load).numpy()
    found = {}
    for name, rate in rates.items():
        values = columns[name]
        measured = [(values[2 * stride :] - 2 * values[stride:-stride] + values[: -2 * stride]) / (span / 2) ** 2]
        if rate in columns:
            measured.append((columns[rate][2 * stride :] - columns[rate][: -2 * stride]) / span)
        found[name] = np.stack(measured), predicted[:, names.index(rate)]
    # The speeds of joints without a position are judged as a vehicle's rates of turn are.
    speeds = {names[velocity] for position, velocity in system.coordinates if position is None}
    for name in sorted({*TURNS, *speeds} & {*columns}):
        measured = [(columns[name][2 * stride :] - columns[name][: -2 * stride]) / span]
        found[name] = np.stack(measured), predicted[:, names.index(name)]
    return found


def _agreement(measured: NDArray[np.float64], predicted: NDArray[np.float64]) -> Agreement:
    """How the less noisy of the measured accelerations (1 or 2, T) follow those that are predicted (T,)."""
    found = [correlation(one, predicted) for one in measured]
    best = int(np.abs(found).argmax())
    return Agreement(found[best], found[best] * float(measured[best].std() / predicted.std()) if found[best] else 0.0)


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Correlation coefficient of two columns (T,); 0 where one of them never changes."""
    return 0.0 if a.std() == 0 or b.std() == 0 else float(np.corrcoef(a, b)[0, 1])

"""Checks of a vehicle's attitude and body rates."""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray

from visadapt.recordings.clock import RawEpisode
from visadapt.recordings.episode import MisreadError
from visadapt.recordings.physics import DEGREE, correlation
from visadapt.systems import System
from visadapt.systems.rigid_body import ATTITUDE, RATES, RigidBody, continuous_quaternion, quaternion_rate

MOST_OFF_UNIT = 0.1
"""Largest distance of a quaternion's length from 1: of what is measured with noise, it is far less."""
TURNS_CORRELATION, OTHER_CORRELATION = 0.6, 0.3
"""Correlation of the attitude's change with that by the body rates above which these explain it, and below which they
do not."""


def check_attitude(raw: RawEpisode, system: System) -> None:
    """Check the quaternion and the body rates of an episode of a vehicle.

    Raises:
        MisreadError: the quaternion has not the length 1, its numbers are in another order, it rotates the world into
            the body, or the rates are in deg/s.
    """
    if not isinstance(system, RigidBody):
        return
    attitude, rates = _columns(raw, system, ATTITUDE), _columns(raw, system, RATES)
    length = np.linalg.norm(attitude, axis=1)
    row = int(np.abs(length - 1).argmax())
    first = system.states[ATTITUDE][0].name
    if abs(length[row] - 1) > MOST_OFF_UNIT:
        raise MisreadError(
            f"{raw.cell(row, first)}: the quaternion's length is {length[row]:.3g}; a unit quaternion is right"
        )
    fit, slope = _turning(raw, attitude, rates)
    if fit > TURNS_CORRELATION and 0.5 < slope * DEGREE < 2:
        right = "rad/s are right (these look like degrees per second)"
        raise MisreadError(f"{raw.origin}: the body rates are {slope:.0f} times what the attitude says; {right}")
    if fit < -TURNS_CORRELATION:
        raise MisreadError(
            f"{raw.origin}: the attitude turns against the body rates; a quaternion that rotates body into world axes "
            "is right"
        )
    if fit < OTHER_CORRELATION:
        _check_order(raw, first, attitude, rates)


def _check_order(raw: RawEpisode, first: str, attitude: NDArray[np.float64], rates: NDArray[np.float64]) -> None:
    """Raises MisreadError where a quaternion, which does not turn by the body rates, does so in another order of its
    numbers; `first` names its scalar."""
    ordered = np.roll(attitude, 1, axis=1)
    if _turning(raw, ordered, rates)[0] > TURNS_CORRELATION:
        raise MisreadError(
            f"{raw.origin}: the attitude's numbers are in the order x, y, z, w; {first}, the scalar, first is right"
        )
    signs = [np.array(each) for each in product((1, -1), repeat=3)]
    if max(_turning(raw, attitude, rates * each)[0] for each in signs) > TURNS_CORRELATION:
        return  # the order is right, whatever the signs of the rates are
    if max(_turning(raw, ordered * [1, *each], rates)[0] for each in signs) > TURNS_CORRELATION:
        raise MisreadError(
            f"{raw.origin}: the attitude's numbers are in another order than w, x, y, z; {first}, the scalar, first is "
            "right"
        )


def _columns(raw: RawEpisode, system: System, columns: slice) -> NDArray[np.float64]:
    """(T, n) of states, which a recording of a vehicle must have."""
    return np.column_stack([raw.states[state.name] for state in system.states[columns]])


def _turning(raw: RawEpisode, attitude: NDArray[np.float64], rates: NDArray[np.float64]) -> tuple[float, float]:
    """Correlation of the attitude's change between rows with that by the body rates, and how many times as large the
    latter is."""
    quaternion = continuous_quaternion(torch.from_numpy(attitude)).numpy()
    change = np.diff(quaternion, axis=0) / np.diff(raw.time)[:, None]
    middle = [torch.from_numpy((each[1:] + each[:-1]) / 2) for each in (quaternion, rates)]
    expected = quaternion_rate(*middle).numpy()
    fit = correlation(change.ravel(), expected.ravel())
    return fit, float(expected.std() / change.std()) if fit else 0.0

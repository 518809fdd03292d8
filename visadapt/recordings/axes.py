"""Axes of a vehicle's columns and signs of its commands: whether the source explains its motion with other ones."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.clock import RawEpisode
from visadapt.recordings.episode import MisreadError
from visadapt.recordings.physics import (
    EXPLAINED_ERROR,
    TURNS,
    Columns,
    agreements,
    can_decide,
    judged_episodes,
    missed,
    with_opposite,
)
from visadapt.systems import RigidBody, System

Floats = NDArray[np.floating]

TO_RIGHT = ("y", "y_dot", "q_y", "q_z", "omega_y", "omega_z")
"""States of opposite sign in axes forward, left and up and axes forward, right and down, but for z."""

TURNED = {
    "north, east and down": (*TO_RIGHT, "z", "z_dot"),
    "north, east and up, and the attitude's forward, right and down": TO_RIGHT,
}
"""States of the opposite sign, by where the axes of a recording point by mistake."""

QUARTER = {"x": "y", "x_dot": "y_dot", "y": "x", "y_dot": "x_dot"}
"""Positions in axes east and north beside an attitude whose axes are north and west: x is -y there, and y is x."""

OTHER_ERROR_RATIO = 2.0
"""How many times as large as in other axes, or with other signs, the error of predicted accelerations must be in those
of the recording, where the others explain them."""

AS_IT_IS, GAIN, GAINS = 10.0, 3.0, np.linspace(0.2, 1.5, 27)
"""How many times as large, where a command is in truth recorded from 0 to 1, the mean square of the accelerations
missed along an axis must be with the command as it is, and with the best of these gains of its actuator."""


def check_axes(episodes: Sequence[RawEpisode], system: System) -> None:
    """Raises MisreadError where the source explains a vehicle's motion far better in other axes, or with other signs
    of its commands."""
    if not isinstance(system, RigidBody) or not can_decide(episodes, system, "xyz"):
        return
    origin = episodes[0].origin
    as_it_is = _error(episodes, system, "xyz")
    others = {axes: _error(episodes, system, "xyz", opposite) for axes, opposite in TURNED.items()}
    axes = min(others, key=others.__getitem__)
    quarter = _error(episodes, system, "xyz", ("x", "x_dot"), quarter=True)
    if _explains(min(others[axes], quarter), as_it_is):
        if quarter < others[axes]:
            wrong = "the axes of x and y pointed east and north, and the attitude's north and west"
            right = "y for x, and x with the other sign for y, and their rates"
        else:
            wrong = f"its axes pointed {axes}"
            states = [name for name in TURNED[axes] if name in episodes[0].measured]
            right = f"{', '.join((*states, *_opposite_commands(episodes, system, TURNED[axes])))} with the other sign"
        raise MisreadError(
            f"{origin}: it moves as if {wrong}; forward, left and up are right: {right} (--columns NAME=COLUMN*-1,...)"
        )
    if share := _recorded_from_0_to_1(episodes, system):
        raise MisreadError(
            f"{origin}: {share} is never negative, and it moves as if {share} went from 0 to 1; from -1 to 1 is right "
            f"(--columns {share}=COLUMN*2-1)"
        )
    if opposite := _opposite_commands(episodes, system):
        raise MisreadError(
            f"{origin}: it turns as if {' and '.join(opposite)} had the other sign "
            f"(--columns {','.join(f'{name}=COLUMN*-1' for name in opposite)})"
        )


def _recorded_from_0_to_1(episodes: Sequence[RawEpisode], system: System) -> str | None:
    """A command in the range [-1, 1] that is recorded from 0 to 1, as a throttle often is: it is never negative, and
    the source explains how the vehicle moves along an axis far better so than with a weaker or a stronger actuator."""
    judged = judged_episodes(episodes, system)
    for column, action in enumerate(system.actions):
        if (action.low, action.high) != (-1, 1) or min(raw.action[:, column].min() for raw in judged) < 0:
            continue
        this = np.arange(len(system.actions)) == column
        # From 0 to 1 first, then from -1 to 1 as it is, then with each gain.
        scales = [(2.0, -1.0), (1.0, 0.0), *((gain, gain - 1) for gain in GAINS)]
        scaled = (_scaled(judged, np.where(this, factor, 1), this * offset) for factor, offset in scales)
        errors = np.array([missed(each, system, "xyz") for each in scaled])
        as_share, as_it_is, with_gain = errors[0], errors[1], errors[2:].min(0)
        if ((as_it_is > AS_IT_IS * as_share) & (with_gain > GAIN * as_share)).any():
            return action.name
    return None


def _scaled(episodes: Sequence[RawEpisode], factors: Floats, offsets: Floats | float = 0.0) -> list[RawEpisode]:
    """The episodes with each of their commands times a factor, plus an offset."""
    return [replace(raw, action=factors * raw.action + offsets) for raw in episodes]


def _opposite_commands(
    episodes: Sequence[RawEpisode], system: System, opposite: Collection[str] = ()
) -> tuple[str, ...]:
    """The commands with whose other sign the source explains far better how the vehicle turns, where the states that
    are `opposite` have it too; none where that cannot be decided."""
    errors = {
        names: _error(_with_opposite(episodes, system, names), system, TURNS, opposite) for names in _sets(system)
    }
    best = min(errors, key=errors.__getitem__)
    return best if _explains(errors[best], errors[()]) else ()


def _sets(system: System) -> Iterator[tuple[str, ...]]:
    """Every set of commands, the smallest first."""
    names = [action.name for action in system.actions]
    return (each for count in range(len(names) + 1) for each in combinations(names, count))


def _with_opposite(episodes: Sequence[RawEpisode], system: System, commands: Collection[str]) -> list[RawEpisode]:
    """The episodes with these commands of the opposite sign."""
    return _scaled(episodes, np.array([-1.0 if action.name in commands else 1.0 for action in system.actions]))


def _explains(error: float, as_it_is: float) -> bool:
    return error <= EXPLAINED_ERROR and as_it_is >= OTHER_ERROR_RATIO * error


def _error(
    episodes: Sequence[RawEpisode],
    system: System,
    names: Sequence[str],
    opposite: Collection[str] = (),
    quarter: bool = False,
) -> float:
    """The error of predicted accelerations, mean over the variables `names`, with the `opposite` sign of some columns,
    then turned by a quarter or not."""

    def changed(columns: Columns) -> Columns:
        signed = with_opposite(columns, opposite)
        return {QUARTER.get(name, name) if quarter else name: values for name, values in signed.items()}

    found = agreements(episodes, system, changed)
    return sum(found[name].error for name in names) / len(names)

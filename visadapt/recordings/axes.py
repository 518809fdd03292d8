"""Axes of a vehicle's columns: whether the source explains its accelerations in other axes, and not in its own."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from visadapt.recordings.clock import RawEpisode
from visadapt.recordings.episode import RecordingError
from visadapt.recordings.physics import Columns, agreements, can_decide
from visadapt.systems import RigidBody, System

TO_RIGHT = ("y", "y_dot", "q_y", "q_z", "omega_y", "omega_z", "rate_y", "rate_z")
"""States and commands of opposite sign in axes forward, left and up and axes forward, right and down, but for z."""

TURNED = {
    "north, east and down": (*TO_RIGHT, "z", "z_dot"),
    "north, east and up, and the attitude's forward, right and down": TO_RIGHT,
}
"""States and commands of the opposite sign, by where the axes of a recording point by mistake."""

QUARTER = {"x": "y", "x_dot": "y_dot", "y": "x", "y_dot": "x_dot"}
"""Positions in axes east and north beside an attitude whose axes are north and west: x is -y there, and y is x."""

EXPLAINED_ERROR, OTHER_ERROR_RATIO = 0.75, 2.0
"""Mean over the axes of the error of predicted accelerations (`Agreement.error`) below which other axes explain them;
and how many times as large it must be in the axes as they are."""


def check_axes(episodes: Sequence[RawEpisode], system: System) -> None:
    """Raises RecordingError where the source explains a vehicle's motion far better in other axes."""
    if not isinstance(system, RigidBody) or not can_decide(episodes, system, "xyz"):
        return
    as_it_is = _error(episodes, system, ())
    others = {axes: _error(episodes, system, opposite) for axes, opposite in TURNED.items()}
    axes = min(others, key=others.__getitem__)
    quarter = _error(episodes, system, ("x", "x_dot"), quarter=True)
    least = min(others[axes], quarter)
    if least > EXPLAINED_ERROR or as_it_is < OTHER_ERROR_RATIO * least:
        return
    known = {*episodes[0].measured, *(action.name for action in system.actions)}
    if quarter == least:
        wrong = "the axes of x and y pointed east and north, and the attitude's north and west"
        right = "y for x, and x with the other sign for y, and their rates"
    else:
        wrong = f"its axes pointed {axes}"
        right = f"{', '.join(name for name in TURNED[axes] if name in known)} with the other sign"
    raise RecordingError(
        f"{episodes[0].origin}: it moves as if {wrong}; forward, left and up are right: {right} "
        "(--columns NAME=COLUMN*-1,...)"
    )


def _error(episodes: Sequence[RawEpisode], system: System, opposite: Collection[str], quarter: bool = False) -> float:
    """The error of predicted accelerations, mean over the axes, with the `opposite` sign of some columns, then turned
    by a quarter or not."""

    def changed(columns: Columns) -> Columns:
        signed = {name: -values if name in opposite else values for name, values in columns.items()}
        return {QUARTER.get(name, name) if quarter else name: values for name, values in signed.items()}

    found = agreements(episodes, system, changed)
    return sum(found[name].error for name in "xyz") / 3

"""Which column of a file is which variable: by our names, by other common names, or by the user's mapping."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

from visadapt.recordings.episode import RecordingError
from visadapt.systems import System

LOG = logging.getLogger(__name__)

CLOCK_NAMES = {"time": ("t", "timestamp"), "episode": ()}
"""Other common names of the columns that every system has."""

VARIABLE_NAMES: dict[str, dict[str, tuple[str, ...]]] = {
    "cartpole": {
        "x": ("position", "cart_position", "pos", "s"),
        "x_dot": ("positionD", "velocity", "cart_velocity"),
        "theta": ("angle", "pole_angle"),
        "theta_dot": ("angleD", "angular_velocity"),
        "command": ("action", "u", "Q", "control", "input", "force"),
    }
}
"""Other common names of a system's variables, in any case."""

FORCE_NAME = "force"
"""A command column of this name may be in N."""


def needed(system: System) -> tuple[str, ...]:
    """Columns that a recording must have: time, actions and states; rates of change (`_dot`) may be missing."""
    names = {variable.name for variable in system.states}
    states = [name for name in names if name.removesuffix("_dot") == name or name.removesuffix("_dot") not in names]
    ordered = [variable.name for variable in system.states if variable.name in states]
    return ("time", *ordered, *(variable.name for variable in system.actions))


def match(path: Path, header: tuple[str, ...], system: System, given: Mapping[str, str]) -> dict[str, int]:
    """The index of each of our variables in a file's header; `given` maps our names to the file's.

    Raises:
        RecordingError: a needed column is missing, several columns could be one variable, or `given` names a variable
            or a column that does not exist.
    """
    lower = [name.lower() for name in header]
    others = CLOCK_NAMES | VARIABLE_NAMES.get(system.name, {})
    ours = ["episode", "time", *(variable.name for variable in (*system.states, *system.actions))]
    for name in given:
        if name not in ours:
            raise RecordingError(f"--columns {name}=...: {system.name} has no {name!r}; it has {', '.join(ours)}")
    found: dict[str, int] = {}
    for name in ours:
        wanted = [given[name]] if name in given else [name]
        candidates = [index for index, there in enumerate(lower) if there == wanted[0].lower()]
        if not candidates and name not in given:
            synonyms = {other.lower() for other in others.get(name, ())}
            candidates = [index for index, there in enumerate(lower) if there in synonyms]
        if len(candidates) > 1:
            which = ", ".join(repr(header[index]) for index in candidates)
            raise RecordingError(f"{path}: the columns {which} could each be {name}; say which: --columns {name}=...")
        if candidates:
            found[name] = candidates[0]
        elif name in given:
            raise RecordingError(f"{path}: has no column {given[name]!r} for {name}; it has {', '.join(header)}")
        elif name in needed(system):
            raise RecordingError(
                f"{path}: column {name!r} is missing; it has {', '.join(header)}; "
                f"if one of them is {name}: --columns {name}=..."
            )
    ignored = [there for index, there in enumerate(header) if index not in found.values()]
    if ignored:
        LOG.debug("%s: columns not used: %s", path, ", ".join(ignored))
    return found

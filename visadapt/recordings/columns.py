"""Which column of a file is which of our variables: by our own names, by well-known others, or as the user says."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

from visadapt.recordings.episode import RecordingError
from visadapt.systems import System

LOG = logging.getLogger(__name__)

CLOCK = {"time": ("t", "timestamp"), "episode": ()}
"""Other names of the columns that every system has."""

OTHER_NAMES: dict[str, dict[str, tuple[str, ...]]] = {
    "cartpole": {
        "x": ("position", "cart_position", "pos", "s"),
        "x_dot": ("positionD", "velocity", "cart_velocity"),
        "theta": ("angle", "pole_angle"),
        "theta_dot": ("angleD", "angular_velocity"),
        "command": ("action", "u", "Q", "control", "input", "force"),
    }
}
"""Other names of a system's variables; compared without regard to case."""

FORCE = "force"
"""A command's column of this name may be in N."""


def needed(system: System) -> tuple[str, ...]:
    """What a recording must have: the clock, the actions, and the states; rates of change (`_dot`) may be missing."""
    names = {variable.name for variable in system.states}
    states = [name for name in names if name.removesuffix("_dot") == name or name.removesuffix("_dot") not in names]
    ordered = [variable.name for variable in system.states if variable.name in states]
    return ("time", *ordered, *(variable.name for variable in system.actions))


def match(path: Path, header: tuple[str, ...], system: System, given: Mapping[str, str]) -> dict[str, int]:
    """The index of each of our variables in a file's header; `given` maps our names to the file's.

    Raises:
        RecordingError: a needed column is missing, a name is there twice or could be two things, or `given` names
            what neither side has.
    """
    lower = [name.lower() for name in header]
    others = CLOCK | OTHER_NAMES.get(system.name, {})
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

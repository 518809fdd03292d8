"""Which column of a recording is which variable: the names that are recognised, the states that may be missing, and
how a column's numbers become ours."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from visadapt.recordings.episode import RecordingError
from visadapt.systems import RigidBody, System

OTHER_NAMES: dict[str, dict[str, tuple[str, ...]]] = {
    "cartpole": {
        "x": ("position", "cart_position", "pos", "s"),
        "x_dot": ("positionD", "velocity", "cart_velocity"),
        "theta": ("angle", "pole_angle"),
        "theta_dot": ("angleD", "angular_velocity"),
        "command": ("action", "u", "Q", "control", "input", "force"),
    }
}
"""Other common names of a system's variables; upper and lower case are the same."""

EULER = {"roll", "pitch", "yaw", "phi", "psi"}
"""Names of an attitude's angles, in lower case, which are not read."""

AS_QUATERNION = (
    "; an attitude is read as a quaternion, from body to world: q_x, q_y, q_z, q_w = "
    "scipy.spatial.transform.Rotation.from_euler('ZYX', [yaw, pitch, roll]).as_quat(), with angles in rad"
)


_NUMBER = r"\s*-?(?:pi|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*"
_FACTORS = rf"(?:[*/]{_NUMBER})*"
_CONVERSION = rf"\s*(?P<factor>{_FACTORS})(?P<offset>(?:[+-]{_NUMBER}{_FACTORS})?)"


@dataclass(frozen=True)
class Column:
    """A column of a file, and how its numbers are converted to our units: number * factor + offset."""

    name: str
    factor: float = 1.0
    offset: float = 0.0

    def converted(self, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        """The numbers (T,) in our units."""
        return numbers if (self.factor, self.offset) == (1.0, 0.0) else numbers * self.factor + self.offset


def read_column(text: str, names: Collection[str] = ()) -> Column:
    """The column that a user names, perhaps with a conversion behind its name; `names` are those of the file, which may
    look like one, so that the longest of them is taken.

    Raises:
        RecordingError: the factor is 0 or not finite.

    >>> read_column("encoder*2*pi/4096-pi")
    Column(name='encoder', factor=0.0015339807878856412, offset=-3.141592653589793)
    >>> read_column("/motor/command.data")
    Column(name='/motor/command.data', factor=1.0, offset=0.0)
    """
    known = (name for name in sorted(names, key=len, reverse=True) if text.lower().startswith(name.lower()))
    any_name = r"\s*\S.*?"
    for name in (*map(re.escape, known), any_name):
        if found := re.fullmatch(rf"(?P<name>{name}){_CONVERSION}", text, re.IGNORECASE):
            break
    else:
        return Column(text)
    factor, offset = _product(found["factor"]), _product(found["offset"]) if found["offset"] else 0.0
    if not (math.isfinite(factor) and factor and math.isfinite(offset)):
        raise RecordingError(
            f"--columns ...={text}: times {factor:g} plus {offset:g}; finite numbers, the factor not 0, are right"
        )
    return Column(found["name"].strip(), factor, offset)


def _product(text: str) -> float:
    """The number that factors and divisors behind one another make: *2*pi/4096, or -pi/2."""
    product = -1.0 if text.startswith("-") else 1.0
    for operator, number in re.findall(rf"([*/]|^[+-])({_NUMBER})", text):
        sign, digits = (-1.0, number.strip()[1:]) if number.strip().startswith("-") else (1.0, number.strip())
        value = sign * (math.pi if digits == "pi" else float(digits))
        product = product * value if operator != "/" else product / value if value else math.inf
    return product


def needed(system: System) -> tuple[str, ...]:
    """Columns that a recording must have, unless --columns says that one was not measured: time, all states but
    velocities, and actions."""
    names = [variable.name for variable in system.states]
    rates = {system.rate_of(name) for name in names} | {names[velocity] for _, velocity in system.coordinates}
    return ("time", *(name for name in names if name not in rates), *(variable.name for variable in system.actions))


def may_be_unmeasured(system: System) -> list[str]:
    """States that a recording may lack where --columns says so: of a vehicle velocities alone."""
    states = [state.name for state in system.states]
    return [name for name in states if name not in needed(system)] if isinstance(system, RigidBody) else states


def check_given(given: Mapping[str, str], ours: Sequence[str], system: System) -> None:
    """Raises RecordingError where `given` maps a name that is none of `ours`, or leaves out what must be measured."""
    states, optional = [state.name for state in system.states], may_be_unmeasured(system)
    for name, theirs in given.items():
        if name not in ours:
            hint = AS_QUATERNION if isinstance(system, RigidBody) and name.lower() in EULER else ""
            raise RecordingError(f"--columns {name}=...: {system.name} has no {name!r}; it has {', '.join(ours)}{hint}")
        if not theirs and name not in optional:
            raise RecordingError(f"--columns {name}=: {name} is needed; --columns {name}=... names it")
    if all(given.get(name) == "" for name in states):
        raise RecordingError(f"--columns: one of {', '.join(states)} at least must be measured")


def match(
    path: Path, header: tuple[str, ...], system: System, given: Mapping[str, str], states: bool = True
) -> dict[str, int]:
    """The index of each of our variables in a file's header; `given` maps our names to the file's, or to "" where a
    state was not measured.

    Without `states` it has no states, as where frames are read in their place.

    Raises:
        RecordingError: a needed column is missing, several columns could be one variable, or `given` names a variable
            or a column that does not exist.
    """
    others = {"time": ("t", "timestamp"), **OTHER_NAMES.get(system.name, {})}
    wanted_states = [state.name for state in system.states] if states else []
    ours = ["episode", "time", *wanted_states, *(action.name for action in system.actions)]
    if unread := [state.name for state in system.states if not states and state.name in given]:
        raise RecordingError(f"--columns {unread[0]}=...: no states are read where frames are")
    check_given(given, ours, system)
    found: dict[str, int] = {}
    for name in ours:
        if given.get(name) == "":
            continue
        named = read_column(given[name], header).name if name in given else None
        candidates = _candidates(header, name, named, others.get(name, ()))
        if len(candidates) > 1:
            which = ", ".join(repr(header[index]) for index in candidates)
            ask = f"say which: --columns {name}=..."
            if len({header[index] for index in candidates}) < len(candidates):
                ask = "give them different names"
            raise RecordingError(f"{path}: the columns {which} could each be {name}; {ask}")
        if candidates:
            taken = next((other for other, index in found.items() if index == candidates[0]), None)
            if taken is not None:
                raise RecordingError(f"{path}: column {header[candidates[0]]!r} is taken for both {taken} and {name}")
            found[name] = candidates[0]
        elif name in given:
            form = f"; a conversion is COLUMN*FACTOR+OFFSET, as in {header[0]}*2*pi/4096-0.5"
            hint = form if re.search(r"[*/+()-]", given[name]) else ""
            raise RecordingError(f"{path}: has no column {named!r} for {name}; it has {', '.join(header)}{hint}")
        elif name in needed(system):
            raise RecordingError(
                f"{path}: column {name!r} is missing; it has {', '.join(header)}{_if_euler(name, header)}; "
                f"if one of them is {name}: --columns {name}=...{if_unmeasured(system, name)}"
            )
    return found


def _candidates(header: Sequence[str], name: str, given: str | None, others: Sequence[str]) -> list[int]:
    """The indices of the columns that may be our variable `name`: those called as `given`, or else by our name, or else
    by another common name. Upper and lower case are the same except in other names of one letter: t is the time, T a
    temperature."""

    def called(name: str) -> list[int]:
        return [index for index, there in enumerate(header) if there.lower() == name.lower()]

    if given is not None:
        return [index for index in called(given) if header[index] == given] or called(given)
    alias = [index for other in others for index in called(other) if len(other) > 1 or header[index] == other]
    return called(name) or sorted(alias)


def convert(
    values: Mapping[str, NDArray[np.float64]], given: Mapping[str, str], header: Sequence[str]
) -> dict[str, NDArray[np.float64]]:
    """Columns (T,) of a file with this header, by our names, in our units: converted as `given` says."""
    return {
        name: read_column(given[name], header).converted(numbers) if name in given else numbers
        for name, numbers in values.items()
    }


def _if_euler(name: str, header: Collection[str]) -> str:
    """What to say where a part of a quaternion is missing and the file has the angles of an attitude."""
    return AS_QUATERNION if name.startswith("q_") and EULER & {column.lower() for column in header} else ""


def if_unmeasured(system: System, name: str) -> str:
    """The end of a message that a column is missing: what to say where it is a state that was not measured."""
    return f"; if it was not measured: --columns {name}=" if name in may_be_unmeasured(system) else ""

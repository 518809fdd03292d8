"""A rig of one's own: the system's parameters, in a TOML file.

    [parameters]
    cart_mass = 0.230
    pole_mass = 0.087

Names and units are the system's own; what the file leaves out keeps the system's default.
"""

from __future__ import annotations

import inspect
import math
import os
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from visadapt.systems import System

TABLE = "parameters"

SystemT = TypeVar("SystemT", bound=System)


class RigError(ValueError):
    """A rig's file that cannot be used; the message is one line: which file and key, and what would be right."""


def load_parameters(path: str | os.PathLike[str], system_class: type[SystemT]) -> SystemT:
    """The system with the parameters of a TOML file.

    Raises:
        RigError: no such file, no TOML, no table `[parameters]`, an unknown key, or an impossible value.

    >>> import pathlib, tempfile, visadapt as va
    >>> rig = pathlib.Path(tempfile.mkdtemp()) / "rig.toml"
    >>> _ = rig.write_text("[parameters]\\ncart_mass = 0.23\\n")
    >>> va.load_parameters(rig, va.CartPole).cart_mass
    0.23
    """
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise RigError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise RigError(f"{path}: not TOML: {error}") from error
    names = list(inspect.signature(system_class).parameters)
    known = ", ".join(names)
    parameters = content.pop(TABLE, None)
    if not isinstance(parameters, dict):
        raise RigError(f"{path}: the table [{TABLE}] is missing; it may hold {known}")
    if content:
        raise RigError(f"{path}: unknown key {next(iter(content))!r} outside [{TABLE}], which may hold {known}")
    for key, value in parameters.items():
        if key not in names:
            raise RigError(f"{path}: unknown key {key!r} in [{TABLE}]; there are {known}")
        _check_number(path, key, value)
    try:
        return system_class(**{key: float(value) for key, value in parameters.items()})
    except ValueError as error:
        raise RigError(f"{path}: {error}") from error


def _check_number(path: str | os.PathLike[str], key: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RigError(f"{path}: {key} must be a number in SI units, got {value!r}")
    if not math.isfinite(value):
        raise RigError(f"{path}: {key} must be finite, got {value!r}")

"""The parameters of one's own machine, in a TOML file: a system with values other than its defaults.

    [parameters]
    cart_mass = 0.230
    pole_mass = 0.087

Names and SI units are those of the system's fields; parameters that the file does not name keep their defaults.
"""

from __future__ import annotations

import inspect
import os
from typing import TypeVar

import torch

from visadapt.storage.toml_file import read_toml
from visadapt.systems import System

LARGEST = float(torch.finfo(torch.float32).max)
"""Largest value of a parameter: that of float32, in which policies are trained."""

SystemT = TypeVar("SystemT", bound=System)


class ParameterFileError(ValueError):
    """A parameter file that cannot be used; the message is one line: which file, which key, and what would be right."""


def load_parameters(path: str | os.PathLike[str], system_class: type[SystemT]) -> SystemT:
    """The system with the parameters in a TOML file.

    Raises:
        ParameterFileError: the file is missing or not TOML, has no table `[parameters]`, or has an unknown key or an
            impossible value.

    >>> import pathlib, tempfile, visadapt as va
    >>> rig = pathlib.Path(tempfile.mkdtemp()) / "rig.toml"
    >>> _ = rig.write_text("[parameters]\\ncart_mass = 0.23\\n")
    >>> va.load_parameters(rig, va.CartPole).cart_mass
    0.23
    """
    content = read_toml(path, ParameterFileError)
    names = list(inspect.signature(system_class).parameters)
    known = ", ".join(names)
    parameters = content.pop("parameters", None)
    if not isinstance(parameters, dict):
        raise ParameterFileError(f"{path}: the table [parameters] is missing; it may hold {known}")
    if content:
        raise ParameterFileError(
            f"{path}: unknown key {next(iter(content))!r} outside [parameters], which may hold {known}"
        )
    for key, value in parameters.items():
        if key not in names:
            raise ParameterFileError(f"{path}: unknown key {key!r} in [parameters]; there are {known}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ParameterFileError(f"{path}: {key} must be a number in SI units, got {value!r}")
        if not abs(value) <= LARGEST:
            raise ParameterFileError(
                f"{path}: {key} must be finite, got {value!r:.30} (at most {LARGEST:.2g} is right)"
            )
    try:
        return system_class(**{key: float(value) for key, value in parameters.items()})
    except ValueError as error:
        raise ParameterFileError(f"{path}: {error}") from error

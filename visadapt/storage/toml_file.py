"""Reading TOML: what is wrong with a file becomes one line; which of its values are numbers."""

from __future__ import annotations

import os
import sys
import tomllib
from pathlib import Path
from typing import Any, TypeGuard


def read_toml(path: str | os.PathLike[str], error: type[Exception]) -> dict[str, Any]:
    """The content of a TOML file.

    Raises:
        error: the file is missing, or no TOML; one line says which.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "rig.toml"
    >>> _ = path.write_text("[parameters]\\ncart_mass = 0.23\\n")
    >>> read_toml(path, ValueError)
    {'parameters': {'cart_mass': 0.23}}
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as why:
        raise error(f"{path}: cannot be read: {why.strerror}") from why
    except (ValueError, RecursionError) as why:  # of TOML, of its encoding, or of the Python that reads it
        raise error(f"{path}: not TOML: {why}") from why


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value is a finite number, and one that a float can hold; TOML's whole numbers may have any length."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max

"""Python that a user names on the command line: files of effects, and factories of targets."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from visadapt.cli.arguments import InputError


def import_effects(path: Path) -> None:
    """Import a file, whose effects register themselves."""
    path = path.absolute()  # as Python's own messages name it
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    # Under a name of its own, by which worker processes find its classes.
    name = f"visadapt_effects_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: not a Python file; a name that ends in .py is right")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{path}: {describe(error, str(path))}") from error


def find_factory(name: str) -> Callable[[], Any]:
    """What `package.module:factory` names; modules in the current directory are found too."""
    module_name, _, attribute = name.partition(":")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is not None and module_name.split(".")[: error.name.count(".") + 1] == error.name.split("."):
            raise InputError(f"{name}: there is no module {error.name!r}, installed or in {Path.cwd()}") from error
        raise InputError(f"{name}: {describe(error)}") from error
    except Exception as error:
        raise InputError(f"{name}: {describe(error)}") from error
    factory = getattr(module, attribute, None)
    if not callable(factory):
        what = "nothing" if factory is None else f"a {type(factory).__name__}, not a function,"
        raise InputError(f"{name}: {module.__file__} has {what} called {attribute!r}")
    found: Callable[[], Any] = factory
    return found


def describe(error: Exception, path: str | None = None) -> str:
    """An exception of a user's Python in one line, with the line of `path`, or of the file that raised it."""
    if isinstance(error, SyntaxError):
        where = "" if path else f"{error.filename}: "
        return f"{where}line {error.lineno}: {type(error).__name__}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == path]
    where = f"line {lines[-1]}: " if lines else ""
    if path is None and frames:
        where = f"{frames[-1].filename}, line {frames[-1].lineno}: "
    return f"{where}{type(error).__name__}: {' '.join(str(error).split())}"

"""The user's own Python: imported from its files, and what it raises said in one line that names the place."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from visadapt.cli.errors import InputError

OWN_FILES: set[str] = set()
"""Files of the user's whose code is run."""
OWN_FOLDERS: set[Path] = set()
"""Folders where these may have imported other files of the user's from."""
LIBRARIES = {
    *(Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib")),
    *(Path(__file__).parents[2] / package for package in ("visadapt", "renderers")),
}
"""Folders in whose code an error is not the user's, wherever they lie."""


def import_file(given: str) -> ModuleType:
    """The module in a file of the user's.

    Raises:
        InputError: the file is missing, no Python, or raises; names its line.
    """
    path = Path(given).absolute()  # as Python's own messages name it
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    # Under a name of its own, by which worker processes find its classes.
    name = f"visadapt_own_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: not a Python file; a name that ends in .py is right")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    OWN_FILES.add(str(path))
    OWN_FOLDERS.add(path.parent)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # for the files beside it; last, so that none of them hides a library
    with own_code(lambda error: f"{path}: {describe(error, str(path))}"):
        spec.loader.exec_module(module)
    sys.modules.setdefault(path.stem, module)  # so that another file of the user's that imports it gets these classes
    return module


def find_factory(name: str) -> Callable[[], Any]:
    """What `package.module:factory` names; modules in the current directory are found too."""
    module_name, _, attribute = name.partition(":")
    module_name = module_name.removesuffix(".py")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing and f"{module_name}.".startswith(f"{missing}."):
            raise InputError(f"{name}: there is no module {missing!r}, installed or in {here}") from error
        raise InputError(f"{name}: {describe(error)}") from error
    OWN_FILES.add(str(module.__file__))
    OWN_FOLDERS.update((Path(here), Path(str(module.__file__)).parent))
    factory = getattr(module, attribute, None)
    if not callable(factory):
        what = "nothing" if factory is None else f"a {type(factory).__name__}, not a function,"
        raise InputError(f"{name}: {module.__file__} has {what} called {attribute!r}")
    return factory


@contextmanager
def as_input_error() -> Iterator[None]:
    """Turn the ValueError or TypeError by which the library refuses an argument into an InputError.

    One that the user's own code raised names the line there.
    """
    try:
        yield
    except (ValueError, TypeError) as error:
        raise InputError(own_line(error) or str(error)) from error


@contextmanager
def own_code(message: Callable[[BaseException], str]) -> Iterator[None]:
    """Turn what code of the user's raises, which may be anything, into an InputError."""
    try:
        yield
    except (KeyboardInterrupt, InputError):
        raise
    except BaseException as error:
        raise InputError(message(error)) from error


def own_line(error: BaseException) -> str | None:
    """The message for an error that the user's own code raised; None where it was ours."""
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__) if _is_own(frame.filename)]
    return f"{files[-1]}: {describe(error, files[-1])}" if files else None


def _is_own(file: str) -> bool:
    folders = Path(file).parents
    return file in OWN_FILES or (not OWN_FOLDERS.isdisjoint(folders) and LIBRARIES.isdisjoint(folders))


def describe(error: BaseException, path: str | None = None) -> str:
    """An exception of a user's Python in one line, with the line of `path`, or of the file that raised it."""
    if isinstance(error, SyntaxError):
        where = "" if path else f"{error.filename}: "
        return f"{where}line {error.lineno}: {type(error).__name__}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if path in (None, frame.filename)]
    where = "" if not own else f"line {own[-1].lineno}: " if path else f"{own[-1].filename}, line {own[-1].lineno}: "
    text = "it ends the program" if isinstance(error, SystemExit) else " ".join(str(error).split())
    return f"{where}{type(error).__name__}: {text}"

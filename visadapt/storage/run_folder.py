"""A run's folder: its settings, seeds and versions beside its results, and results that are computed only once."""

from __future__ import annotations

import json
import math
import os
import platform
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from visadapt.storage.atomic_files import replacing

RECORDED_PACKAGES = ("visadapt", "torch", "numpy", "opencv-python-headless", "gymnasium", "mujoco")


class RunError(ValueError):
    """A folder in which a run cannot be continued; the message is one line that says why."""


def open_run(folder: Path, settings: Mapping[str, Any], file: str = "settings.json") -> dict[str, Any]:
    """Begin a run in `folder`, or continue the one that is there; returns its settings and versions, kept in `file`.

    Raises:
        RunError: the folder holds a run with other settings.
    """
    wanted = json.loads(json.dumps(_finite(settings), default=str))
    run = once(folder / file, lambda: {"settings": wanted, "versions": versions()})
    found = run.get("settings")
    if not isinstance(found, dict):
        raise RunError(f"{folder / file}: holds no settings of a run: remove the folder or name another")
    if found != wanted:
        differing = sorted(key for key in {*found, *wanted} if found.get(key) != wanted.get(key))
        raise RunError(
            f"{folder} holds a run with other settings ({', '.join(differing)}): remove that folder, or name another"
        )
    return run


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keeps other processes out of a run's folder, which is made if need be, where the system has such locks.

    Raises:
        RunError: another process is in it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if sys.platform == "win32":
        yield
        return
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise RunError(f"{folder}: another process runs in this folder: wait for its end, or name another") from None
    except OSError:
        pass  # a file system without locks
    try:
        yield
    finally:
        os.close(descriptor)


def versions() -> dict[str, str]:
    """Versions of Python and of those packages that results depend on and that are installed."""
    found = {"python": platform.python_version()}
    for package in RECORDED_PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def once(path: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The JSON object in `path`; if there is no such file, `make` is called and its result written there first."""
    if not path.exists():
        write_json(path, make())
    return read_json(path)


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file; raises RunError if the file is incomplete, or holds something else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise RunError(f"{path}: not complete JSON ({error}): remove it and run again") from error
    if not isinstance(content, dict):
        raise RunError(f"{path}: no JSON object: remove it and run again")
    return content


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object, atomically; numbers that are not finite become null, since JSON has none."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def _finite(content: Any) -> Any:
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    if isinstance(content, Mapping):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if hasattr(content, "tolist"):  # of NumPy or torch
        return _finite(content.tolist())
    return content

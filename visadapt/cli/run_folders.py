"""The folder that a training or an adaptation works in, and the settings by which it is resumed."""

from __future__ import annotations

import argparse
import hashlib
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from visadapt.cli.errors import InputError
from visadapt.storage.run_folder import open_run


@contextmanager
def unfinished(out: Path, settings: Mapping[str, Any]) -> Iterator[Path]:
    """The folder `<out>.unfinished` that a training works in, and goes on from; removed when the block ends.

    Raises:
        InputError: `out` is there already, or is a folder; or what lies in the folder is no training.
        RunError: the folder holds a training with other settings.
    """
    if out.exists():
        raise InputError(f"{out} is there already: remove it, or name another file by --out")
    folder = out.with_name(out.name + ".unfinished")
    check_run_folder(folder)
    open_run(folder, settings)
    yield folder
    shutil.rmtree(folder)


def check_run_folder(folder: Path) -> None:
    """Raises InputError where files lie in the folder of a run that are not a run's, and would be replaced."""
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "settings.json").exists():
        raise InputError(f"{folder} has files in it that are no run of visadapt: name another by --out")


def run_settings(options: argparse.Namespace, *files: str) -> dict[str, Any]:
    """The settings of a run: it is resumed only if they are the same.

    These are all options but --out and --system, whose class the caller or the policy's file names. In place of the
    options in `files`, which name a file or a list of files, stands the SHA-256 of each file, so that the files may be
    moved.
    """
    settings = {name: value for name, value in vars(options).items() if name not in ("out", "system")}
    for name in files:
        given = settings[name]
        settings[name] = [_fingerprint(path) for path in given] if isinstance(given, list) else _fingerprint(given)
    return settings


def _fingerprint(path: str | Path | None) -> str | None:
    return None if path is None else hashlib.sha256(Path(path).read_bytes()).hexdigest()

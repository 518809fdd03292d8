"""The files that a command names, checked before it begins: none is empty, and no output is an input."""

from __future__ import annotations

import argparse
import inspect
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from visadapt.cli.errors import InputError
from visadapt.cli.run_folders import check_run_folder
from visadapt.storage.atomic_files import check_writable
from visadapt.systems import SYSTEMS

INPUTS = ("recording", "params", "effects", "policy", "renderer", "diagnosis", "references", "task", "map")
OUTPUTS = ("out", "json", "report", "plan", "film")


def check_files(options: argparse.Namespace) -> None:
    """Check every file that the options name.

    Raises:
        InputError: an option is empty, an output is an input or another output, or the folder of a run has other files.
        NotWrittenError: an output cannot be written.
    """
    for name, value in vars(options).items():
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, str) and (not each or "\0" in each):
                what = "holds a NUL, which no name has" if each else "is empty; leave it out, or name something"
                raise InputError(f"{_flag(name)}: {what}")
    taken = list(_inputs(options))
    for name in OUTPUTS:
        if path := vars(options).get(name):
            is_folder = options.command == "adapt"
            for flag, other in taken:
                if _overwrites(path, other, is_folder):
                    where = "the folder" if is_folder else "the file"
                    raise InputError(f"--{name}: {path} is {where} of {flag}, which would be lost; name another")
            if is_folder and Path(path).is_file():
                raise InputError(f"--{name}: {path} is a file; name a folder")
            if is_folder:
                check_run_folder(Path(path))
            else:
                check_writable(path)
            taken.append((f"--{name}", path))


def _flag(option: str) -> str:
    return "RECORDING" if option == "recording" else f"--{option}"


def _inputs(options: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """Option and path of every file that is read; those of a folder each."""
    for name in INPUTS:
        value = vars(options).get(name) or []
        for path in value if isinstance(value, list) else [value]:
            flag = "POLICY" if name == "policy" and options.command == "export" else _flag(name)
            yield flag, path
            if Path(path).is_dir():
                yield from ((flag, str(file)) for file in Path(path).iterdir())
    module, colon, _ = (vars(options).get("target") or "").rpartition(":")
    if colon:
        yield "--target", module.replace(".", os.sep) + ".py"
    system = vars(options).get("system")
    if system and system not in SYSTEMS.values():
        yield "--system", inspect.getfile(system)


def _overwrites(output: str, other: str, is_folder: bool) -> bool:
    """Whether writing `output` would overwrite the file `other`."""
    here, there = Path(os.path.realpath(output)), Path(os.path.realpath(other))
    if is_folder:
        return here in there.parents
    with suppress(OSError):
        return here == there or here.samefile(there)
    return False

"""What subcommands share: types of arguments, progress, and the folder that an interrupted command goes on from."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from visadapt.progress import Report
    from visadapt.systems import System

SYSTEMS_HELP = "cartpole, quadrotor or fixed_wing"


class InputError(ValueError):
    """An argument that cannot be used; the message is one line: what, where, and what would be right."""


def positive(text: str) -> int:
    """A whole number from 1 on."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 on")
    return int(text)


def positive_number(text: str) -> float:
    """A finite number above 0."""
    number = _finite(text)
    if not number > 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return number


def pair(text: str) -> tuple[float, float]:
    """Two finite numbers with a comma between them."""
    first, *rest = text.split(",")
    if len(rest) != 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not two numbers with a comma between them")
    return _finite(first), _finite(rest[0])


def system_class(text: str) -> type[System]:
    """The system of a name."""
    from visadapt.systems import SYSTEMS

    if text not in SYSTEMS:
        raise argparse.ArgumentTypeError(f"there is no system {text!r}; there are {', '.join(SYSTEMS)}")
    return SYSTEMS[text]


def _finite(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not abs(number) < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return number


def add_system(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Add --system and --params."""
    parser.add_argument(
        "--system", required=required, type=system_class, metavar="NAME", help=f"the source physics: {SYSTEMS_HELP}"
    )
    parser.add_argument("--params", metavar="RIG.toml", help="the rig's own parameters, in a table [parameters]")


def the_system(options: argparse.Namespace) -> System:
    """The system of --system with the parameters of --params."""
    from visadapt.systems.parameter_file import load_parameters

    system: System = load_parameters(options.params, options.system) if options.params else options.system()
    return system


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add --seed."""
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of everything random (default: 0)")


@contextmanager
def checked() -> Iterator[None]:
    """Turn the ValueError or TypeError by which the library refuses an argument into an InputError."""
    try:
        yield
    except (ValueError, TypeError) as error:
        raise InputError(str(error)) from error


@contextmanager
def progress() -> Iterator[Report]:
    """A report of progress on stderr, where everything goes that is printed meanwhile: stdout is for results."""
    from visadapt.progress import reporting

    with contextlib.redirect_stdout(sys.stderr), reporting() as report:
        yield report


@contextmanager
def unfinished(out: Path, settings: Mapping[str, Any]) -> Iterator[Path]:
    """The folder `<out>.unfinished` that a training works in, and goes on from; removed once the block is through.

    Raises:
        InputError: `out` is there already, or is a folder.
        RunError: the folder holds a training with other settings.
    """
    from visadapt.storage.run_folder import open_run

    if out.exists():
        raise InputError(f"{out} is there already: remove it, or name another file by --out")
    folder = out.with_name(out.name + ".unfinished")
    open_run(folder, settings)
    yield folder
    shutil.rmtree(folder)


def fingerprint(path: str | Path | None) -> str | None:
    """The SHA-256 of a file that a run depends on, so that it does not go on with another; None without one."""
    return None if path is None else hashlib.sha256(Path(path).read_bytes()).hexdigest()

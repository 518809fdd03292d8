"""The command `visadapt`."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

from visadapt import diagnosis
from visadapt.diagnosis import DIAGNOSABLE
from visadapt.diagnosis.report.html import as_text, write_report
from visadapt.policies import StatePolicy
from visadapt.progress import reporting
from visadapt.recordings import RecordingError, load_recording
from visadapt.storage.atomic_files import replacing
from visadapt.storage.checkpoints import CheckpointError, load_network
from visadapt.storage.run_folder import versions
from visadapt.systems import System
from visadapt.systems.parameter_file import ParameterFileError, load_parameters
from visadapt.world import World

BAD_INPUT = 2
"""Exit status, argparse's own."""


class InputError(ValueError):
    """An argument that cannot be used; the message is one line."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0: done, 2: bad input, of which one line on stderr tells."""
    options = _parser().parse_args(arguments)
    try:
        _diagnose(options)
    except (InputError, RecordingError, ParameterFileError, CheckpointError, OSError) as error:
        print(f"visadapt: {error}", file=sys.stderr)
        return BAD_INPUT
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="visadapt", description=sys.modules["visadapt"].__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    diagnose = commands.add_parser(
        "diagnose",
        help="where a rig departs from the simulator, which effect causes it, and how far that explains it",
        description="Says where a recording departs from the simulator, which named effects cause it, and how much "
        "of the gap they close. The verdict goes to the terminal; exit status 0: a diagnosis was made, 2: bad input.",
    )
    diagnose.add_argument(
        "recording", nargs="+", metavar="RECORDING", help="a CSV or HDF5 file, several, or a folder of them"
    )
    diagnose.add_argument("--system", required=True, choices=sorted(DIAGNOSABLE), help="the source physics")
    diagnose.add_argument("--params", metavar="RIG.toml", help="the rig's own parameters, in a table [parameters]")
    diagnose.add_argument(
        "--columns",
        metavar="A=B,...",
        type=_columns,
        default={},
        help="our name=the file's, as in x=position,theta=phi",
    )
    diagnose.add_argument("--effects", metavar="FILE.py", help="a file that defines effects of your own")
    diagnose.add_argument(
        "--policy",
        metavar="P.safetensors",
        help="a policy on states, as visadapt.save_policy writes it, for which the terms of the "
        "paper's Theorem 1 are told, on the terminal and in the report",
    )
    diagnose.add_argument("--json", metavar="F", help="write the result here, as visadapt/diagnosis/schema.json says")
    diagnose.add_argument("--report", metavar="F.html", help="write a page with figures here")
    diagnose.add_argument("--seed", metavar="N", type=int, default=0, help="of all that is drawn (default: 0)")
    diagnose.add_argument("--jobs", metavar="N", type=_positive, default=1, help="cores to use (default: 1)")
    return parser


def _columns(text: str) -> dict[str, str]:
    pairs = [pair.split("=", 1) for pair in text.split(",")]
    for pair in pairs:
        if len(pair) != 2 or not all(part.strip() for part in pair):
            raise argparse.ArgumentTypeError(f"{'='.join(pair)!r} is not of the form x=position")
    names = [ours.strip() for ours, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise argparse.ArgumentTypeError(f"{name} is given twice")
    return {ours.strip(): theirs.strip() for ours, theirs in pairs}


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of cores from 1 on")
    return int(text)


def _diagnose(options: argparse.Namespace) -> None:
    began = time.perf_counter()
    system_class = DIAGNOSABLE[options.system]
    system = load_parameters(options.params, system_class) if options.params else system_class()
    if options.effects:
        _run(Path(options.effects))
    policy = _state_policy(Path(options.policy), system) if options.policy else None
    recording = load_recording(options.recording, system, options.columns)
    # Only the verdict belongs on stdout.
    with contextlib.redirect_stdout(sys.stderr), reporting() as report:
        result = diagnosis.diagnose(
            recording,
            World(system, period=recording.period),
            seed=options.seed,
            jobs=options.jobs,
            progress=report,
            policy=policy,
        )
    print(as_text(result))
    if options.json:
        with replacing(options.json) as temporary:
            temporary.write_text(json.dumps(result.to_json(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    if options.report:
        settings = _settings(options, system, time.perf_counter() - began)
        write_report(options.report, result, settings)


def _settings(options: argparse.Namespace, system: System, seconds: float) -> dict[str, str]:
    """What the result depends on, for the report's foot."""
    settings = {
        "recording": ", ".join(options.recording),
        "system": str(system),
        "parameters from": options.params or "the system's defaults",
        "columns": ", ".join(f"{ours}={theirs}" for ours, theirs in options.columns.items()),
        "effects from": options.effects or "",
        "policy from": options.policy or "",
        "seed": str(options.seed),
        "time": f"{seconds:.1f} s on {options.jobs} core{'s' if options.jobs > 1 else ''}",
        "versions": ", ".join(f"{name} {version}" for name, version in versions().items()),
    }
    return {name: value for name, value in settings.items() if value}


def _state_policy(path: Path, system: System) -> StatePolicy:
    """A policy on the last state, or on 5 states and actions: the file does not say which."""
    alone, with_history = (StatePolicy(len(system.states), len(system.actions), history) for history in (False, True))
    try:
        load_network(path, alone)
    except CheckpointError as misfit:
        try:
            load_network(path, with_history)
        except CheckpointError:
            raise misfit from None
        return with_history
    return alone


def _run(path: Path) -> None:
    """Import a user's file, whose effects register themselves."""
    # Under a name of its own, by which worker processes find its classes.
    name = f"visadapt_effects_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: not a Python file; a name that ends in .py is right")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except FileNotFoundError as error:
        if error.filename == str(path):
            raise InputError(f"{path}: there is no such file") from error
        raise InputError(_told(path, error)) from error
    except Exception as error:
        raise InputError(_told(path, error)) from error


def _told(path: Path, error: Exception) -> str:
    """An exception of a user's file in one line, with the line of that file."""
    if isinstance(error, SyntaxError):
        return f"{path}: line {error.lineno}: {type(error).__name__}: {error.msg}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    where = f"line {lines[-1]}: " if lines else ""
    return f"{path}: {where}{type(error).__name__}: {' '.join(str(error).split())}"

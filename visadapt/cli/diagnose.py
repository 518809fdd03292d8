"""visadapt diagnose: where a recording departs from the simulator, and why."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from visadapt.cli.arguments import InputError, add_seed, add_system, positive, progress, the_system
from visadapt.cli.user_files import import_effects

if TYPE_CHECKING:
    from visadapt.policies import StatePolicy
    from visadapt.systems import System


def add(commands: Any) -> None:
    """Add the subcommand's parser."""
    parser = commands.add_parser(
        "diagnose",
        help="where a rig departs from the simulator, which effect causes it, and how far that explains it",
        description="Says where a recording departs from the simulator, which named effects cause it, and how much "
        "of the gap they close. The verdict goes to the terminal; exit status 0: a diagnosis was made, 2: bad input.",
    )
    parser.add_argument(
        "recording", nargs="+", metavar="RECORDING", help="a CSV or HDF5 file, several, or a folder of them"
    )
    add_system(parser)
    parser.add_argument(
        "--columns",
        metavar="A=B,...",
        type=_columns,
        default={},
        help="our name=the file's, as in x=position,theta=phi",
    )
    parser.add_argument("--effects", metavar="FILE.py", help="a file that defines effects of your own")
    parser.add_argument(
        "--policy",
        metavar="P.safetensors",
        help="a policy on states, as `visadapt train` writes it, for which the terms of the paper's Theorem 1 are "
        "given, on the terminal and in the report",
    )
    parser.add_argument("--json", metavar="F", help="write the result here, as visadapt/diagnosis/schema.json says")
    parser.add_argument("--report", metavar="F.html", help="write a page with figures here")
    add_seed(parser)
    parser.add_argument("--jobs", metavar="N", type=positive, default=1, help="cores to use (default: 1)")
    parser.set_defaults(run=run)


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


def run(options: argparse.Namespace) -> None:
    """Diagnose, print the verdict, write what was asked for."""
    from visadapt import diagnosis
    from visadapt.diagnosis.report.html import write_report
    from visadapt.diagnosis.report.text import as_text
    from visadapt.recordings import load_recording
    from visadapt.storage.atomic_files import replacing
    from visadapt.world import World

    began = time.perf_counter()
    system = the_system(options)
    if options.effects:
        import_effects(Path(options.effects))
    policy = _state_policy(Path(options.policy), system) if options.policy else None
    recording = load_recording(options.recording, system, options.columns)
    with progress() as report:
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
    from visadapt.storage.run_folder import versions

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
    from visadapt.policies import StatePolicy
    from visadapt.setups.policy_file import load_policy

    policy = load_policy(path)
    if not isinstance(policy, StatePolicy):
        raise InputError(f"{path}: holds a {type(policy).__name__}, a StatePolicy is needed")
    if (policy.n_state, policy.n_action) != (len(system.states), len(system.actions)):
        raise InputError(
            f"{path}: a policy of {policy.n_state} states and {policy.n_action} commands; "
            f"a {system.name} has {len(system.states)} and {len(system.actions)}"
        )
    return policy

"""visadapt diagnose: where a recording departs from the simulator, and why."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from renderers import load_renderer
from visadapt import diagnosis
from visadapt.cli.errors import InputError
from visadapt.cli.own_classes import import_effects
from visadapt.cli.progress import progress
from visadapt.cli.simulator import given_system
from visadapt.diagnosis import Diagnosis
from visadapt.diagnosis.planning import plan
from visadapt.diagnosis.report.text import as_text
from visadapt.diagnosis.result import AMBIGUOUS
from visadapt.diagnosis.words import printable
from visadapt.effects.own import is_own
from visadapt.policies import Policy
from visadapt.progress import staged
from visadapt.recordings import Recording, load_recording
from visadapt.setups.policy_file import load_policy
from visadapt.storage.atomic_files import replacing
from visadapt.storage.run_folder import versions
from visadapt.systems import CartPole, System
from visadapt.world import World

PERIOD_TOLERANCE = 0.05
"""Share by which the period of a recording, whose clock may be unsteady, may differ from that of a policy."""


def run(options: argparse.Namespace) -> None:
    """Diagnose, print the verdict, write what was asked for."""
    system = given_system(options)
    import_effects(options)
    if options.policy and is_own(type(system)) and not options.plan:
        raise InputError(
            f"--policy: its terms of Theorem 1 are those of a cartpole's policy, not of a {system.name}'s: leave it "
            "out, or give --plan, whose excitation is added to its commands"
        )
    policy = _state_policy(Path(options.policy), system) if options.policy else None
    if options.renderer and not isinstance(system, CartPole):
        raise InputError(f"--renderer: renderers draw a cart-pole, not a {system.name}")
    renderer = load_renderer(Path(options.renderer)) if options.renderer else None
    if options.plan and renderer is not None:
        raise InputError("--plan: a plan needs a recording of states, not of frames")
    with progress() as report:
        recording = load_recording(options.recording, system, options.columns, renderer is not None, report)
        if policy is not None:
            _check_period(Path(options.policy), policy, recording.period)
        source = World(system, period=recording.period)
        seed, jobs = options.seed, options.jobs
        bounded = policy if isinstance(system, CartPole) else None  # by Theorem 1
        result = diagnosis.diagnose(
            recording, source, seed=seed, jobs=jobs, progress=report, policy=bounded, announce=print, renderer=renderer
        )
    said = [as_text(result)]
    try:
        if options.json:
            with replacing(options.json) as temporary:
                temporary.write_text(json.dumps(result.to_json(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
        if options.report:
            from visadapt.diagnosis.report.html import write_report  # with matplotlib, which takes half a second

            write_report(options.report, result, _settings(options, system))
        if options.plan:
            said.append(_plan(options, result, recording, source, policy))
    finally:
        print(*said, sep="\n")  # last, since whoever reads it may stop reading


def _plan(
    options: argparse.Namespace, result: Diagnosis, recording: Recording, source: World, policy: Policy | None
) -> str:
    """Design and write the plan; what became of it, in a line."""
    if result.verdict != AMBIGUOUS:
        return f"--plan: nothing to settle, the verdict is {result.verdict}; {options.plan} was not written"
    try:
        with progress() as report:
            planned = plan(result, recording, source, policy, seed=options.seed, progress=staged(report, "plan"))
    except ValueError as error:
        return f"--plan: {error}; {options.plan} was not written"
    if not planned.settles:
        return f"--plan: {planned}; {options.plan} was not written"
    planned.write(options.plan)
    return str(planned)


def _settings(options: argparse.Namespace, system: System) -> dict[str, str]:
    """What the result depends on, for the report's foot: equal diagnoses give equal pages."""
    settings = {
        "recording": ", ".join(options.recording),
        "system": str(system),
        "parameters from": options.params or "the system's defaults",
        "columns": ", ".join(f"{ours}={theirs}" for ours, theirs in options.columns.items()),
        "effects from": options.effects or "",
        "policy from": options.policy or "",
        "renderer from": options.renderer or "",
        "seed": str(options.seed),
        "versions": ", ".join(f"{name} {version}" for name, version in versions().items()),
    }
    return {name: printable(value) for name, value in settings.items() if value}


def _check_period(path: Path, policy: Policy, period: float) -> None:
    trained = policy.trained_period
    if trained is not None and abs(trained - period) > PERIOD_TOLERANCE * trained:
        raise InputError(
            f"{path} was trained for {trained:g} s between commands, the recording has {period:.4g} s: one that was "
            f"trained with --period {period:.4g} is right"
        )


def _state_policy(path: Path, system: System) -> Policy:
    policy = load_policy(path)
    if policy.shown != "state":
        raise InputError(f"{path}: is shown the {policy.shown} of a target; a policy on states alone is needed")
    if (policy.n_state, policy.n_action) != (len(system.states), len(system.actions)):
        raise InputError(
            f"{path}: a policy of {policy.n_state} states and {policy.n_action} commands; "
            f"a {system.name} has {len(system.states)} and {len(system.actions)}"
        )
    return policy

"""visadapt adapt: the paper's Algorithm 1 on a target, in a folder that an interrupted run goes on from."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from visadapt.cli.errors import InputError
from visadapt.cli.own_classes import import_effects
from visadapt.cli.progress import progress
from visadapt.cli.run_folders import run_settings
from visadapt.cli.simulator import given_effects
from visadapt.cli.target import load_policy_and_target
from visadapt.cli.user_code import as_input_error
from visadapt.diagnosis.words import number, with_unit
from visadapt.effects import Effect, Parameter
from visadapt.learning.explanation import Explanation
from visadapt.policies import ImagePolicy
from visadapt.setups.explained import check_diagnosable
from visadapt.setups.policy_file import save_policy
from visadapt.setups.target_checks import doubts
from visadapt.setups.training import adapt, setup_to_adapt
from visadapt.storage.run_folder import alone_in, open_run, write_json
from visadapt.tasks.references import read_reference

LATE = (
    ". A residual on the last state alone cannot learn a motor that is late: --diagnose names it, and with "
    "--with-history earlier periods are seen"
)
"""What may help where a policy tuned with a residual is worse."""


def run(options: argparse.Namespace) -> None:
    """Adapt the policy in the folder of the run."""
    import_effects(options)
    policy, source, target = load_policy_and_target(options)
    effects = given_effects(options, source.system)
    if options.diagnose and effects:
        raise InputError("--diagnose names the effects itself: leave --diagnosis and --effect out")
    if options.diagnose and len(source.effects):
        raise InputError(f"{options.policy}: was made in a world with effects; --diagnose starts from the bare system")
    if effects:
        source = source.with_effects(effects)
    if options.renderer and not isinstance(policy, ImagePolicy):
        raise InputError(f"{options.policy}: is shown states, for which --renderer has no use: leave it out")
    references = read_reference(options.references, source.period) if options.references else None
    with as_input_error():  # before the machine is run
        setup = setup_to_adapt(policy, source, target, options.renderer, references, options.with_history)
        setup.check_adaptation(policy, target)
        if options.diagnose:
            check_diagnosable(source, min(options.round or options.samples, setup.settings.longest_episode))
    if options.round and options.round > options.samples:
        raise InputError(f"--round {options.round} is more than --samples {options.samples}: lower it, or raise those")
    folder = Path(options.out)
    with alone_in(folder), progress() as report:
        open_run(folder, run_settings(options, "policy", "renderer", "references", "diagnosis", "map", "effects"))
        names = ("seed", "iterations", "renderer", "with_history", "diagnose")
        given: dict[str, Any] = {name: getattr(options, name) for name in names}
        given |= {"round_samples": options.round, "references": references, "report": report}
        adapted = adapt(policy, source, target, options.samples, folder, **given)
    rounds = [{"samples": one.samples, "policy_loss": one.policy[-1] if one.policy else None} for one in adapted.rounds]
    write_json(folder / "ledger.json", {**asdict(adapted.ledger), "used": adapted.ledger.used, "rounds": rounds})
    if options.diagnose:
        last = adapted.rounds[-1].explanation
        print(_in_words(last))
        for warning in last.warnings:
            print(f"Warning    {warning}")
    if adapted.taken_back:
        tuned = copy.deepcopy(adapted.policy)
        adapted.restore(tuned, adapted.rounds[-1].samples)
        save_policy(folder / "tuned.safetensors", tuned)
        hint = "" if options.diagnose else LATE
        print(
            f"The policy is the one that it began as, since the tuned one, {folder / 'tuned.safetensors'}, was worse: "
            f"{adapted.taken_back}{hint}"
        )
    print(f"{adapted.ledger.used} samples of {target.name} used; the policy is {folder / 'policy.safetensors'}")
    if not options.diagnose and policy.shown == "state":
        for doubt in doubts(sorted(folder.glob("round-*/recording.h5")), adapted.episodes, source):
            print(f"Warning    {doubt}")


def _in_words(explanation: Explanation) -> str:
    """The last diagnosis, and what followed from it."""
    slight = explanation.slight
    causes = _named(sorted(explanation.effects, key=lambda effect: effect.name in slight), slight)
    others = " or ".join(_named(each, slight) for each in explanation.others)
    instead = "to tune the policy for that, give --effect NAME:PARAMETER=VALUE instead of --diagnose"
    alike = f"; as well explained by {others} ({instead})" if others else ""
    if explanation.complete:
        return f"{explanation.verdict}: {causes or 'the policy is left as it was'}{alike}"
    learnt = f"{causes}; a residual learnt what they leave" if causes else "a residual learnt the gap"
    nearest = f"; {explanation.nearest}" if explanation.nearest else ""
    return f"{explanation.verdict}: {learnt}{alike}{nearest}"


def _named(effects: Sequence[Effect], slight: Collection[str]) -> str:
    """Effects with their values; those that are `slight`, by name, are said to be."""
    return ", ".join(
        f"{effect.name} ({', '.join(f'{p.name} {_value(effect, p)}' for p in effect.table)})"
        f"{', slight' if effect.name in slight else ''}"
        for effect in effects
    )


def _value(effect: Effect, parameter: Parameter) -> str:
    return with_unit(number(float(effect.get_parameter(parameter.name).detach())), parameter.unit)

"""visadapt adapt: the paper's Algorithm 1 on a target, in a folder that an interrupted run goes on from."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from renderers import load_renderer
from visadapt.cli.inputs import InputError, checked, fingerprint, given_effects, import_effects, progress
from visadapt.cli.target import load_both
from visadapt.diagnosis.words import number, with_unit
from visadapt.effects import Effect, Parameter
from visadapt.learning.explanation import Explanation
from visadapt.policies import ImagePolicy, Policy
from visadapt.setups.training import adapt, setup_for
from visadapt.storage.run_folder import open_run, write_json
from visadapt.tasks.references import read_reference
from visadapt.weights import shipped


def run(options: argparse.Namespace) -> None:
    """Adapt the policy in the folder of the run."""
    import_effects(options)
    policy, source, target = load_both(options)
    effects = given_effects(options, source.system)
    if options.diagnose and effects:
        raise InputError("--diagnose names the effects itself: leave --diagnosis and --effect out")
    if options.diagnose and len(source.effects):
        raise InputError(f"{options.policy}: was made in a world with effects; --diagnose starts from the bare system")
    if effects:
        source = source.with_effects(effects)
    _check_renderer(options, policy)
    references = read_reference(options.references, source.period) if options.references else None
    with checked():
        followed = references or getattr(getattr(target, "task", None), "references", None)
        setup_for(source, policy, options.renderer, followed)
    if options.round and options.round > options.samples:
        raise InputError(f"--round {options.round} is more than --samples {options.samples}: lower it, or raise those")
    folder = Path(options.out)
    settings = {name: value for name, value in vars(options).items() if name != "out"}
    for name in ("policy", "renderer", "references", "diagnosis", "map", "effects"):
        settings[f"{name} SHA-256"] = fingerprint(settings[name])
    open_run(folder, settings)
    with progress() as report:
        asked = {
            name: getattr(options, name) for name in ("seed", "iterations", "renderer", "with_history", "diagnose")
        }
        own: dict[str, Any] = {"references": references, "report": report, **asked}
        adapted = adapt(policy, source, target, options.samples, folder, round_samples=options.round, **own)
    rounds = [
        {"samples": each.samples, "policy_loss": each.policy[-1] if each.policy else None} for each in adapted.rounds
    ]
    write_json(folder / "ledger.json", {**asdict(adapted.ledger), "used": adapted.ledger.used, "rounds": rounds})
    if options.diagnose:
        print(_in_words(adapted.rounds[-1].explanation))
    print(f"{adapted.ledger.used} samples of {target.name} used; the policy is {folder / 'policy.safetensors'}")


def _in_words(explanation: Explanation) -> str:
    """The last diagnosis, and what followed from it."""
    causes = ", ".join(
        f"{effect.name} ({', '.join(f'{p.name} {_value(effect, p)}' for p in effect.table)})"
        f"{', slight' if effect.name in explanation.slight else ''}"
        for effect in sorted(explanation.effects, key=lambda effect: effect.name in explanation.slight)
    )
    if not explanation.complete:
        return f"{explanation.verdict}: a residual learnt the gap"
    return f"{explanation.verdict}: {causes}" if causes else f"{explanation.verdict}: the policy is left as it was"


def _value(effect: Effect, parameter: Parameter) -> str:
    return with_unit(number(float(effect.get_parameter(parameter.name).detach())), parameter.unit)


def _check_renderer(options: argparse.Namespace, policy: Policy) -> None:
    """Raises InputError where the policy was not trained through the renderer that it is to be adapted through."""
    if not isinstance(policy, ImagePolicy):
        if options.renderer:
            raise InputError(f"{options.policy}: is shown states, for which --renderer has no use: leave it out")
        return
    path = Path(options.renderer or shipped("renderer"))
    background, trained = load_renderer(path).state_dict().get("background"), policy.perception.background
    if background is None or background.shape != trained.shape or not torch.allclose(background.sigmoid(), trained):
        raise InputError(
            f"{options.policy}: was not trained with the renderer {path}: give by --renderer the one that it was "
            "trained with"
        )

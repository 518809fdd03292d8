"""The system and the effects that the arguments name, of which the simulator is made."""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from visadapt.cli.errors import InputError
from visadapt.diagnosis.saved import load_explanations
from visadapt.diagnosis.words import listed, printable, with_unit
from visadapt.effects import EFFECTS, Effect
from visadapt.effects.base import require_system
from visadapt.effects.catalogue import catalogue, sized
from visadapt.storage.run_folder import read_json
from visadapt.systems import SYSTEMS, System
from visadapt.systems.contract import complaints
from visadapt.systems.parameter_file import load_parameters
from visadapt.world import World


def given_system(options: argparse.Namespace) -> System:
    """The system of --system with the parameters of --params.

    Raises:
        InputError: a system of the user's own that is not what visadapt can work with.
        ParameterFileError: a parameter file that cannot be used.
    """
    if options.system not in SYSTEMS.values() and (wrong := complaints(options.system)):
        more = f" (and {len(wrong) - 1} more: `visadapt check` lists them)" if len(wrong) > 1 else ""
        raise InputError(f"{options.system.__name__}: {wrong[0]}{more}")
    return load_parameters(options.params, options.system) if getattr(options, "params", None) else options.system()


def given_effects(options: argparse.Namespace, system: System) -> list[Effect]:
    """The effects of --diagnosis but those that --effect gives too, then those of --effect.

    Raises:
        InputError: an unknown effect, one given twice or without its parameters, or one that does not act on the
            system.
        DiagnosisFileError: a diagnosis that named nothing.
    """
    catalogue(system)  # makes the effects of a system of one's own known, by which they are named
    effects: list[Effect] = []
    if options.diagnosis:
        effects, *others = load_explanations(options.diagnosis, system)
        if others:
            print(
                f"visadapt: {options.diagnosis}: ambiguous: the simulator has {_names(effects)}, not "
                f"{' or '.join(_names(each) for each in others)} (for others, give --effect without --diagnosis)",
                file=sys.stderr,
            )
        for warning in read_json(Path(options.diagnosis)).get("warnings") or ():
            print(f"visadapt: {options.diagnosis}: {printable(str(warning))}", file=sys.stderr)
    given = [_effect(text, system) for text in options.effect]
    names = [effect.name for effect in given]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"--effect: {twice[0]} is given more than once")
    return [effect for effect in effects if effect.name not in names] + given


def _names(effects: Sequence[Effect]) -> str:
    return listed([effect.name.replace("_", " ") for effect in effects])


def _effect(text: str, system: System) -> Effect:
    """The effect of an --effect, NAME:PARAMETER=VALUE,...; a value beyond what a diagnosis searches is remarked on."""
    name, _, rest = text.partition(":")
    if name not in EFFECTS or EFFECTS[name] not in catalogue():
        near = difflib.get_close_matches(name, [effect.name for effect in catalogue()], 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise InputError(f"--effect {text}: there is no effect {name!r}; {hint}`visadapt effects` lists them")
    try:
        require_system(system, EFFECTS[name])
    except TypeError as error:
        raise InputError(f"--effect {text}: {error}") from error
    values: dict[str, float] = {}
    for part in rest.split(",") if rest else ():
        parameter_name, _, number = part.partition("=")
        if parameter_name in values:
            raise InputError(f"--effect {text}: {parameter_name} is given twice")
        try:
            values[parameter_name] = float(number)
        except ValueError:
            raise InputError(f"--effect {text}: {part!r} is not of the form PARAMETER=NUMBER") from None
        if not abs(values[parameter_name]) < float("inf"):
            raise InputError(f"--effect {text}: {parameter_name} must be finite")
    try:
        effect = EFFECTS[name](**values)
        world = World(system, [effect])
        world.step(world.start(torch.zeros(1, len(system.states))), torch.zeros(1, len(system.actions)))
    except ValueError as error:
        raise InputError(f"--effect {text}: {error}") from error
    for parameter in sized(EFFECTS[name], system).table:
        value = values[parameter.name]
        if not parameter.low <= value <= parameter.high:
            given, high = (with_unit(f"{one:g}", parameter.unit) for one in (value, parameter.high))
            searched = f"a diagnosis looks for it from {parameter.low:g} to {high}"
            print(f"visadapt: --effect {text}: {parameter.name} is {given}; {searched}", file=sys.stderr)
    return effect

"""The effects that a world is given on the command line: by name and value, or by a diagnosis."""

from __future__ import annotations

import argparse
import difflib
from pathlib import Path
from typing import TYPE_CHECKING

from visadapt.cli.arguments import InputError
from visadapt.cli.user_files import import_effects

if TYPE_CHECKING:
    from visadapt.effects import Effect
    from visadapt.systems import System


def add_effects(parser: argparse.ArgumentParser) -> None:
    """Add --diagnosis, --effect and --effects."""
    parser.add_argument(
        "--diagnosis", metavar="D.json", help="put the effects into the simulator that `visadapt diagnose --json` named"
    )
    parser.add_argument(
        "--effect",
        metavar="NAME:PARAMETER=VALUE,...",
        action="append",
        default=[],
        help="put an effect into the simulator, as in viscous_friction:coefficient=2.1 (`visadapt effects` lists them "
        "with their units); may be repeated",
    )
    parser.add_argument("--effects", metavar="FILE.py", help="a file that defines effects of your own")


def given_effects(options: argparse.Namespace, system: System) -> list[Effect]:
    """The effects of --diagnosis, then those of --effect; call it before a policy is loaded that needs --effects.

    Raises:
        InputError: an unknown effect, one without its parameters, or one that does not act on the system.
        DiagnosisFileError: a diagnosis that named nothing.
    """
    from visadapt.diagnosis.saved import load_effects

    effects: list[Effect] = []
    if options.diagnosis:
        diagnosed, effects = load_effects(options.diagnosis)
        if diagnosed != system.name:
            raise InputError(f"{options.diagnosis}: a diagnosis of a {diagnosed}, where a {system.name} is given")
    return effects + [_effect(text, system) for text in options.effect]


def import_given(options: argparse.Namespace) -> None:
    """Import the file of --effects, if there is one: before anything that may name an effect of it."""
    if options.effects:
        import_effects(Path(options.effects))


def _effect(text: str, system: System) -> Effect:
    from visadapt.effects import EFFECTS
    from visadapt.effects.catalogue import catalogue

    name, _, rest = text.partition(":")
    if name not in EFFECTS or EFFECTS[name] not in catalogue():
        near = difflib.get_close_matches(name, [effect.name for effect in catalogue()], 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise InputError(f"--effect {text}: there is no effect {name!r}; {hint}`visadapt effects` lists them")
    if not isinstance(system, EFFECTS[name].systems):
        kinds = " or a ".join(kind.name for kind in EFFECTS[name].systems)
        raise InputError(f"--effect {text}: {name} acts on a {kinds}, not on a {system.name}")
    values: dict[str, float] = {}
    for part in rest.split(",") if rest else ():
        parameter, _, number = part.partition("=")
        try:
            values[parameter] = float(number)
        except ValueError:
            raise InputError(f"--effect {text}: {part!r} is not of the form PARAMETER=NUMBER") from None
        if not abs(values[parameter]) < float("inf"):
            raise InputError(f"--effect {text}: {parameter} must be finite")
    try:
        return EFFECTS[name](**values)
    except ValueError as error:
        raise InputError(f"--effect {text}: {error}") from error

"""Classes of the user's own: the system of `--system my_rig.py:Class`, the effects of `--effects my_rig.py`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from visadapt.cli.errors import InputError
from visadapt.cli.own_effects import effect_complaints
from visadapt.cli.user_code import import_file
from visadapt.effects import EFFECTS
from visadapt.systems import SYSTEMS, System


def find_system(text: str) -> type[System]:
    """The class of `my_rig.py:Class`; of `my_rig.py` alone, the only system that the file defines.

    Raises:
        InputError: no such file, a file that raises, no such class, or one that is not a System.
    """
    path, _, name = text.partition(":") if ".py:" in text else (text, "", "")
    module = import_file(path)
    own = [
        each.__name__
        for each in vars(module).values()
        if isinstance(each, type) and issubclass(each, System) and each.__module__ == module.__name__
    ]
    there = f"its systems are {', '.join(own)}" if own else "it has no class that derives from visadapt.System"
    if not name and len(own) != 1:
        raise InputError(f"{path}: {there}; {path}:{own[0] if own else 'MyRig'} would name one")
    found = getattr(module, name or own[0], None)
    if found is None:
        raise InputError(f"{path}: has no class {name!r}; {there}")
    if not isinstance(found, type) or not issubclass(found, System):
        raise InputError(f"{path}: {name} is no visadapt.System; `class {name}(visadapt.System)` would be right")
    return found


def import_effects(options: argparse.Namespace) -> None:
    """Import the file of --effects, if one is given; must be called before an effect is looked up by its name.

    The effects in the file register themselves when it is imported.

    Raises:
        InputError: the file is missing, is not Python, or raises (the message names the line); or it defines no effect
            that acts on the system of --system, or an effect that `cli.own_effects` finds fault with.
    """
    if not options.effects:
        return
    system = getattr(options, "system", None)
    module = sys.modules.get(system.__module__) if system else None
    # A file that has the system too was imported with it: run again, it would define another class of the same name.
    if module is None or getattr(module, "__file__", None) != str(Path(options.effects).absolute()):
        module = import_file(options.effects)
    own = [effect for effect in EFFECTS.values() if effect.__module__ == module.__name__]
    if not own:
        raise InputError(f"{options.effects}: defines no effect: a class with a name that derives from visadapt.Effect")
    for effect in own:
        for kind in [system] if system else SYSTEMS.values():
            if issubclass(kind, effect.systems) and (wrong := effect_complaints(effect, kind())):
                raise InputError(f"{options.effects}: {effect.__name__}: {wrong[0]}")
    if system and not any(issubclass(system, effect.systems) for effect in own):
        raise InputError(f"{options.effects}: none of its effects acts on a {system.name}")

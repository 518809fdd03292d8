"""A system of the user's own: the class that `--system my_rig.py:Class` names."""

from __future__ import annotations

from visadapt.cli.inputs import InputError, import_file
from visadapt.systems import System


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

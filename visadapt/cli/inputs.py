"""What the arguments of subcommands name: systems, effects, the user's own Python, and the folder of a training."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import hashlib
import importlib
import importlib.util
import shutil
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from visadapt.cli.own_effects import complaints as complaints_of_effect
from visadapt.diagnosis.saved import load_effects
from visadapt.diagnosis.words import printable, with_unit
from visadapt.effects import EFFECTS, Effect
from visadapt.effects.base import require_system
from visadapt.effects.catalogue import catalogue, sized
from visadapt.progress import Report, reporting
from visadapt.storage.run_folder import open_run, read_json
from visadapt.systems import SYSTEMS, System
from visadapt.systems.contract import complaints
from visadapt.systems.parameter_file import load_parameters
from visadapt.world import World

OWN_FILES: set[str] = set()
"""Files of the user's whose code is run."""
OWN_FOLDERS: set[Path] = set()
"""Folders where these may have imported other files of the user's from."""
LIBRARIES = {
    *(Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib")),
    *(Path(__file__).parents[2] / package for package in ("visadapt", "renderers")),
}
"""Folders in whose code an error is not the user's, wherever they lie."""


class InputError(ValueError):
    """An argument that cannot be used; the message is one line: what, where, and what would be right."""


@contextmanager
def checked() -> Iterator[None]:
    """Turn the ValueError or TypeError by which the library refuses an argument into an InputError.

    One that the user's own code raised names the line there.
    """
    try:
        yield
    except (ValueError, TypeError) as error:
        raise InputError(own_line(error) or str(error)) from error


@contextmanager
def progress() -> Iterator[Report]:
    """A report of progress on stderr, where everything goes that is printed meanwhile: stdout is for results."""
    with contextlib.redirect_stdout(sys.stderr), reporting() as report:
        yield report


@contextmanager
def unfinished(out: Path, settings: Mapping[str, Any]) -> Iterator[Path]:
    """The folder `<out>.unfinished` that a training works in, and goes on from; removed when the block ends.

    Raises:
        InputError: `out` is there already, or is a folder; or what lies in the folder is no training.
        RunError: the folder holds a training with other settings.
    """
    if out.exists():
        raise InputError(f"{out} is there already: remove it, or name another file by --out")
    folder = out.with_name(out.name + ".unfinished")
    check_run_folder(folder)
    open_run(folder, settings)
    yield folder
    shutil.rmtree(folder)


def check_run_folder(folder: Path) -> None:
    """Raises InputError where files lie in the folder of a run that are not a run's, and would be replaced."""
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "settings.json").exists():
        raise InputError(f"{folder} has files in it that are no run of visadapt: name another by --out")


def asked_for(options: argparse.Namespace, *files: str) -> dict[str, Any]:
    """The settings of a run: it is resumed only if they are the same.

    These are all options but --out. In place of the options in `files`, which name a file or a list of files, stands
    the SHA-256 of each file, so that the files may be moved.
    """
    settings = {name: value for name, value in vars(options).items() if name != "out"}
    for name in files:
        given = settings[name]
        settings[name] = [_fingerprint(path) for path in given] if isinstance(given, list) else _fingerprint(given)
    return settings


def _fingerprint(path: str | Path | None) -> str | None:
    return None if path is None else hashlib.sha256(Path(path).read_bytes()).hexdigest()


def the_system(options: argparse.Namespace) -> System:
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
    effects: list[Effect] = []
    if options.diagnosis:
        diagnosed, effects = load_effects(options.diagnosis)
        if diagnosed != system.name:
            raise InputError(f"{options.diagnosis}: a diagnosis of a {diagnosed}, where a {system.name} is given")
        for warning in read_json(Path(options.diagnosis)).get("warnings") or ():
            print(f"visadapt: {options.diagnosis}: {printable(str(warning))}", file=sys.stderr)
    given = [_effect(text, system) for text in options.effect]
    names = [effect.name for effect in given]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"--effect: {twice[0]} is given more than once")
    return [effect for effect in effects if effect.name not in names] + given


def _effect(text: str, system: System) -> Effect:
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
        asked, _, number = part.partition("=")
        if asked in values:
            raise InputError(f"--effect {text}: {asked} is given twice")
        try:
            values[asked] = float(number)
        except ValueError:
            raise InputError(f"--effect {text}: {part!r} is not of the form PARAMETER=NUMBER") from None
        if not abs(values[asked]) < float("inf"):
            raise InputError(f"--effect {text}: {asked} must be finite")
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
            if issubclass(kind, effect.systems) and (wrong := complaints_of_effect(effect, kind())):
                raise InputError(f"{options.effects}: {effect.__name__}: {wrong[0]}")
    if system and not any(issubclass(system, effect.systems) for effect in own):
        raise InputError(f"{options.effects}: none of its effects acts on a {system.name}")


def import_file(given: str) -> ModuleType:
    """The module in a file of the user's.

    Raises:
        InputError: the file is missing, no Python, or raises; names its line.
    """
    path = Path(given).absolute()  # as Python's own messages name it
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    # Under a name of its own, by which worker processes find its classes.
    name = f"visadapt_own_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: not a Python file; a name that ends in .py is right")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    OWN_FILES.add(str(path))
    OWN_FOLDERS.add(path.parent)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # for the files beside it; last, so that none of them hides a library
    with own_code(lambda error: f"{path}: {describe(error, str(path))}"):
        spec.loader.exec_module(module)
    sys.modules.setdefault(path.stem, module)  # so that another file of the user's that imports it gets these classes
    return module


@contextmanager
def own_code(message: Callable[[BaseException], str]) -> Iterator[None]:
    """Turn what code of the user's raises, which may be anything, into an InputError."""
    try:
        yield
    except (KeyboardInterrupt, InputError):
        raise
    except BaseException as error:
        raise InputError(message(error)) from error


def find_factory(name: str) -> Callable[[], Any]:
    """What `package.module:factory` names; modules in the current directory are found too."""
    module_name, _, attribute = name.partition(":")
    module_name = module_name.removesuffix(".py")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(module_name)
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing and f"{module_name}.".startswith(f"{missing}."):
            raise InputError(f"{name}: there is no module {missing!r}, installed or in {here}") from error
        raise InputError(f"{name}: {describe(error)}") from error
    OWN_FILES.add(str(module.__file__))
    OWN_FOLDERS.update((Path(here), Path(str(module.__file__)).parent))
    factory = getattr(module, attribute, None)
    if not callable(factory):
        what = "nothing" if factory is None else f"a {type(factory).__name__}, not a function,"
        raise InputError(f"{name}: {module.__file__} has {what} called {attribute!r}")
    return factory


def own_line(error: BaseException) -> str | None:
    """The message for an error that the user's own code raised; None where it was ours."""
    files = [frame.filename for frame in traceback.extract_tb(error.__traceback__) if _is_own(frame.filename)]
    return f"{files[-1]}: {describe(error, files[-1])}" if files else None


def _is_own(file: str) -> bool:
    folders = Path(file).parents
    return file in OWN_FILES or (not OWN_FOLDERS.isdisjoint(folders) and LIBRARIES.isdisjoint(folders))


def describe(error: BaseException, path: str | None = None) -> str:
    """An exception of a user's Python in one line, with the line of `path`, or of the file that raised it."""
    if isinstance(error, SyntaxError):
        where = "" if path else f"{error.filename}: "
        return f"{where}line {error.lineno}: {type(error).__name__}: {error.msg}"
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if path in (None, frame.filename)]
    where = "" if not own else f"line {own[-1].lineno}: " if path else f"{own[-1].filename}, line {own[-1].lineno}: "
    text = "it ends the program" if isinstance(error, SystemExit) else " ".join(str(error).split())
    return f"{where}{type(error).__name__}: {text}"

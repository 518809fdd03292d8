"""The effects that a diagnosis named, from the JSON file that it was saved as."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from visadapt.diagnosis.explanations import preferred
from visadapt.diagnosis.result import SCHEMA_VERSION, Cause, Estimate, named_effects
from visadapt.effects import EFFECTS, Effect
from visadapt.effects.catalogue import catalogue
from visadapt.systems import System

READABLE = (1, SCHEMA_VERSION)  # Versions of the file in which the causes have the same meaning


class DiagnosisFileError(ValueError):
    """A file of a diagnosis that gives no effects; the message is one line that says which and why."""


def load_effects(path: str | os.PathLike[str], system: System) -> list[Effect]:
    """The effects that a saved diagnosis of a system named, as `Diagnosis.effects` gives them.

    Args:
        path: what `visadapt diagnose --json` wrote, or `json.dump` of `Diagnosis.to_json()`.
        system: whose effects they are.

    Raises:
        DiagnosisFileError: the file is missing or holds no diagnosis, it is one of another system, it named no effect,
            or one that is not known here or whose value the recording left open.

    >>> import json, pathlib, tempfile, torch, visadapt as va
    >>> target, policy = va.SyntheticTarget(va.constant_force(2.0)), va.load_policy(va.shipped("cartpole_states"))
    >>> runs = va.run(target, policy, 2, 30, torch.Generator().manual_seed(0), exploration=0.3)
    >>> path, system = pathlib.Path(tempfile.mkdtemp()) / "run.h5", va.CartPole()
    >>> va.write_recording(path, [run.episode for run in runs], ["x", "x_dot", "theta", "theta_dot"], ["command"])
    >>> run = va.load_recording(path, system)
    >>> found = va.diagnose(run, va.World(system), catalogue=[va.effects.ConstantForce])
    >>> _ = path.with_suffix(".json").write_text(json.dumps(found.to_json()))
    >>> [effect.name for effect in va.load_effects(path.with_suffix(".json"), system)]
    ['constant_force']
    """
    return load_explanations(path, system)[0]


def load_explanations(path: str | os.PathLike[str], system: System) -> list[list[Effect]]:
    """The effects of each explanation that a saved diagnosis gives, that of `load_effects` first; several where it is
    ambiguous.

    Raises:
        DiagnosisFileError: as `load_effects`.
    """
    catalogue(system)  # makes the effects of a system of one's own known, by which a file names them
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise DiagnosisFileError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise DiagnosisFileError(f"{path}: not JSON: {error}") from error
    if not isinstance(content, dict) or content.get("schema") not in READABLE:
        raise DiagnosisFileError(
            f"{path}: no diagnosis of version 1 to {SCHEMA_VERSION}, such as `visadapt diagnose --json` writes"
        )
    try:
        if content["system"] != system.name:
            raise ValueError(f"a diagnosis of a {content['system']}, where a {system.name} is given")
        causes = tuple(_cause(each) for each in content["causes"])
        for cause in causes:
            if cause.effect not in EFFECTS:
                raise ValueError(f"names {cause.effect}, which is not known here: give the file that defines it")
        ranking = ((one["effects"], float(one["probability"])) for one in content.get("ranking", ()))
        first, *others = preferred(causes, ranking)
        known = [one for one in others if all(math.isfinite(e.value) for c in one for e in c.parameters.values())]
        return [named_effects(content["verdict"], one) for one in (first, *known)]
    except (KeyError, TypeError, AttributeError) as error:
        raise DiagnosisFileError(f"{path}: not a whole diagnosis: {error}") from error
    except (ValueError, OverflowError) as error:
        raise DiagnosisFileError(f"{path}: {error}") from error


def _cause(content: Mapping[str, Any]) -> Cause:
    values = {
        name: Estimate(math.nan if one["value"] is None else float(one["value"]), one["unit"], (math.nan, math.nan))
        for name, one in content["parameters"].items()
    }
    return Cause(
        content["effect"], values, math.nan, math.nan, indistinguishable_from=tuple(content["indistinguishable_from"])
    )

"""The effects that come nearest to a gap that a diagnosis leaves unexplained, and what of them an adaptation uses."""

from __future__ import annotations

import math
from pathlib import Path

from visadapt.diagnosis import Diagnosis
from visadapt.diagnosis.explanations import first_explanation
from visadapt.diagnosis.result import UNEXPLAINED
from visadapt.diagnosis.saved import DiagnosisFileError
from visadapt.effects import EFFECTS, ActuationEffect, DynamicsEffect, Effect
from visadapt.effects.base import Role
from visadapt.effects.catalogue import catalogue
from visadapt.storage.run_folder import read_json, write_json
from visadapt.systems import System

WORTH_USING = 0.9
"""Share of the gap, on held-out episodes, that the nearest effects must close for a residual to learn only the rest. Of
dry friction that creeps at low speed, which stays unexplained, Coulomb's closes 99.8 %."""

PASSING = (Role.START, Role.END, Role.FREQUENCY)  # Of parameters of what acts at its own times, or in a region


def keep_nearest(found: Diagnosis, path: Path) -> None:
    """Write the nearest effects of an unexplained gap beside the diagnosis that is kept at `path`, if they are of use:
    if they close nearly all of it, always act, and are none of a sensor, since by its readings a policy is judged."""
    causes = first_explanation(found.partial)
    kinds = [EFFECTS[cause.effect] for cause in causes]
    steady = all(
        issubclass(kind, DynamicsEffect | ActuationEffect) and not any(p.role in PASSING for p in kind.table)
        for kind in kinds
    )
    values = {cause.effect: {name: one.value for name, one in cause.parameters.items()} for cause in causes}
    known = all(math.isfinite(value) for each in values.values() for value in each.values())
    closed = causes[0].gap_closed if len(causes) == 1 else found.gap.closed
    if found.verdict == UNEXPLAINED and kinds and steady and known and closed >= WORTH_USING:
        write_json(_beside(path), values)


def kept_nearest(path: Path, system: System) -> list[Effect]:
    """The effects on the system that `keep_nearest` wrote beside the diagnosis at `path`; none, if it wrote none.

    Raises:
        DiagnosisFileError: one of them is not known here.
    """
    if not _beside(path).exists():
        return []
    by_name = {effect.name: effect for effect in catalogue(system)}
    content = read_json(_beside(path))
    for name in content:
        if name not in by_name:
            raise DiagnosisFileError(f"{_beside(path)}: names {name}, which is not known here")
    return [by_name[name](**values) for name, values in content.items()]


def _beside(path: Path) -> Path:
    return path.with_name("nearest.json")

"""What to record next to settle what a recording leaves open."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from visadapt.diagnosis.report.text import listed
from visadapt.effects import Effect, Stage
from visadapt.effects.catalogue import separable
from visadapt.estimation.profiles import SystemProfile, profile_of
from visadapt.systems import System

BY_STAGE: dict[Stage, str] = {
    Stage.ACTUATION: "steps and chirps of the command over its whole range",
    Stage.DYNAMICS: "free motions with the motor off, slow and fast, over the whole track",
    Stage.SENSING: "known positions and angles, set by hand and held still",
}

IN_FLIGHT = {Stage.DYNAMICS: "slow and fast flights in all directions, at several heights, with and without turns"}
"""The same for a vehicle, where it differs."""


def separate(classes: Sequence[Collection[type[Effect]]], system: System) -> str:
    """The experiments that tell the members of every class apart; empty where each has only one."""
    parts = []
    for members in classes:
        by_name = {effect.name: effect for effect in members}
        names = sorted(by_name)
        experiments = [
            experiment
            for name in names
            for other, experiment in by_name[name].settled_by.items()
            if other in by_name and not separable(by_name[name], by_name[other], system)
        ]
        if len(names) > 1:
            advice = experiments or [_general(members, profile_of(system))]
            parts.append(f"To tell {listed(names)} apart: " + "; ".join(advice) + ".")
    return " ".join(parts)


def explain(port: str, variable: str) -> str:
    """What shows more of something that no effect of the catalogue explains."""
    return (
        f"What is left enters as {port.replace('_', ' ')} and goes with {variable.replace('_', ' ')}: record runs that "
        f"cover the whole range of {variable.replace('_', ' ')} slowly and fast, with the rest as still as can be, and "
        "add an effect of your own for it (--effects)."
    )


def more(profile: SystemProfile) -> str:
    """What would show a gap where none was seen."""
    return (
        "Nothing departs from the source beyond the noise. A gap that shows only elsewhere needs other motions: larger "
        f"commands, higher speeds, other {'winds and heights' if profile.flies else 'parts of the track'}."
    )


def _general(members: Collection[type[Effect]], profile: SystemProfile) -> str:
    motions = BY_STAGE | (IN_FLIGHT if profile.flies else {})
    stages = sorted({effect.stage for effect in members})
    return "record " + ", then ".join(motions[stage] for stage in stages if stage in motions)

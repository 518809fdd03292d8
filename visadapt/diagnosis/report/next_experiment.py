"""What to record next to settle what a recording leaves open."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from visadapt.diagnosis.report.text import listed
from visadapt.effects import Effect, Stage
from visadapt.estimation.profiles import SystemProfile

SETTLES: dict[frozenset[str], str] = {
    frozenset({"constant_force", "actuator_bias"}): (
        "switch the motor off, let the cart stand with the pole hanging or removed, and measure the force on it with a "
        "spring balance: a constant force is still there, an actuator bias is gone"
    ),
    frozenset({"actuator_delay", "measurement_delay"}): (
        "time command and sensor against one clock: film the cart beside a lamp that lights with the command; a late "
        "motion is the actuator's delay, a late reading of it the sensor's"
    ),
    frozenset({"actuator_delay", "actuator_lag"}): (
        "record steps of the command, large and held for half a second, at the highest rate that the sensors have: "
        "after a delay the acceleration jumps, after a lag it creeps up"
    ),
    frozenset({"thrust_gain", "payload"}): (
        "weigh the vehicle: a payload is on the scales, a thrust that is off is not"
    ),
    frozenset({"actuator_gain", "cart_mass"}): (
        "push the cart by hand with the motor off, or weigh it: a heavier cart accelerates less under any force, a "
        "weaker motor only under its own"
    ),
    frozenset({"viscous_friction", "quadratic_drag"}): "record faster motions: drag grows with the square of the speed",
    frozenset({"viscous_friction", "coulomb_friction"}): (
        "record slow reversals and fast runs: dry friction is as large at any speed and stops the cart near standstill"
    ),
    frozenset({"track_tilt", "angle_offset"}): (
        "turn the rig round by 180 degrees on the table and record again: a tilt changes its sign, an offset does not"
    ),
}
"""Pairs of effects and what tells them apart."""

BY_STAGE: dict[Stage, str] = {
    Stage.ACTUATION: "steps and chirps of the command over its whole range",
    Stage.DYNAMICS: "free motions with the motor off, slow and fast, over the whole track",
    Stage.SENSING: "known positions and angles, set by hand and held still",
}

IN_FLIGHT = {Stage.DYNAMICS: "slow and fast flights in all directions, at several heights, with and without turns"}
"""The same for a vehicle, where it differs."""


def separate(classes: Sequence[Collection[type[Effect]]], profile: SystemProfile) -> str:
    """What tells the members of every class apart; empty where each has only one."""
    parts = []
    for members in classes:
        names = {effect.name for effect in members}
        known = [text for pair, text in SETTLES.items() if pair <= names and pair not in profile.separable]
        if len(names) > 1:
            told = known or [_general(members, profile)]
            parts.append(f"To tell {listed(sorted(names))} apart: " + "; ".join(told) + ".")
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
    told = BY_STAGE | (IN_FLIGHT if profile.flies else {})
    stages = sorted({effect.stage for effect in members})
    return "record " + ", then ".join(told[stage] for stage in stages if stage in told)

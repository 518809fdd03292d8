"""Scores of answers to blind recordings (the JSON of docs/diagnosis.md) against the sealed key.

An answer names classes of effects. With the verdict `identified` each cause is a class; with `ambiguous`, causes listed
as indistinguishable from one another form a class, one member of which is claimed to act. A true effect is found if a
class of at most 3 contains it; several true effects need a class each.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any

from datasets.blind.kinds import STRIBECK
from visadapt.effects import EFFECTS, Role
from visadapt.estimation.profiles import PROFILES

LARGEST_CLASS = 3

Answer = dict[str, Any]


@dataclass(frozen=True)
class Truth:
    """One recording's line in the key."""

    kind: str
    """single, pair, triple, none (that a recording could show) or foreign"""
    effects: dict[str, dict[str, float]]
    """parameters by effect"""
    strengths: dict[str, float]
    """by effect, in units of the noise"""

    @classmethod
    def of(cls, recording: dict[str, Any]) -> Truth:
        """From the key's JSON."""
        effects = {e["effect"]: _as_in_the_catalogue(e["effect"], e["parameters"]) for e in recording["effects"]}
        # An effect that was foreign when the set was made, and has joined the catalogue since, is to be found.
        kind = "single" if recording["kind"] == "foreign" and effects.keys() <= EFFECTS.keys() else recording["kind"]
        return cls(kind, effects, {e["effect"]: e["strength"] for e in recording["effects"]})


@dataclass
class Score:
    """One answer against its truth. None: does not apply."""

    kind: str
    """of the truth"""
    verdict: str
    """of the answer"""
    found: bool | None = None
    """whether every true effect has a class (named kinds only)"""
    exact: bool | None = None
    """whether, besides, there is no other class but slight ones"""
    stage: bool | None = None
    """whether classes and true effects pair up, slight classes aside, so that each class has an effect of its partner's
    stage"""
    top3: bool | None = None
    """whether the true set is among the first three of the ranking"""
    strength: float | None = None
    """of a single or foreign effect"""
    closed: float | None = None
    """gap.closed of an identified answer"""
    probability: float | None = None
    """of the ranking's first set"""
    first_right: bool | None = None
    """whether that set is the true one, or of its class"""
    errors: list[float] = field(default_factory=list)
    """|estimate - truth| / |truth| of the sizes of correctly named causes"""
    deviations: list[float] = field(default_factory=list)
    """the same relative to the truth's distance from its neutral value; differs where that is not 0"""
    covered: list[bool] = field(default_factory=list)
    """whether a 90 % interval contains the truth, for every parameter of correctly named causes"""
    overlaps: list[float] = field(default_factory=list)
    """intersection over union of the region of a patch, gust or frozen zone with the answer's; 0 if it has none"""
    pushed: bool | None = None
    """whether the answer tells of a push where there is none: neither a gust nor a foreign effect"""


def _as_in_the_catalogue(effect: str, parameters: dict[str, float]) -> dict[str, float]:
    """Parameters under the catalogue's names."""
    if effect == STRIBECK:
        force = parameters["force"]
        return {"force": 0.1 * force, "breakaway": force, "velocity": parameters["speed"]}
    return parameters


def classes(answer: Answer) -> list[set[str]]:
    """The sets of effects that the answer names; it claims that one of each acts."""
    if answer["verdict"] not in ("identified", "ambiguous"):
        return []
    merged: list[set[str]] = []
    for cause in answer["causes"]:
        own = {cause["effect"]}
        if answer["verdict"] == "ambiguous" or cause.get("slight"):
            own |= set(cause.get("indistinguishable_from") or ())
        for other in [other for other in merged if other & own]:
            merged.remove(other)
            own |= other
        merged.append(own)
    return merged


def sizes(effect: str) -> dict[str, float]:
    """The parameters that say how large an effect is, those of one unit, with their values where it does nothing."""
    strengths = [parameter for parameter in EFFECTS[effect].table if parameter.is_strength]
    return {p.name: p.neutral for p in strengths if p.unit == strengths[0].unit and p.neutral is not None}


def region_of(effect: str) -> tuple[str, str, str] | None:
    """For an effect that acts in a region: the variable along which it lies, and the parameters of start and end."""
    edges = EFFECTS[effect].region()
    if edges is None:
        return None
    places = next(
        profile.region_variables for kind, profile in PROFILES.items() if issubclass(kind, EFFECTS[effect].systems)
    )
    return places[edges[0].unit], edges[0].name, edges[1].name


def _is_a_push(effect: str) -> bool:
    """Whether the effect acts for a stretch of time."""
    region = region_of(effect)
    return region is not None and region[0] == "time"


def matches(effects: set[str], groups: list[set[str]]) -> bool:
    """Whether every effect is in a class of its own that is small enough."""
    return _one_each(sorted(effects), [group for group in groups if len(group) <= LARGEST_CLASS])


def stages_match(effects: set[str], groups: list[set[str]]) -> bool:
    """Whether the classes are of the stages of the effects, one each."""
    stages = [{EFFECTS[name].stage for name in group} for group in groups]
    return len(groups) == len(effects) and _one_each([EFFECTS[name].stage for name in effects], stages)


def _one_each(wanted: Sequence[str], groups: Sequence[Collection[str]]) -> bool:
    """Whether each of `wanted` is in a group of its own."""
    return any(
        all(each in group for each, group in zip(wanted, order, strict=True))
        for order in permutations(groups, len(wanted))
    )


def score(truth: Truth, answer: Answer) -> Score:
    """Score one answer."""
    result = Score(truth.kind, answer["verdict"])
    if truth.kind in ("single", "foreign"):
        result.strength = next(iter(truth.strengths.values()))
    if answer["verdict"] == "identified":
        result.closed = (answer.get("gap") or {}).get("closed")
    # An effect that no recording can show is not to be found.
    groups, effects = classes(answer), set() if truth.kind == "none" else set(truth.effects)
    if truth.kind != "foreign" and not any(_is_a_push(effect) for effect in effects):
        result.pushed = bool((answer.get("where") or {}).get("pushes"))
    ranking = answer.get("ranking") or []
    if truth.kind != "foreign" and ranking and ranking[0].get("probability") is not None:
        result.probability = float(ranking[0]["probability"])
        first = set(ranking[0]["effects"])
        # A first set that differs from the true one within the answer's classes counts as right.
        right = bool(effects) and len(groups) == len(effects) == len(first) and matches(effects, groups)
        result.first_right = first == effects or (right and matches(first, groups))
    if truth.kind in ("none", "foreign"):
        return result
    result.found = matches(effects, groups)
    carrying = {cause["effect"] for cause in answer["causes"] if not cause.get("slight")}
    result.exact = result.found and all(group & effects or not group & carrying for group in groups)
    result.stage = stages_match(effects, [group for group in groups if group & carrying])
    result.top3 = any(set(entry["effects"]) == effects for entry in ranking[:3])
    if groups:
        for cause in answer["causes"]:
            if cause["effect"] in effects:
                _parameters(result, cause, truth.effects[cause["effect"]])
    for effect in sorted(effects):
        if (region := region_of(effect)) is not None:
            variable, *edges = region
            start, end = (truth.effects[effect][edge] for edge in edges)
            result.overlaps.append(_overlap(answer, variable, start, end))
    return result


def _parameters(result: Score, cause: dict[str, Any], true: dict[str, float]) -> None:
    neutral = sizes(cause["effect"])
    # Of several sizes, the one furthest from its neutral value.
    name = max(neutral, key=lambda n: abs(true[n] - neutral[n]), default="")
    phases = {p.name for p in EFFECTS[cause["effect"]].table if p.role is Role.PHASE}
    for parameter, estimate in cause["parameters"].items():
        if parameter not in true or estimate.get("value") is None:
            continue
        value, truth = float(estimate["value"]), true[parameter]
        if parameter == name and truth not in (0.0, neutral[name]):
            result.errors.append(abs(value - truth) / abs(truth))
            result.deviations.append(abs(value - truth) / abs(truth - neutral[name]))
        interval = estimate.get("ci90")
        if interval and None not in interval:
            low, high = interval
            if parameter in phases:
                # Modulo a turn: the value nearest to the interval.
                truth += 2 * math.pi * round(((low + high) / 2 - truth) / (2 * math.pi))
            result.covered.append(bool(low <= truth <= high))


def _overlap(answer: Answer, variable: str, start: float, end: float) -> float:
    """Intersection over union with the answer's region of that variable that has the largest share of the gap."""
    regions = (answer.get("where") or {}).get("regions") or []
    own = [region for region in regions if region["variable"] == variable]
    if not own:
        return 0.0
    best = max(own, key=lambda region: region.get("share") or 0.0)
    common = min(best["to"], end) - max(best["from"], start)
    whole = max(best["to"], end) - min(best["from"], start)
    return max(0.0, common) / whole if whole > 0 else 0.0

"""The causes of a gap as the result states them: parameters with intervals, probabilities, and what else would do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from visadapt.diagnosis.result import Cause, Estimate, Ranked
from visadapt.diagnosis.search.model_comparison import ModelComparison, Weighed, exchanged
from visadapt.diagnosis.search.search import ScoredModel, Search
from visadapt.effects import Effect, Parameter, Role
from visadapt.effects.catalogue import twins
from visadapt.estimation.fit_states import posterior
from visadapt.estimation.grids import spans
from visadapt.systems import System

NINETY = 1.6449
"""Deviations to either side that hold 90 % of a normal distribution."""

Closing = Mapping[frozenset[str], float]
"""Share of the gap that a set closes on held-out episodes, by its names."""


@dataclass(frozen=True)
class Named:
    """An effect that may stand in one place of the best set."""

    effect: type[Effect]
    weighed: Weighed
    """the set with it"""
    canonical: type[Effect]
    """the effect that was fitted in its place: itself, or its twin"""


def classes(comparison: ModelComparison, effects: Sequence[type[Effect]], system: System) -> list[list[Named]]:
    """For each place of the best set, the effects that fit as well there, the best first, twins behind each other."""
    out = []
    for effect, rivals in comparison.classes.items():
        here = [(effect, comparison.weighed[0])]
        here += [(exchanged(comparison.best.effects, rival.fitted.effects), rival) for rival in rivals]
        members = [Named(twin, weighed, own) for own, weighed in here for twin in [own, *twins(own, effects, system)]]
        out.append([member for member in members if member.effect in effects])
    return out


def causes(
    search: Search, comparison: ModelComparison, places: Sequence[Sequence[Named]], closing: Closing
) -> list[Cause]:
    """Every member of every class as a cause."""
    out = []
    for place in places:
        names = [member.effect.name for member in place]
        for member in place:
            own = estimates(search, member.weighed.fitted, member.canonical)
            out.append(
                Cause(
                    member.effect.name,
                    own if member.effect is member.canonical else _twin(search, member, own),
                    _probability(comparison, member, place),
                    closing.get(frozenset({member.canonical.name}), math.nan),
                    tuple(name for name in names if name != member.effect.name),
                )
            )
    return out


def _probability(comparison: ModelComparison, member: Named, place: Sequence[Named]) -> float:
    """Of the effect, over all sets weighed; twins share it evenly."""
    alike = sum(other.canonical is member.canonical for other in place)
    return sum(w.probability for w in comparison.weighed if member.canonical in w.fitted.effects) / alike


def _twin(search: Search, member: Named, own: Mapping[str, Estimate]) -> Mapping[str, Estimate]:
    """The parameters that make a twin do the same."""
    if [(p.name, p.unit) for p in member.effect.table] == [(p.name, p.unit) for p in member.canonical.table]:
        return own
    fitted = search.exchange(member.weighed.fitted, member.canonical, member.effect)
    return estimates(search, fitted, member.effect)


def estimates(search: Search, fitted: ScoredModel, effect: type[Effect]) -> dict[str, Estimate]:
    """Maximum likelihood estimates of one effect's parameters, with 90 % intervals from Fisher's information."""
    _, whole = posterior(fitted.effects, fitted.fits)
    deviation = torch.linalg.inv(whole).diagonal().sqrt()
    first = sum(len(e.table) for e in fitted.effects[: fitted.effects.index(effect)])
    seen = spans(search.system, search.rows, fitted.fits.state[0])
    out = {}
    for k, parameter in enumerate(effect.table, first):
        out[parameter.name] = _estimate(parameter, float(fitted.fits.theta[0, k]), float(deviation[k]), seen)
    return out


def _estimate(
    parameter: Parameter, value: float, deviation: float, seen: Mapping[str, tuple[float, float]]
) -> Estimate:
    low, high = value - NINETY * deviation, value + NINETY * deviation
    if parameter.role is Role.PHASE:
        turn = 2 * math.pi * round(value / (2 * math.pi))
        return Estimate(value - turn, parameter.unit, (low - turn, high - turn))
    if parameter.is_edge:
        # A region that goes beyond where the data are ends somewhere there.
        first, last = seen.get(parameter.unit, (parameter.low, parameter.high))
        if value < first:
            return Estimate(first, parameter.unit, (parameter.low, first))
        if value > last:
            return Estimate(last, parameter.unit, (last, parameter.high))
    return Estimate(value, parameter.unit, (max(low, parameter.low), min(high, parameter.high)))


def ranking(
    comparison: ModelComparison,
    effects: Sequence[type[Effect]],
    system: System,
    closing: Closing,
    held: Sequence[Cause],
) -> tuple[Ranked, ...]:
    """All sets weighed, each twin on its own, the most probable first; what is held for sure is in all of them."""
    sure = tuple(cause.effect for cause in held)
    out = []
    for weighed in comparison.weighed:
        versions: list[tuple[str, ...]] = [()]
        for effect in weighed.fitted.effects:
            alike = [e.name for e in [effect, *twins(effect, effects, system)] if e in effects]
            versions = [(*version, name) for version in versions for name in alike]
        for version in versions:
            share = weighed.probability / len(versions)
            out.append(Ranked((*sure, *version), share, closing.get(frozenset(weighed.fitted.names), math.nan)))
    return tuple(sorted(out, key=lambda ranked: -ranked.probability))


def stage_shares(search: Search, comparison: ModelComparison, held_costs: Sequence[float]) -> dict[str, float]:
    """Share of the explained gap by stage: the log likelihood lost when each cause is taken away.

    `held_costs` are those of held readings.
    """
    shares = {"actuation": 0.0, "dynamics": 0.0, "sensing": 0.0, "camera": 0.0}
    best = comparison.best
    for effect in best.effects:
        without = search.fitted.get(frozenset(best.names) - {effect.name}, search.source)
        lost = max(0.0, float(best.fits.likelihood[0] - without.fits.likelihood[0]))
        shares[effect.stage.value] = shares.get(effect.stage.value, 0.0) + lost
    shares["sensing"] += sum(held_costs)
    whole = sum(shares.values())
    return {stage: share / whole if whole > 0 else 0.0 for stage, share in shares.items()}

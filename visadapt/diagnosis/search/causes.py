"""The causes of a gap as the result states them: parameters with intervals, probabilities, and alternatives."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.diagnosis.result import Cause, Estimate, Ranked
from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.diagnosis.search.model_comparison import ComparedModel, ModelComparison
from visadapt.diagnosis.search.search import Search
from visadapt.effects import Effect, Parameter, Role, Stage
from visadapt.effects.catalogue import twins
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.covariance import deviations
from visadapt.estimation.episode_phases import has_episode_phases, with_common_phase
from visadapt.estimation.grids import spans
from visadapt.systems import System

Z_90 = 1.6449  # Half-width of a normal distribution's 90 % interval, in standard deviations

SLIGHT = 0.01
"""Share of the gap that must open again without a cause for the verdict to rest on it."""

AT_BOUND = 1e-3  # Distance from an end of its range, as a share of it, within which a strength is at that end

NEGLIGIBLE = 0.01  # Probability of a set up to which it does not widen the intervals of the others' parameters

STATED_PHASES = 8  # Episodes at most whose phases are stated

GapClosed = Mapping[frozenset[str], float]
"""Share of the gap that a set closes on held-out episodes, by the names of its effects."""


@dataclass(frozen=True)
class Alternative:
    """An effect that explains one part of the gap, in place of an effect of the best set."""

    effect: type[Effect]
    compared: ComparedModel  # the model with it
    canonical: type[Effect]
    """the effect that was fitted: itself, or its twin, which does the same with other parameters"""


def alternatives(
    comparison: ModelComparison, effects: Sequence[type[Effect]], system: System
) -> list[list[Alternative]]:
    """For each effect of the best set: itself and those of `effects` that fit as well in its place, the most probable
    model first. Of each effect that was fitted, the twins are listed with it, in the order of `effects`."""
    out = []
    for effect, rivals in comparison.alternatives.items():
        likeliest = {effect: comparison.models[0]}
        for rival in rivals:
            new = [e for e in rival.model.effects if e not in comparison.best.effects]
            likeliest |= {e: rival for e in new if e not in likeliest}
        pairs = likeliest.items()
        out.append(
            [Alternative(one, model, fitted) for fitted, model in pairs for one in _same(fitted, effects, system)]
        )
    return out


def _same(effect: type[Effect], effects: Sequence[type[Effect]], system: System) -> list[type[Effect]]:
    """Those of `effects` that passive data cannot separate from one: itself and its twins."""
    others = twins(effect, effects, system)
    return [one for one in effects if one is effect or one in others]


def causes(
    search: Search, comparison: ModelComparison, groups: Sequence[Sequence[Alternative]], gap_closed: GapClosed
) -> list[Cause]:
    """Every alternative as a cause. `gap_closed` must hold the best set, that set without each of its effects, and the
    empty set; an effect that it does not hold alone gets NaN as its `Cause.gap_closed`."""
    out: dict[str, Cause] = {}
    best = frozenset(comparison.best.names)
    reopens = {e: gap_closed[best] - gap_closed[best - {e.name}] for e in comparison.best.effects}
    alone = {e: gap_closed.get(frozenset({e.name}), math.nan) for e in comparison.best.effects}
    carrying = [effect for effect, reopened in reopens.items() if not reopened < SLIGHT]
    if best and not carrying and gap_closed[best] - gap_closed[frozenset()] > SLIGHT:
        # Effects stand in for each other, so that none is missed: the verdict rests on the one that closes most alone.
        carrying = [max(alone, key=lambda effect: alone[effect])]
    models = {c.model.names: c.model for c in comparison.models if c.probability > NEGLIGIBLE}
    models |= {one.compared.model.names: one.compared.model for group in groups for one in group}
    fitted = {names: _fitted(search, model) for names, model in models.items()}
    lean = comparison.best
    for effect in comparison.best.effects:
        lean = lean if effect in carrying else search.without(lean, effect)
    without_slight = _fitted(search, lean)
    for effect, group in zip(comparison.best.effects, groups, strict=True):
        for one in group:
            name, slight, alike = one.effect.name, effect not in carrying, _alike(one, group)
            if known := out.get(name):  # in the place of two effects of the best set
                alike = tuple(dict.fromkeys((*known.indistinguishable_from, *alike)))
                out[name] = replace(known, slight=known.slight and slight, indistinguishable_from=alike)
                continue
            found = _averaged(search, comparison, one, fitted, without_slight)
            out[name] = Cause(
                name,
                found if one.effect is one.canonical else _twin(search, one, found),
                _probability(comparison, one, group),
                gap_closed.get(frozenset({one.canonical.name}), math.nan),
                reopens[effect],
                slight,
                alike,
            )
    return list(out.values())


def _alike(one: Alternative, group: Sequence[Alternative]) -> tuple[str, ...]:
    """Those of a group that fit as well in the place of one of them, without those that act together with it."""
    together = {effect for effect in one.compared.model.effects if effect is not one.canonical}
    return tuple(other.effect.name for other in group if other is not one and other.canonical not in together)


def _probability(comparison: ModelComparison, one: Alternative, group: Sequence[Alternative]) -> float:
    """Sum over all compared models with the effect, shared evenly between twins."""
    count = sum(other.canonical is one.canonical for other in group)
    return sum(c.probability for c in comparison.models if one.canonical in c.model.effects) / count


def _twin(search: Search, one: Alternative, fitted: Mapping[str, Estimate]) -> Mapping[str, Estimate]:
    """The parameters with which a twin has the same effect."""
    if all(p.unit == "s" for effect in (one.effect, one.canonical) for p in effect.table):
        return fitted  # a delay of commands equals the same delay of readings
    model = search.exchange(one.compared.model, one.canonical, one.effect)
    values, spread = _fitted(search, model)[one.effect]
    return _estimates(search, model, one.effect, values, values - Z_90 * spread, values + Z_90 * spread)


Fitted = dict[type[Effect], tuple[Tensor, Tensor]]
"""Maximum likelihood estimates of each effect's parameters, (P,), and their standard deviations, (P,)"""


def _fitted(search: Search, model: ScoredModel) -> Fitted:
    """The parameters of a set's effects, with standard deviations that hold under misfit as well."""
    deviation = deviations(CandidateModel(search.system, model.effects, search.rows), model.fits)
    values, spread = model.by_effect(model.fits.theta[0]), model.by_effect(deviation)
    return {effect: (values[effect], spread[effect]) for effect in model.effects}


def _averaged(
    search: Search,
    comparison: ModelComparison,
    one: Alternative,
    fitted: Mapping[tuple[str, ...], Fitted],
    without_slight: Fitted,
) -> dict[str, Estimate]:
    """Estimates of the most probable set with the effect, with 90 % intervals over all compared sets with it.

    Which other effects act is uncertain too, and changes what is left for this one (Hoeting, Madigan, Raftery and
    Volinsky 1999, Bayesian model averaging, Statistical Science 14(4)). No verdict rests on slight causes, so the
    intervals also hold the estimates `without_slight` causes, which often only make up for what no effect describes
    exactly.
    """
    likeliest = fitted[one.compared.model.names][one.canonical][0]
    having = [c for c in comparison.models if one.canonical in c.model.effects and c.model.names in fitted]
    known = [fitted[compared.model.names][one.canonical] for compared in having]
    values, spreads = (torch.stack(each) for each in zip(*known, strict=True))
    turns = torch.tensor([2 * math.pi * p.is_phase for p in one.canonical.table], dtype=values.dtype)

    def near(values: Tensor) -> Tensor:
        """The same values (..., P), with each phase at most half a turn from the likeliest."""
        return values - turns * ((values - likeliest) / (2 * math.pi)).round()

    values = near(values)
    weights = torch.tensor([compared.probability for compared in having], dtype=values.dtype)
    low, high = (_quantile(values, spreads, weights, level) for level in (0.05, 0.95))
    if one.canonical in without_slight:
        alone = near(without_slight[one.canonical][0])
        low, high = torch.minimum(low, alone), torch.maximum(high, alone)
    return _estimates(search, one.compared.model, one.canonical, likeliest, low, high)


def _quantile(values: Tensor, spreads: Tensor, weights: Tensor, level: float) -> Tensor:
    """Quantile (P,) of mixtures of M normal distributions with means and deviations (M, P) and weights (M,).

    >>> means, equal = torch.tensor([[0.0], [10.0]]), torch.ones(2)
    >>> round(float(_quantile(means, torch.ones(2, 1), equal, 0.05)), 3)  # the 10 % quantile of the first
    -1.282
    """
    low, high = (values - 5 * spreads).amin(0), (values + 5 * spreads).amax(0)
    for _ in range(60):
        middle = (low + high) / 2
        below = weights @ torch.special.ndtr((middle - values) / spreads) / weights.sum() < level
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return (low + high) / 2


def _estimates(
    search: Search, model: ScoredModel, effect: type[Effect], values: Tensor, low: Tensor, high: Tensor
) -> dict[str, Estimate]:
    """Parameters (P,) of an effect of a set, with intervals from `low` to `high` (P,), as the result states them."""
    covered = spans(search.system, search.rows, model.fits.state[0])
    stated = with_common_phase(effect).table
    numbers = zip(stated, values.tolist(), low.tolist(), high.tolist(), strict=False)  # later episodes' phases are last
    out = {p.name: _estimate(p, value, first, last, covered) for p, value, first, last in numbers}
    if has_episode_phases(effect):
        # Of another episode the phase is unknown.
        out |= {p.name: replace(out[p.name], ci90=(p.low, p.high)) for p in stated if p.role is Role.PHASE}
    return out


def phases_of_episodes(best: ScoredModel) -> list[str]:
    """For each effect of a set with a phase for each episode, a line that gives them."""
    out = []
    for effect, values in best.by_effect(best.fits.theta[0]).items():
        if has_episode_phases(effect):
            pairs = zip(effect.table, values.tolist(), strict=True)
            phases = [math.remainder(value, 2 * math.pi) for p, value in pairs if p.is_phase]
            more = ", ..." if len(phases) > STATED_PHASES else ""
            shown = ", ".join(f"{phase:.2f}" for phase in phases[:STATED_PHASES]) + more
            out.append(
                f"{effect.name}: its phase differs from episode to episode ({shown} rad); the one given is the first's"
            )
    return out


def _estimate(
    parameter: Parameter, value: float, low: float, high: float, covered: Mapping[str, tuple[float, float]]
) -> Estimate:
    if parameter.role is Role.PHASE:
        whole_turns = 2 * math.pi * round(value / (2 * math.pi))
        return Estimate(value - whole_turns, parameter.unit, (low - whole_turns, high - whole_turns))
    if parameter.is_edge:
        # Where an edge lies outside the data is unknown.
        first, last = covered.get(parameter.unit, (parameter.low, parameter.high))
        if value < first:
            return Estimate(first, parameter.unit, (parameter.low, first))
        if value > last:
            return Estimate(last, parameter.unit, (last, parameter.high))
    return Estimate(value, parameter.unit, (max(low, parameter.low), min(high, parameter.high)))


def is_at_end(parameter: Parameter, value: float, end: float) -> bool:
    """Whether a strength lies at this end of the range searched, where it does something."""
    near = abs(value - end) < AT_BOUND * (parameter.high - parameter.low)
    return parameter.is_strength and end != parameter.neutral and near


def ranking(
    comparison: ModelComparison,
    effects: Sequence[type[Effect]],
    system: System,
    gap_closed: GapClosed,
    certain: Sequence[Cause],
) -> tuple[Ranked, ...]:
    """All models compared, the most probable first, with a set for each twin; `certain` causes are in every set."""
    names = tuple(cause.effect for cause in certain)
    out = []
    for compared in comparison.models:
        versions: list[tuple[str, ...]] = [()]
        for effect in compared.model.effects:
            same = _same(effect, effects, system)
            versions = [(*version, one.name) for version in versions for one in same]
        closed = gap_closed.get(frozenset(compared.model.names), math.nan)
        out += [Ranked((*names, *version), compared.probability / len(versions), closed) for version in versions]
    return tuple(sorted(out, key=lambda ranked: -ranked.probability))


def stage_shares(
    search: Search,
    comparison: ModelComparison,
    groups: Sequence[Sequence[Alternative]],
    others: Sequence[tuple[Stage, float]],
) -> dict[str, float]:
    """Share of the explained gap by stage: the log likelihood lost without each cause.

    Where its alternatives, `groups`, are of several stages, these share it evenly. `others` are the losses without
    causes that were found before the search, with their stages.
    """
    shares = {"actuation": 0.0, "dynamics": 0.0, "sensing": 0.0, "camera": 0.0}
    best = comparison.best
    for effect, group in zip(best.effects, groups, strict=True):
        without = search.fitted.get(frozenset(best.names) - {effect.name}, search.source)
        lost = max(0.0, float(best.fits.likelihood[0] - without.fits.likelihood[0]))
        stages = {one.effect.stage.value for one in group} or {effect.stage.value}
        for stage in stages:
            shares[stage] = shares.get(stage, 0.0) + lost / len(stages)
    for stage, cost in others:
        shares[stage.value] += cost
    whole = sum(shares.values())
    return {stage: share / whole if whole > 0 else 0.0 for stage, share in shares.items()}

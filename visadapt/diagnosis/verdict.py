"""What a diagnosis says of its comparison of models: the verdict, its warnings, and what to record next."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

from visadapt.diagnosis import next_experiment
from visadapt.diagnosis.result import AMBIGUOUS, IDENTIFIED, NO_GAP, UNEXPLAINED, Cause, Gap, without_slight
from visadapt.diagnosis.search.apart import ExplainedAlone
from visadapt.diagnosis.search.causes import Alternative, is_at_end
from visadapt.diagnosis.search.changing import Changing
from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.diagnosis.search.heldout import MIN_GAP
from visadapt.diagnosis.search.model_comparison import ModelComparison
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.search.sensor_checks import CoarseSteps
from visadapt.diagnosis.search.unexplained import SmoothFunction, smooth_functions
from visadapt.diagnosis.words import CHANGES, CHANGES_BETWEEN, LASTING, ONE_BY_ONE, listed, number, plain, with_unit
from visadapt.effects import EFFECTS, Effect, Parameter, QuadraticDrag, RotorDrag
from visadapt.effects.aerial import AirDrag
from visadapt.estimation.candidate import CandidateModel

MIN_GAP_CLOSED = 0.95
"""Share of the gap that the causes must close to be named although something remains unexplained, or although
predictions with them are not within the noise."""

LEAST_UNCHANGED = 0.01
"""Probability of the unchanged simulator below which a recording without a gap within a prediction has one in the long
run."""
CLEAR_OF_NOISE = 3.0
"""Ratio of prediction error to measurement noise above which there is a gap, also where no cause is found."""

LOW_NOISE = 20.0
"""Ratio of the source's prediction error to measurement noise above which any model of a real machine leaves something
significant: the share of the gap that the causes close then decides the verdict."""

HOVERING = 0.2  # m/s, root mean square of a vehicle's speed up to which it hardly moves

AIR = (AirDrag, RotorDrag, QuadraticDrag)  # Effects that depend on the velocity against the air

NEARLY_ALL = 0.95
"""Share of what causes close together that each of two must close alone for one to be able to stand for the other."""

CLOSES_BUT = "the causes close the gap but do not explain everything"
"""What the warning of `left_unexplained` begins with."""

MIN_CLOSED_TO_EXPLAIN = 0.5
"""Share of the gap that the best set must close for the next experiment to be about what it leaves unexplained; else it
is about what the source leaves."""


def verdict_of(
    comparison: ModelComparison,
    gap: Gap,
    improvable: bool,
    explaining: Sequence[Cause],
    repeats: bool,
    coarse: bool,
) -> str:
    """The verdict where these causes are what explains the gap best.

    Args:
        improvable: a black box beside them clearly closes more of the gap.
        repeats: readings are repeated.
        coarse: a position is read in steps that are coarse for the motion.
    """
    # Coarse steps, and errors of a velocity's reading, are fitted as noise: a source that predicts within it may still
    # have a gap.
    nothing = UNEXPLAINED if coarse or comparison.misread else NO_GAP
    unexplained = comparison.unexplained(improvable)
    if math.isnan(gap.closed) and not repeats:
        return nothing  # the source predicts as well as the noise allows
    if unexplained:
        low_noise = gap.before > LOW_NOISE * gap.floor
        enough = gap.closed >= MIN_GAP_CLOSED if low_noise else comparison.negligible and not improvable
        if not (comparison.best.effects and enough):
            return UNEXPLAINED
    carrying = without_slight(explaining)
    if not carrying:
        return UNEXPLAINED if unexplained or gap.before > CLEAR_OF_NOISE * gap.floor else nothing
    if gap.after > MIN_GAP * gap.floor and gap.closed < MIN_GAP_CLOSED:
        return UNEXPLAINED  # the causes fit the rows that they were fitted to, but do not predict others
    return AMBIGUOUS if any(cause.indistinguishable_from for cause in carrying) else IDENTIFIED


def next_step(
    search: Search,
    comparison: ModelComparison,
    verdict: str,
    groups: Sequence[Sequence[Alternative]],
    found: Sequence[Cause],
    gap: Gap,
    coarse: Sequence[CoarseSteps],
    source_leaves: Sequence[SmoothFunction],
    pushed: Collection[str],
    no_gap_beside_pushes: bool,
) -> str:
    """The experiment to make next, in words; slight causes among those `found` need none.

    `source_leaves` are the functions that the source leaves unexplained, where nothing was found; `pushed` are the
    loads with pushes.
    """
    if is_slow(comparison, verdict):
        return next_experiment.LONGER
    if pushed and (verdict in (NO_GAP, IDENTIFIED) or no_gap_beside_pushes):
        return next_experiment.untouched(pushed)
    if verdict == NO_GAP and comparison.unexplained(False):
        return next_experiment.explain(comparison.functions, pushed)
    if verdict == NO_GAP:
        return next_experiment.more(search.profile)
    if verdict == UNEXPLAINED and coarse:
        return next_experiment.finer([position.state for position in coarse])
    if verdict == UNEXPLAINED:
        closed = gap.closed >= MIN_CLOSED_TO_EXPLAIN
        return next_experiment.explain(comparison.functions if closed else source_leaves, pushed)
    carrying = {cause.effect for cause in without_slight(found)}
    classes = [[one.effect for one in group] for group in groups]
    classes = [each for each in classes if carrying & {one.name for one in each}]
    imitators = _imitators(found, gap, comparison.unexplained(False))
    return next_experiment.separate([*classes, [EFFECTS[one.effect] for one in imitators]], search.system)


def one_by_one(apart: Sequence[ExplainedAlone]) -> str:
    """The warning of recordings that are explained one by one, and not together."""
    each = (
        f"{one.source} by {_with_values(one.best) if one.best.effects else 'the unchanged simulator'}" for one in apart
    )
    return f"{ONE_BY_ONE}: {'; '.join(each)}"


def lasting_errors(seconds: Mapping[tuple[str, ...], float]) -> str:
    """The warning of readings whose errors last for several rows."""
    each = "; ".join(f"{', '.join(names)} for about {number(each, 2)} s" for names, each in seconds.items())
    return f"{LASTING}: {each}"


def in_turn(changes: Sequence[Changing]) -> str:
    """The warning of recordings that are explained by effects whose sizes change within one, or between them."""
    sets = []
    for one in changes:
        turns = iter(zip(*one.values, strict=True))  # of each parameter, from stretch to stretch
        parts = []
        for effect in one.effects:
            values = [_in_turn(parameter, next(turns)) for parameter in effect.table]
            parts.append(f"{plain(effect.name)} ({', '.join(values)})")
        sets.append(listed(parts))
    first = changes[0]
    if first.files:
        return f"{CHANGES_BETWEEN}: {listed(first.files)}, in this order, are explained by {listed(sets, 'or')}"
    starts = ", ".join(number(each) for each in first.starts)
    start = f"from about {starts} s on" if starts else "one after the other"
    return f"{CHANGES}: {len(first.values)} stretches of it, {start}, are explained by {listed(sets, 'or')}"


def _in_turn(parameter: Parameter, values: Sequence[float]) -> str:
    """A parameter with its value in each stretch."""
    return f"{parameter.name} {with_unit(', '.join(map(number, values)), parameter.unit)}"


def _with_values(found: ScoredModel) -> str:
    """The effects of a set, each with its values."""
    parts = []
    for effect, values in found.by_effect(found.fits.theta[0]).items():
        named = zip(effect.table, values.tolist(), strict=True)
        each = (f"{one.name} {with_unit(number(value, 4), one.unit)}" for one, value in named)
        parts.append(f"{plain(effect.name)} ({', '.join(each)})")
    return listed(parts)


def left_by_source(search: Search) -> list[SmoothFunction]:
    """The functions that the source leaves unexplained, the most probable first."""
    fits = search.source.fits
    return smooth_functions(CandidateModel(search.system, (), search.rows), fits, fits.state[0])


def is_slow(comparison: ModelComparison, verdict: str) -> bool:
    """Whether there is no gap within a prediction, and one in the long run."""
    return verdict == NO_GAP and comparison.unchanged < LEAST_UNCHANGED


def shown_by_episodes(comparison: ModelComparison, verdict: str, unexplained: bool) -> list[str]:
    """A warning where predictions show no gap, and whole episodes do."""
    if is_slow(comparison, verdict):
        best = comparison.best
        found = [
            f"{effect.name} ({', '.join(_value(p, v) for p, v in zip(effect.table, values.tolist(), strict=True))})"
            for effect, values in best.by_effect(best.fits.theta[0]).items()
        ]
        bare = "below 0.001" if comparison.unchanged < 1e-3 else f"{comparison.unchanged:.3f}"
        what = f"{listed(found)} explains whole episodes far better (probability of the unchanged simulator {bare})"
    elif verdict == NO_GAP and unexplained:
        what = next_experiment.disturbance_in_words(comparison.functions)
    else:
        return []
    return [f"over a prediction the simulator errs by no more than the noise, but {what}: it is small, or acts slowly"]


def _value(parameter: Parameter, value: float) -> str:
    return f"{parameter.name} {with_unit(number(value), parameter.unit)}"


def at_bounds(comparison: ModelComparison, found: Sequence[Cause], effects: Sequence[type[Effect]]) -> list[str]:
    """A warning for each strength that the best set, or one of the causes `found`, has at an end of the range
    searched; `effects` are those that were searched, and their twins."""
    best = [(effect, parameter) for effect in comparison.best.effects for parameter in effect.table]
    values = zip(best, comparison.best.fits.theta[0].tolist(), strict=True)
    by_name, in_best = {effect.name: effect for effect in effects}, {effect.name for effect in comparison.best.effects}
    others = [
        ((by_name[cause.effect], parameter), cause.parameters[parameter.name].value)
        for cause in found
        if cause.effect in by_name and cause.effect not in in_best
        for parameter in by_name[cause.effect].table
        if parameter.name in cause.parameters
    ]
    return [
        at_bound(effect.name, parameter.name, end, parameter.unit)
        for (effect, parameter), value in (*values, *others)
        for end in (parameter.low, parameter.high)
        if is_at_end(parameter, value, end)
    ]


def at_bound(effect: str, parameter: str, end: float, unit: str) -> str:
    """The warning that a strength of a cause is at an end of the range searched."""
    longer = "; of a system of your own, a longer prediction_time searches longer times" if unit == "s" else ""
    return (
        f"{effect}: {parameter} is at {with_unit(f'{end:g}', unit)}, the end of the range searched; the truth may lie "
        f"beyond it, and any other cause is then wrong as well{longer}"
    )


def late_by_less_than(row: float, found: Sequence[Cause]) -> list[str]:
    """A warning where a delay is among the causes `found` beside commands that were recorded a row, in s, late."""
    delays = [cause.parameters["delay"].value for cause in found if "delay" in cause.parameters]
    return [
        f"a delay beside commands that were recorded a row, {row:.3g} s, late looks the same as no delay, and commands "
        f"that were recorded {row - delay:.2g} s late"
        for delay in delays[:1]
    ]


MANY = 4  # Causes at once from which on they are doubted


def of_many(causes: int) -> list[str]:
    """A warning of so many causes that carry the explanation: each adds its freedom to imitate another effect."""
    if causes < MANY:
        return []
    return [
        f"{causes} causes at once may stand for one effect that is not in the catalogue: see whether they keep their "
        "values in another recording, at other speeds"
    ]


def of_one_explanation(comparison: ModelComparison) -> list[str]:
    """A warning that the terms of Theorem 1 are those of one of several explanations: a delay of the sensors leaves the
    simulator's step as it is, and one of the commands, which explains the recording as well, does not."""
    names = listed([plain(effect.name) for effect in comparison.best.effects] or ["the unchanged simulator"])
    return [f"the terms for the policy are those with {names}; with another explanation they may differ"]


def hovers(search: Search, comparison: ModelComparison, found: Sequence[Cause]) -> list[str]:
    """A warning where drag or wind is found, and the vehicle hardly moves."""
    named = [cause.effect for cause in without_slight(found) if issubclass(EFFECTS.get(cause.effect, Effect), AIR)]
    if not named or not search.profile.is_aircraft:
        return []
    columns = [search.system.index(name) for name in ("x_dot", "y_dot", "z_dot")]
    velocity = comparison.best.fits.state[0][search.rows.inside > 0][:, columns]
    speed = float(velocity.square().sum(1).mean().sqrt())
    if speed > HOVERING:
        return []
    return [
        f"the vehicle hardly moves ({number(speed, 2)} m/s): what its controller makes of the wind may bias "
        f"{listed(named)} beyond the intervals; flights to and fro at several speeds are right"
    ]


def left_unexplained(comparison: ModelComparison, verdict: str, unexplained: bool) -> list[str]:
    """A warning where causes are named although they leave something."""
    if verdict in (IDENTIFIED, AMBIGUOUS) and unexplained:
        return [f"{CLOSES_BUT}: {next_experiment.disturbance_in_words(comparison.functions)}"]
    return []


def imitating(found: Sequence[Cause], gap: Gap, unexplained: bool) -> list[str]:
    """A warning where causes are named although they leave something, and each of several closes nearly as much alone:
    what tells them apart is no larger than what no effect explains."""
    alone = _imitators(found, gap, unexplained)
    if not alone:
        return []
    shares = ", ".join(f"{100 * cause.gap_closed:.0f} %" for cause in alone)
    return [
        f"{listed([plain(cause.effect) for cause in alone])} each close nearly as much alone ({shares}) as all causes "
        f"together ({100 * gap.closed:.0f} %), and not everything is explained: one of them may only imitate another"
    ]


def _imitators(found: Sequence[Cause], gap: Gap, unexplained: bool) -> list[Cause]:
    """Causes that each close nearly as much alone as all together, where something is unexplained; none, if there is
    one such cause. Of those that are said to fit as well as each other, the first."""
    alone: list[Cause] = []
    for cause in without_slight(found):
        known_alike = any(cause.effect in other.indistinguishable_from for other in alone)
        if cause.gap_closed >= NEARLY_ALL * gap.closed and not known_alike:
            alone.append(cause)
    return alone if unexplained and len(alone) > 1 else []

"""From a recording to a diagnosis: set aside what is no reading, search, judge, predict what was held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from visadapt.diagnosis import policy_bound
from visadapt.diagnosis.report import next_experiment
from visadapt.diagnosis.report.figures_data import Errors, disturbances, evidence
from visadapt.diagnosis.result import (
    AMBIGUOUS,
    IDENTIFIED,
    NO_GAP,
    UNEXPLAINED,
    Cause,
    Diagnosis,
    RecordingSummary,
    Region,
    Where,
)
from visadapt.diagnosis.search import heldout, localisation
from visadapt.diagnosis.search.catalogue import searched
from visadapt.diagnosis.search.causes import Named, causes, classes, ranking, stage_shares
from visadapt.diagnosis.search.model_comparison import ModelComparison, compare
from visadapt.diagnosis.search.repeated_causes import held_causes, unaware
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.search.sensor_checks import Readings
from visadapt.effects import EFFECTS, Effect
from visadapt.effects.catalogue import catalogue as all_effects
from visadapt.estimation.profiles import profile_of
from visadapt.progress import Report, staged
from visadapt.recordings import Recording
from visadapt.systems import System
from visadapt.world import World

ENOUGH = 0.95
"""Share of the gap that the causes must close to be the explanation where something is left over."""

CLEAR = 3.0
"""Times the noise that predictions must still err by for the noise to be no measure of what is left."""

RIVALS = 2
"""Sets after the best one of which it is computed how far they close the gap."""


def diagnose(
    recording: Recording,
    world: World,
    catalogue: Sequence[type[Effect]] | None = None,
    seed: int = 0,
    jobs: int = 1,
    progress: Report | None = None,
    policy: policy_bound.StatesToActions | None = None,
) -> Diagnosis:
    """Say where a recording departs from the source, which effects cause it, and how far they close the gap.

    Args:
        recording: states, or some of them, and commands.
        world: the source; its system and its parameters are taken as known.
        catalogue: the effects that may be named; without it, all that are registered.
        seed: of the shifts by which the significance of regions is counted; nothing else is drawn.
        jobs: cores that tensor operations may use.
        progress: called with (stage, steps done, steps in all, loss).
        policy: on states, with the units and signs of the source and the rate of the recording; for it, Theorem 1's
            terms are told (`Diagnosis.evidence.policy`).

    Raises:
        ValueError: the world has effects of its own, or a system that cannot be diagnosed; or no policy on its states.

    >>> import pathlib, tempfile, torch, visadapt as va
    >>> target = va.SyntheticTarget(va.constant_force(2.0))
    >>> policy = va.load_policy(va.shipped("cartpole_states"))
    >>> runs = va.run(target, policy, 2, 30, torch.Generator().manual_seed(0), exploration=0.3)
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.h5"
    >>> va.write_recording(path, [run.episode for run in runs], ["x", "x_dot", "theta", "theta_dot"], ["command"])
    >>> source = va.World(va.CartPole())
    >>> run = va.load_recording(path, source.system)
    >>> found = va.diagnose(run, source, catalogue=[va.effects.ConstantForce])
    >>> found.verdict, [cause.effect for cause in found.causes]
    ('identified', ['constant_force'])
    """
    if len(world.effects):
        raise ValueError("diagnose: the world is the source and has no effects; give the bare system")
    profile_of(world.system)
    torch.set_num_threads(jobs)
    effects = list(all_effects(world.system) if catalogue is None else catalogue)
    with torch.inference_mode():
        if policy is not None:
            policy_bound.check(policy, world.system)
        return _diagnose(recording, world.system, effects, seed, progress, policy)


def _diagnose(
    recording: Recording,
    system: System,
    effects: list[type[Effect]],
    seed: int,
    progress: Report | None,
    policy: policy_bound.StatesToActions | None,
) -> Diagnosis:
    readings = Readings.of(recording, system)
    rows = readings.rows
    search = Search(system, rows, searched(effects, system), readings.source)
    search.run(staged(progress, "search"))
    comparison = compare(search)
    best = comparison.best
    places = classes(comparison, effects, system)
    held = held_causes(readings, search, comparison)

    # How far: the source, the best set, each cause alone, the runners-up; all on episodes held out.
    alone = [search.single(effect) for effect in dict.fromkeys(named.canonical for place in places for named in place)]
    rivals = [weighed.fitted for weighed in comparison.weighed[1 : 1 + RIVALS]]
    sets = {frozenset(f.names): f for f in [search.source, best, *alone, *rivals]}
    ahead = heldout.held_out(system, rows, [(f.effects, f.fits) for f in sets.values()])
    predicted = dict(zip(sets, ahead, strict=True))
    source = unaware(readings, search) if held else predicted[frozenset()]
    corrected = predicted[frozenset(best.names)]
    boxed = heldout.held_out(system, rows, [((), search.source.fits)], black_box=True)[0]
    errors = Errors.of(source, corrected, boxed, (best.fits.log_noise[0] / 2).exp())
    closing = {names: errors.closed_by(each) for names, each in predicted.items()}

    verdict = _verdict(comparison, errors, bool(held))
    told: tuple[Cause, ...] = ()
    if verdict == IDENTIFIED:
        told = (*(each.cause for each in held), *causes(search, comparison, places, closing))
        if any(cause.indistinguishable_from for cause in told):
            verdict = AMBIGUOUS
    terms = None if policy is None else policy_bound.policy_terms(policy, system, rows, best)
    before, after = disturbances(search, comparison)
    regions = _regions(told, before if told else after, profile_of(system).places, seed)
    return Diagnosis(
        system=system.name,
        recording=RecordingSummary(len(recording.episodes), recording.samples, float(f"{recording.period:.9g}")),
        verdict=verdict,
        where=Where(
            stage_shares(search, comparison, [each.cost for each in held]),
            errors.by_state(system, rows.channels, bool(told)),
            regions,
        ),
        causes=told,
        ranking=ranking(comparison, effects, system, closing, [each.cause for each in held]),
        gap=errors.gap(),
        next_experiment=_next(comparison, verdict, places, system),
        warnings=(*recording.warnings, *readings.warnings, *_doubts(comparison, verdict)),
        evidence=evidence(search, source, corrected, errors, before, after, regions, terms),
    )


def _verdict(comparison: ModelComparison, errors: Errors, held: bool) -> str:
    if comparison.unexplained:
        gap = errors.gap()
        # Where the noise is so low that any real machine departs from any model, what counts is how much of the gap
        # is closed; elsewhere, whether what is left is evident.
        enough = gap.closed >= ENOUGH if gap.after > CLEAR * gap.floor else comparison.slight
        return IDENTIFIED if comparison.best.effects and enough else UNEXPLAINED
    return IDENTIFIED if comparison.best.effects or held else NO_GAP


def _regions(
    told: Sequence[Cause], found: localisation.Disturbance, places: Mapping[str, str], seed: int
) -> tuple[Region, ...]:
    """Those of the causes that act in one, as they were fitted; then those where the residual stands out."""
    own = []
    for cause in told:
        edges = EFFECTS[cause.effect].region()
        if edges is not None and edges[0].unit in places:
            start, end = (cause.parameters[edge.name] for edge in edges)
            variable = places[start.unit]
            own.append(
                Region(
                    variable,
                    start.value,
                    end.value,
                    localisation.share(found, variable, start.value, end.value),
                    1 - cause.probability,
                )
            )
    taken = {region.variable for region in own}
    return (*own, *(region for region in localisation.regions(found, seed) if region.variable not in taken))


def _next(comparison: ModelComparison, verdict: str, places: Sequence[Sequence[Named]], system: System) -> str:
    if verdict == NO_GAP:
        return next_experiment.more(profile_of(system))
    if verdict == UNEXPLAINED:
        first = comparison.functions[0]
        return next_experiment.explain(first.port, first.variable)
    return next_experiment.separate([[named.effect for named in place] for place in places], system)


def _doubts(comparison: ModelComparison, verdict: str) -> list[str]:
    if verdict in (IDENTIFIED, AMBIGUOUS) and comparison.unexplained:
        first = comparison.functions[0]
        return [
            f"the causes close the gap but do not explain all: something is left that enters as {first.port} and goes "
            f"with {first.variable}"
        ]
    return []

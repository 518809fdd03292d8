"""From a recording to a diagnosis: prepare the rows, search, compare models, predict held-out episodes, judge."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import torch
from torch import nn

from visadapt.diagnosis import policy_bound
from visadapt.diagnosis.answer import Answer, answer
from visadapt.diagnosis.exploration import Explored
from visadapt.diagnosis.figures_data import disturbances, figure_data, film_frames
from visadapt.diagnosis.frames import UNSEEN, Film, FramesError, watch, with_camera
from visadapt.diagnosis.next_experiment import AS_IT_CHANGES, EVERY_COMMAND, EVERY_SENT, OF_ONE_MACHINE
from visadapt.diagnosis.result import (
    AMBIGUOUS,
    NO_GAP,
    UNEXPLAINED,
    Cause,
    Diagnosis,
    Gap,
    RecordingSummary,
    Region,
    Where,
    without_slight,
)
from visadapt.diagnosis.search.causes import (
    phases_of_episodes,
    ranking,
    stage_shares,
)
from visadapt.diagnosis.search.disturbance import Disturbance, regions_of, share_between
from visadapt.diagnosis.search.preparation import limited
from visadapt.diagnosis.search.searched_effects import shown_by
from visadapt.diagnosis.search.unexplained_load import unread_states
from visadapt.diagnosis.verdict import (
    at_bounds,
    hovers,
    imitating,
    in_turn,
    lasting_errors,
    late_by_less_than,
    left_unexplained,
    next_step,
    of_many,
    of_one_explanation,
    one_by_one,
    shown_by_episodes,
)
from visadapt.diagnosis.words import A_ROW_LATE, BESIDE_PUSHES, BETWEEN_ROWS, THINNED, listed, printable
from visadapt.effects import EFFECTS, Dropout, Effect, FrameDrop, Stage
from visadapt.effects.catalogue import catalogue as all_effects, sized
from visadapt.estimation.effect_fit import remembers
from visadapt.estimation.profiles import profile_of
from visadapt.processes import one_thread
from visadapt.progress import Report
from visadapt.recordings import Recording, RecordingError
from visadapt.systems import System
from visadapt.world import World

TOO_SHORT = "too short to hold a part of it out: the gap is that of the rows to which the causes were fitted"

MAX_UNCHANGED = 0.1
"""Probability of the source above which a reader of the causes is told of it."""

NOT_SEARCHED = "what it reads depends on earlier rows, so it is not among the effects that are searched"


@one_thread()
@torch.inference_mode()
def diagnose(
    recording: Recording,
    world: World,
    catalogue: Sequence[type[Effect]] | None = None,
    seed: int = 0,
    jobs: int = 1,
    progress: Report | None = None,
    policy: policy_bound.StatesToActions | None = None,
    announce: Callable[[str], object] | None = None,
    renderer: nn.Module | None = None,
) -> Diagnosis:
    """Find where a recording departs from the source, which effects cause it, and how far they close the gap.

    Args:
        recording: some or all states, or frames, and commands.
        world: the source, without effects; the parameters of its system are taken as known.
        catalogue: the effects that may be causes; by default all that are registered for the system.
        seed: of the random shifts that give the p-values of regions; nothing else is random.
        jobs: processes that share the work.
        progress: called with (stage, steps done, steps in all, loss).
        policy: a policy on states, in the units and signs of the source and at the rate of the recording; with it, the
            terms of the paper's Theorem 1 are computed (`Diagnosis.policy`).
        announce: called, before the search begins, with a line that says how much there is to do and about how long it
            will take.
        renderer: of a recording of frames: x (B,) in m and theta (B,) in rad to frames (B, H, W) in [0, 1].

    Raises:
        FramesError: there are frames and no renderer, or this one does not explain them.
        ValueError: the world has effects, its system does not state its `coordinates`, or `policy` is not one on its
            states.

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
    _check(recording, world, policy)
    system = world.system
    effects = all_effects(system) if catalogue is None else [sized(effect, system) for effect in catalogue]
    film = None if recording.measured else _watched(recording, system, renderer, progress)
    if film is None:
        effects = shown_by(effects, {system.index(name) for name in recording.measured})
    else:
        effects, recording = [effect for effect in effects if effect not in UNSEEN], film.positions
    used = limited(recording, system)
    answered = answer(used, world, effects, FrameDrop if film else Dropout, jobs, progress, announce)
    explored, measured, verdict, found = answered.explored, answered.measured, answered.verdict, answered.causes
    search, comparison, groups = explored.search, explored.comparison, explored.groups
    before, after = disturbances(search, comparison)
    gap, stages = measured.gap, stage_shares(search, comparison, groups, _found_before(explored, film))
    if verdict == NO_GAP or answered.no_gap_beside_pushes:  # The best set's effects are none of the causes
        gap, stages = gap.without_causes(), dict.fromkeys(stages, 0.0)
    regions = _regions(found, before if found else after, explored.effects, profile_of(system).region_variables, seed)
    found_in_motion = Diagnosis(
        system=system.name,
        recording=RecordingSummary(
            len(recording.episodes),
            recording.samples,
            float(f"{recording.period:.9g}"),
            tuple(printable(origin) for origin in used.sources),
            measured.errors.noise(system, explored.prepared.rows.channels),
        ),
        verdict=verdict,
        where=Where(
            stages,
            measured.errors.by_state(system, explored.prepared.rows.channels, bool(found)),
            regions,
            answered.pushes,
        ),
        causes=found,
        ranking=ranking(comparison, explored.effects, system, measured.closed, [one for one, _ in explored.repeats]),
        gap=gap,
        next_experiment=_next_step(answered, gap),
        warnings=(
            *used.warnings,
            *(f"{effect.name}: {NOT_SEARCHED}" for effect in effects if remembers(effect, system)),
            *_warnings(answered, recording.sources[0]),
            *(of_one_explanation(comparison) if policy is not None and verdict == AMBIGUOUS else ()),
        ),
        figures=replace(
            figure_data(search, measured, before, after, regions),
            # Of a film that is too long, stretches were used, whose episodes are not the film's.
            film=film_frames(film, explored.prepared.rows, measured.corrected) if film and used is recording else None,
        ),
        policy=None
        if policy is None
        else policy_bound.policy_terms(policy, system, explored.prepared.rows, comparison.best),
        partial=answered.partial,
    )
    return found_in_motion if film is None else with_camera(found_in_motion, film, system)


def _check(recording: Recording, world: World, policy: policy_bound.StatesToActions | None) -> None:
    """Raises what `diagnose` does of a world, or a policy, that does not go with the recording."""
    if not isinstance(recording, Recording):
        raise TypeError(f"diagnose: {recording!r:.80} is no Recording; load_recording(FILE, system) reads one")
    if not isinstance(world, World):
        raise TypeError(f"diagnose: {type(world).__name__} is no World; World(system, period=...) is right")
    if len(world.effects):
        names = listed([effect.name for effect in world.effects if isinstance(effect, Effect)])
        raise ValueError(f"diagnose: the world has {names}; give the source without effects, World(world.system)")
    system = world.system
    commands = {episode.action.shape[1] for episode in recording.episodes} - {len(system.actions)}
    if commands:
        raise RecordingError(
            f"the recording has {commands.pop()} commands in a row; a {system.name} has {len(system.actions)}: "
            f"{', '.join(action.name for action in system.actions)}"
        )
    profile_of(system)  # raises where the system does not state its coordinates
    if policy is not None:
        policy_bound.check(policy, system)


def _watched(recording: Recording, system: System, renderer: nn.Module | None, progress: Report | None) -> Film:
    """The motion that the frames of a recording show."""
    if renderer is None:
        raise FramesError(
            f"{recording.sources[0]}: holds frames alone: give the scene's renderer, by renderer= or --renderer"
        )
    return watch(recording, system, renderer, progress)


def _found_before(explored: Explored, film: Film | None) -> list[tuple[Stage, float]]:
    """The stages of causes that were found before the search, with the log likelihood lost without each."""
    found = [(EFFECTS[cause.effect].stage, lost) for cause, lost in explored.repeats]
    if film is not None and film.camera.best.camera:
        found.append((Stage.CAMERA, film.camera.lost))
    return found


def _next_step(answered: Answer, gap: Gap) -> str:
    """The experiment to make next, in words."""
    explored = answered.explored
    if answered.verdict == UNEXPLAINED:
        if explored.apart:
            return OF_ONE_MACHINE
        if explored.changes:
            return OF_ONE_MACHINE if explored.changes[0].files else AS_IT_CHANGES
        if BETWEEN_ROWS in explored.prepared.warnings:
            return EVERY_COMMAND
        if THINNED in explored.prepared.warnings:
            return EVERY_SENT
    return next_step(
        explored.search,
        explored.comparison,
        answered.verdict,
        explored.groups,
        answered.causes,
        gap,
        explored.prepared.coarse,
        answered.source_leaves,
        {push.load for push in answered.pushes},
        answered.no_gap_beside_pushes,
    )


def _warnings(answered: Answer, origin: str) -> Iterator[str]:
    """What a reader of the diagnosis must know of the recording from `origin`, the comparison and the causes found."""
    explored, measured, verdict, found = answered.explored, answered.measured, answered.verdict, answered.causes
    comparison = explored.comparison
    yield from explored.prepared.warnings
    if answered.set_aside:
        yield BESIDE_PUSHES
    if any(A_ROW_LATE in warning for warning in explored.prepared.warnings):
        yield from late_by_less_than(explored.prepared.rows.period, found)
    whole, system = explored.prepared.whole, explored.search.system
    if verdict == UNEXPLAINED and whole is not None and (unread := unread_states(whole, system)):
        yield f"pushes in single episodes were not looked for: they need {listed(unread)}, which no sensor read"
    if not measured.errors.held_out:
        yield f"{origin}: {TOO_SHORT}"
    if verdict == UNEXPLAINED and explored.apart:
        yield one_by_one(explored.apart)
    if explored.lasting:
        yield lasting_errors(explored.lasting)
    if explored.changes:
        yield in_turn(explored.changes)
    unexplained = comparison.unexplained(measured.improvable)
    yield from left_unexplained(comparison, verdict, unexplained)
    yield from imitating(found, measured.gap, comparison.unexplained(False))
    yield from at_bounds(comparison, found, explored.effects)
    bare = comparison.unchanged
    yield from shown_by_episodes(comparison, verdict, unexplained)
    yield from hovers(explored.search, comparison, found)
    if found:
        yield from phases_of_episodes(comparison.best)
        if bare > MAX_UNCHANGED and not explored.repeats:
            yield f"the unchanged simulator has a probability of {bare:.2f}: that there is a gap at all is not certain"
    carrying = {cause.effect for cause in without_slight(found)}
    yield from of_many(sum(effect.name in carrying for effect in comparison.best.effects))
    yield from (f"{one.name}: {one.caveat}" for one in comparison.best.effects if one.caveat and one.name in carrying)


def _regions(
    found: Sequence[Cause],
    disturbance: Disturbance,
    effects: Sequence[type[Effect]],
    variables: Mapping[str, str],
    seed: int,
) -> tuple[Region, ...]:
    """The regions of causes that act in one, as fitted; then those of other variables where the disturbance is
    concentrated. `variables` are those along which regions lie, by unit."""
    # Effects of the user's own need not be registered; those that repeat readings need not be in the catalogue.
    by_name = {**EFFECTS, **{effect.name: effect for effect in effects}}
    fitted = []
    for cause in found:
        edges = by_name[cause.effect].region()
        if edges is not None and edges[0].unit in variables:
            start, end = (cause.parameters[edge.name] for edge in edges)
            variable = variables[start.unit]
            share = share_between(disturbance, variable, start.value, end.value)
            fitted.append(Region(variable, start.value, end.value, share, math.nan))
    taken = {region.variable for region in fitted}
    return (*fitted, *(one for one in regions_of(disturbance, seed) if one.variable not in taken))

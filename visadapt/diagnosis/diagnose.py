"""From a recording to a diagnosis: prepare the rows, search, compare models, predict held-out episodes, judge."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import nn

from visadapt.diagnosis import policy_bound
from visadapt.diagnosis.figures_data import disturbances, figure_data, film_frames
from visadapt.diagnosis.frames import UNSEEN, Film, FramesError, watch, with_camera
from visadapt.diagnosis.measured_gap import MeasuredGap, measure
from visadapt.diagnosis.result import (
    AMBIGUOUS,
    IDENTIFIED,
    NO_GAP,
    UNEXPLAINED,
    Cause,
    Diagnosis,
    Push,
    RecordingSummary,
    Region,
    Where,
    without_slight,
)
from visadapt.diagnosis.search import duration
from visadapt.diagnosis.search.all_rows import best_on_all_rows, on_all_rows
from visadapt.diagnosis.search.causes import (
    Alternative,
    alternatives,
    causes,
    phases_of_episodes,
    ranking,
    stage_shares,
)
from visadapt.diagnosis.search.coloured import colour_left_by, with_coloured_noise
from visadapt.diagnosis.search.disturbance import Disturbance, regions_of, share_between
from visadapt.diagnosis.search.jumps import with_jumps
from visadapt.diagnosis.search.model_comparison import ModelComparison, compare
from visadapt.diagnosis.search.preparation import PreparedRecording, limited, prepare
from visadapt.diagnosis.search.pushes import pushes
from visadapt.diagnosis.search.repeated_causes import errors_with_repeats, repeated_reading_causes
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.search.searched_effects import searched, shown_by
from visadapt.diagnosis.search.unexplained import SmoothFunction
from visadapt.diagnosis.search.unexplained_load import unread_states
from visadapt.diagnosis.verdict import (
    at_bounds,
    left_by_source,
    left_unexplained,
    next_step,
    shown_by_episodes,
    verdict_of,
)
from visadapt.diagnosis.words import listed, printable
from visadapt.effects import EFFECTS, Dropout, Effect, FrameDrop, Stage
from visadapt.effects.catalogue import catalogue as all_effects, sized
from visadapt.estimation.effect_fit import remembers
from visadapt.estimation.episode_phases import has_episode_phases, in_episode
from visadapt.estimation.profiles import profile_of
from visadapt.processes import one_thread
from visadapt.progress import Report, staged
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
    explored = _explore(used, system, effects, FrameDrop if film else Dropout, jobs, progress, announce)
    search, comparison, groups = explored.search, explored.comparison, explored.groups
    repeats = [cause for cause, _ in explored.repeats]
    with_repeats = errors_with_repeats(explored.prepared, search) if repeats else None
    measured = measure(search, comparison, groups, with_repeats, jobs, staged(progress, "predictions"))
    verdict, found, partial = _judge(explored, measured)
    source_leaves = [] if found else left_by_source(search)
    before, after = disturbances(search, comparison)
    pushed = _pushes(explored, world, source_leaves)
    gap, stages = measured.gap, stage_shares(search, comparison, groups, _found_before(explored, film))
    if verdict == NO_GAP:  # The best set may hold an effect, which is none of the causes
        gap, stages = gap.without_causes(), dict.fromkeys(stages, 0.0)
    regions = _regions(found, before if found else after, explored.effects, profile_of(system).region_variables, seed)
    found_in_motion = Diagnosis(
        system=system.name,
        recording=RecordingSummary(
            len(recording.episodes),
            recording.samples,
            float(f"{recording.period:.9g}"),
            tuple(printable(origin) for origin in used.sources),
        ),
        verdict=verdict,
        where=Where(
            stages,
            measured.errors.by_state(system, explored.prepared.rows.channels, bool(found)),
            regions,
            pushed,
        ),
        causes=found,
        ranking=ranking(comparison, explored.effects, system, measured.closed, repeats),
        gap=gap,
        next_experiment=next_step(
            search,
            comparison,
            verdict,
            groups,
            found,
            gap,
            explored.prepared.coarse,
            source_leaves,
            {push.load for push in pushed},
        ),
        warnings=(
            *used.warnings,
            *(f"{effect.name}: {NOT_SEARCHED}" for effect in effects if remembers(effect, system)),
            *_warnings(explored, measured, verdict, found, recording.sources[0]),
        ),
        figures=replace(
            figure_data(search, measured, before, after, regions),
            # Of a film that is too long, stretches were used, whose episodes are not the film's.
            film=film_frames(film, explored.prepared.rows, measured.corrected) if film and used is recording else None,
        ),
        policy=None
        if policy is None
        else policy_bound.policy_terms(policy, system, explored.prepared.rows, comparison.best),
        partial=partial,
    )
    return found_in_motion if film is None else with_camera(found_in_motion, film, system)


def _check(recording: Recording, world: World, policy: policy_bound.StatesToActions | None) -> None:
    """Raises what `diagnose` does of a world, or a policy, that does not go with the recording."""
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


@dataclass(frozen=True)
class _Explored:
    """A recording of states, and which sets of effects explain it."""

    effects: list[type[Effect]]  # that may be named
    prepared: PreparedRecording
    search: Search
    comparison: ModelComparison
    groups: list[list[Alternative]]  # the effects of the best set, each with those that fit as well in its place
    repeats: list[tuple[Cause, float]]  # causes of repeated readings, and the log likelihood lost without them


def _explore(
    recording: Recording,
    system: System,
    effects: Sequence[type[Effect]],
    repeating: type[Effect],
    jobs: int,
    progress: Report | None,
    announce: Callable[[str], object] | None,
) -> _Explored:
    """Search for the sets of `effects` that explain a recording of states, and compare the best of them.

    `repeating` is the effect that repeats whole rows.
    """
    candidates = searched(effects, system)
    prepared = prepare(recording, system, candidates)
    rows = prepared.rows
    search = Search(system, rows.select(prepared.searched), candidates, prepared.source, jobs)
    if announce is not None:
        announce(duration.announcement(rows, len(effects), duration.expected(search, rows), jobs))
    jumping = with_jumps(search)
    if jumping is not None:
        search, rows = jumping, replace(rows, jumps=True)
    if jumping is not None and colour_left_by(search, search.best) is not None:
        # A machine that resonates: its larger sets are looked for with coloured noise alone.
        search = best_on_all_rows(search, rows)
    else:
        search.run(staged(progress, "search"))
        search = on_all_rows(search, rows)
    comparison = compare(search)
    repeats = repeated_reading_causes(prepared, search, comparison, repeating)
    again = staged(progress, "search with coloured noise")
    search, comparison = with_coloured_noise(search, comparison, prepared.searched, again)
    # Periodic effects may have got a phase for each episode.
    in_use = {effect.name: effect for effect in search.catalogue}
    named = [in_use.get(effect.name, effect) for effect in effects]
    return _Explored(named, prepared, search, comparison, alternatives(comparison, named, system), repeats)


def _found_before(explored: _Explored, film: Film | None) -> list[tuple[Stage, float]]:
    """The stages of causes that were found before the search, with the log likelihood lost without each."""
    found = [(EFFECTS[cause.effect].stage, lost) for cause, lost in explored.repeats]
    if film is not None and film.camera.best.camera:
        found.append((Stage.CAMERA, film.camera.lost))
    return found


def _pushes(explored: _Explored, world: World, source_leaves: Sequence[SmoothFunction]) -> tuple[Push, ...]:
    """The pushes beyond the best set where it explains the recording; beyond the source where it does not, which
    leaves these functions."""
    whole, comparison = explored.prepared.whole, explored.comparison
    if whole is None:
        return ()
    if source_leaves:
        return pushes(whole, world, source_leaves)
    if not any(has_episode_phases(effect) for effect in comparison.best.effects):
        return pushes(whole, _explained(world, comparison, 0), comparison.functions)
    worlds = [_explained(world, comparison, episode) for episode in range(len(whole.episodes))]
    return pushes(whole, worlds, comparison.functions)


def _explained(world: World, comparison: ModelComparison, episode: int) -> World:
    """The source with the best set's effects as fitted, with their phases in an episode."""
    best = comparison.best
    effects = [
        in_episode(effect, values.tolist(), episode) for effect, values in best.by_effect(best.fits.theta[0]).items()
    ]
    return world.with_effects(effects).double()


def _judge(explored: _Explored, measured: MeasuredGap) -> tuple[str, tuple[Cause, ...], tuple[Cause, ...]]:
    """The verdict, the causes that go with it, and those that close a part of a gap that is unexplained."""
    comparison, groups = explored.comparison, explored.groups
    repeats = [cause for cause, _ in explored.repeats]
    explaining = (*repeats, *causes(explored.search, comparison, groups, measured.closed))
    coarse = bool(explored.prepared.coarse)
    verdict = verdict_of(comparison, measured.gap, measured.improvable, explaining, bool(repeats), coarse)
    found = explaining if verdict in (IDENTIFIED, AMBIGUOUS) else ()
    closes = verdict == UNEXPLAINED and not measured.gap.closed <= 0  # NaN where the source predicts within the noise
    return verdict, found, tuple(without_slight(explaining)) if closes else ()


def _warnings(
    explored: _Explored, measured: MeasuredGap, verdict: str, found: Sequence[Cause], origin: str
) -> Iterator[str]:
    """What a reader of the diagnosis must know of the recording from `origin`, the comparison and the causes found."""
    comparison, whole = explored.comparison, explored.prepared.whole
    yield from explored.prepared.warnings
    if verdict == UNEXPLAINED and whole is not None and (unread := unread_states(whole, explored.search.system)):
        yield f"pushes in single episodes were not looked for: they need {listed(unread)}, which no sensor read"
    if not measured.errors.held_out:
        yield f"{origin}: {TOO_SHORT}"
    unexplained = comparison.unexplained(measured.improvable)
    yield from left_unexplained(comparison, verdict, unexplained)
    yield from at_bounds(comparison, found, explored.effects)
    bare = comparison.unchanged
    yield from shown_by_episodes(comparison, verdict, unexplained)
    if found:
        yield from phases_of_episodes(comparison.best)
        if bare > MAX_UNCHANGED and not explored.repeats:
            yield f"the unchanged simulator has a probability of {bare:.2f}: that there is a gap at all is not certain"
    carrying = {cause.effect for cause in without_slight(found)}
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

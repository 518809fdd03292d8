"""What is said of a recording of states: the verdict, its causes, and the pushes beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from visadapt.diagnosis.exploration import Explored, explore
from visadapt.diagnosis.measured_gap import MeasuredGap, measure
from visadapt.diagnosis.result import AMBIGUOUS, IDENTIFIED, UNEXPLAINED, Cause, Push
from visadapt.diagnosis.search.apart import ExplainedAlone
from visadapt.diagnosis.search.causes import causes
from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.diagnosis.search.passing_loads import passing_loads
from visadapt.diagnosis.search.pushed_rows import depart_from, share_left_out
from visadapt.diagnosis.search.pushes import pushes
from visadapt.diagnosis.search.repeated_causes import errors_with_repeats
from visadapt.diagnosis.search.unexplained import SmoothFunction
from visadapt.diagnosis.search.unexplained_load import has_joints
from visadapt.diagnosis.verdict import left_by_source, verdict_of
from visadapt.effects import Effect
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.episode_phases import has_episode_phases, in_episode
from visadapt.progress import Report, staged
from visadapt.recordings import Recording
from visadapt.world import World

MOST_LEFT_OUT = 0.25  # Share of the rows that may be left out because of pushes

ROUNDS = 2  # in which pushes are set aside: the first ones may hide others


@dataclass(frozen=True)
class Answer:
    """The verdict on a recording, and what it rests on."""

    explored: Explored
    measured: MeasuredGap
    verdict: str
    causes: tuple[Cause, ...]
    partial: tuple[Cause, ...]  # those that close a part of a gap that is unexplained
    source_leaves: list[SmoothFunction]  # where there are no causes
    pushes: tuple[Push, ...]  # beyond the causes; beyond the source where there are none
    set_aside: tuple[Push, ...]  # pushes whose rows were left out

    @property
    def no_gap_beside_pushes(self) -> bool:
        """Whether there is no gap in the rows that are not within pushes."""
        return bool(self.set_aside) and not self.causes


def answer(
    recording: Recording,
    world: World,
    effects: Sequence[type[Effect]],
    repeating: type[Effect],
    jobs: int,
    progress: Report | None,
    announce: Callable[[str], object] | None,
) -> Answer:
    """What explains a recording, if need be beside pushes.

    A push acts in one episode alone, as no effect does: while it is among the rows, the most probable set is one that
    imitates it. So where a recording is unexplained, the rows within pushes are left out, and the others are explained,
    unless all is explained in each of several recordings by itself: then it is the machine that was changed.
    If these have no gap, the recording stays unexplained, with what passes in `pushes`; if they stay unexplained, but
    an effect whose size changes explains all rows, there are no pushes.

    Args:
        world: the source.
        effects: those that may be causes.
        repeating: the effect that repeats whole rows.
        jobs, progress, announce: as `diagnose` takes them.
    """

    def beside(aside: tuple[Push, ...]) -> Explored:
        told = None if aside else announce
        return explore(recording, world.system, effects, repeating, aside, jobs, progress, told)

    explored = beside(())
    finder = _PushFinder(world, explored)
    first = latest = _answer(explored, finder, (), jobs, progress)
    for _ in range(ROUNDS):
        if latest.verdict != UNEXPLAINED or _without_pushes(latest.explored.apart):
            break
        found = _hiding(latest, finder)
        aside = (*latest.set_aside, *found)
        if not found or share_left_out(aside, recording, world.system) > MOST_LEFT_OUT:
            break
        latest = _answer(beside(aside), finder, aside, jobs, progress)
    if latest.verdict == UNEXPLAINED or not latest.pushes:
        # Beyond the source, an effect whose size changes may look like a push wherever it is large.
        return replace(first, pushes=()) if first.explored.changes else first
    # Beside what passes there is no gap, but what passes may be no push: an effect that acts in a few rows alone.
    return replace(latest, verdict=UNEXPLAINED) if latest.no_gap_beside_pushes else latest


def _answer(
    explored: Explored, finder: _PushFinder, aside: tuple[Push, ...], jobs: int, progress: Report | None
) -> Answer:
    search, comparison, groups = explored.search, explored.comparison, explored.groups
    repeats = [cause for cause, _ in explored.repeats]
    with_repeats = errors_with_repeats(explored.prepared, search) if repeats else None
    measured = measure(search, comparison, groups, with_repeats, jobs, staged(progress, "predictions"))
    explaining = (*repeats, *causes(search, comparison, groups, measured.closed))
    coarse = bool(explored.prepared.coarse)
    verdict = verdict_of(comparison, measured.gap, measured.improvable, explaining, bool(repeats), coarse)
    found = explaining if verdict in (IDENTIFIED, AMBIGUOUS) else ()
    closes = verdict == UNEXPLAINED and not measured.gap.closed <= 0  # NaN where the source predicts within the noise
    partial = tuple(one for one in explaining if _closes_part(one, measured.gap.closed)) if closes else ()
    if explored.changes:  # what else closes a part of the gap imitates the change
        changing = {effect.name for each in explored.changes for effect in each.effects}
        partial = tuple(cause for cause in partial if cause.effect in changing)
    source_leaves = [] if found else left_by_source(search)
    # Where the causes explain the recording, the pushes are those beyond them.
    beyond = (comparison.best, comparison.functions) if found else (search.source, source_leaves)
    passing = () if _without_pushes(explored.apart) else finder.pushes_beyond(explored, *beyond)
    if found and not aside and not comparison.unexplained(measured.improvable):
        model = CandidateModel(search.system, comparison.best.effects, search.rows)
        passing = depart_from(model, comparison.predicting, passing)
    return Answer(explored, measured, verdict, found, partial, source_leaves, passing, aside)


def _closes_part(cause: Cause, closed: float) -> bool:
    """Whether a cause of a gap that is unexplained is worth telling, where the best set has `closed` this share: it is
    not slight, or closes half as much by itself, so that others only take its place."""
    return not cause.slight or cause.gap_closed > 0.5 * closed


def _hiding(unexplained: Answer, finder: _PushFinder) -> tuple[Push, ...]:
    """Pushes that may hide what else acts: beyond the source or, if there are none, beyond the best set, of which an
    effect may imitate them, without each of its effects, or with all of them. None that are set aside already."""
    explored = unexplained.explored
    search, best = explored.search, explored.comparison.best

    def each() -> Iterator[tuple[Push, ...]]:
        yield unexplained.pushes
        for effect in sorted(best.effects, key=lambda one: not _is_in_time(one)):
            yield finder.pushes_beyond(explored, search.without(best, effect))
        yield finder.pushes_beyond(explored, best)

    for found in each():
        further = tuple(one for one in found if not any(one.overlaps(other) for other in unexplained.set_aside))
        if further:
            # What a function of the state imitates in part lasts longer beyond the bare source.
            whole = finder.pushes_beyond(explored, search.source)
            return (*further, *(one for one in whole if any(one.overlaps(other) for other in further)))
    return ()


def _without_pushes(apart: Sequence[ExplainedAlone]) -> bool:
    """Whether recordings are explained one by one, by effects none of which may stand for a push."""
    return bool(apart) and not any(_is_in_time(effect) for each in apart for effect in each.best.effects)


def _is_in_time(effect: type[Effect]) -> bool:
    """Whether the effect acts for a stretch of time."""
    region = effect.region()
    return region is not None and region[0].unit == "s"


@dataclass(frozen=True)
class _PushFinder:
    """Finds the pushes in a recording."""

    world: World  # the source
    explored: Explored  # all rows

    def pushes_beyond(
        self, explored: Explored, found: ScoredModel, functions: Sequence[SmoothFunction] = ()
    ) -> tuple[Push, ...]:
        """Those beyond the source with the effects of a set that was `explored`, perhaps without the rows of some of
        them, and that leaves these functions unexplained."""
        whole = self.explored.prepared.whole
        if not has_joints(self.world.system):
            return passing_loads(self.explored.search, found, explored.search.rows)
        if whole is None:
            return ()
        if not any(has_episode_phases(effect) for effect in found.effects):
            return pushes(whole, self._with(found, 0), functions)
        return pushes(whole, [self._with(found, episode) for episode in range(len(whole.episodes))], functions)

    def _with(self, found: ScoredModel, episode: int) -> World:
        """The source with the effects of a set, with their phases in an episode."""
        by_effect = found.by_effect(found.fits.theta[0])
        effects = [in_episode(effect, values.tolist(), episode) for effect, values in by_effect.items()]
        return self.world.with_effects(effects).double()

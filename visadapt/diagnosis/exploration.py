"""Which sets of effects explain a recording of states: prepare the rows, search, compare the best sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from visadapt.diagnosis.result import Cause, Push
from visadapt.diagnosis.search import duration
from visadapt.diagnosis.search.all_rows import best_on_all_rows, on_all_rows
from visadapt.diagnosis.search.apart import ExplainedAlone, explained_apart
from visadapt.diagnosis.search.causes import Alternative, alternatives
from visadapt.diagnosis.search.changing import Changing, changing
from visadapt.diagnosis.search.coloured import colour_left_by, with_coloured_noise
from visadapt.diagnosis.search.correlated_errors import lasting, with_correlated_errors
from visadapt.diagnosis.search.draft import PreparedRecording
from visadapt.diagnosis.search.earlier_commands import without_rows_on_earlier_commands
from visadapt.diagnosis.search.fitted_models import MIN_LEFTOVER
from visadapt.diagnosis.search.jumps import with_jumps
from visadapt.diagnosis.search.model_comparison import ModelComparison, compare
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.repeated_causes import repeated_reading_causes
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.search.searched_effects import searched
from visadapt.effects import Effect
from visadapt.estimation.segments import Segments
from visadapt.progress import Progress, Report, staged
from visadapt.recordings import Recording
from visadapt.systems import System


@dataclass(frozen=True)
class Explored:
    """A recording of states, and which sets of effects explain it."""

    effects: list[type[Effect]]  # that may be named
    prepared: PreparedRecording
    search: Search
    comparison: ModelComparison
    groups: list[list[Alternative]]  # the effects of the best set, each with those that fit as well in its place
    repeats: list[tuple[Cause, float]]  # causes of repeated readings, and the log likelihood lost without them
    apart: tuple[ExplainedAlone, ...]  # recordings that are explained one by one, and not together
    changes: tuple[Changing, ...]  # what explains everything if it changes within the recording, the likeliest first
    lasting: dict[tuple[str, ...], float]
    """where errors of readings last for several rows: how long, in s, by the states that one kind of sensor reads"""


@dataclass(frozen=True)
class _Searched:
    """A recording that was searched for sets of effects, with white noise."""

    prepared: PreparedRecording
    some_rows: Search  # of the rows searched
    search: Search  # of all rows
    comparison: ModelComparison


def explore(
    recording: Recording,
    system: System,
    effects: Sequence[type[Effect]],
    repeating: type[Effect],
    pushes: Sequence[Push],
    jobs: int,
    progress: Report | None,
    announce: Callable[[str], object] | None,
) -> Explored:
    """Search for the sets of `effects` that explain a recording of states, and compare the best of them.

    Args:
        repeating: the effect that repeats whole rows.
        pushes: the rows within them are left out.
        jobs, progress, announce: as `diagnose` takes them.
    """
    candidates = searched(effects, system)
    kind = "search beside pushes" if pushes else "search"

    def search_in(recording: Recording, announce: Callable[[str], object] | None) -> _Searched:
        prepared = prepare(recording, system, candidates, pushes)
        some = Search(system, prepared.rows.select(prepared.searched), candidates, prepared.source, jobs)
        if announce is not None:
            announce(duration.announcement(prepared.rows, len(effects), duration.expected(some, prepared.rows), jobs))
        whole = _on_all_rows(some, prepared.rows, staged(progress, kind))
        return _Searched(prepared, some, whole, compare(whole))

    found = search_in(recording, announce)
    shorter = without_rows_on_earlier_commands(recording, found.search, found.comparison.best)
    if shorter is not None:
        found = search_in(shorter[0], None)
        found = replace(found, prepared=replace(found.prepared, warnings=(*found.prepared.warnings, shorter[1])))
    prepared, search, comparison = found.prepared, found.search, found.comparison
    repeats = repeated_reading_causes(prepared, search, comparison, repeating)
    apart: tuple[ExplainedAlone, ...] = ()
    changes: tuple[Changing, ...] = ()
    again = staged(progress, "search with correlated errors")
    correlated = with_correlated_errors(search, comparison, prepared.searched, again)
    if correlated:
        search, comparison = correlated
    elif comparison.leftover > MIN_LEFTOVER and not comparison.negligible and not search.rows.jumps:
        apart = explained_apart(found.some_rows, candidates, recording.sources, progress)
        changes = () if apart else changing(found.some_rows, recording.sources, _unknown(comparison, found))
    if not (apart or changes or correlated):
        again = staged(progress, "search with coloured noise")
        search, comparison = with_coloured_noise(search, comparison, prepared.searched, again)
    # Periodic effects may have got a phase for each episode.
    in_use = {effect.name: effect for effect in search.catalogue}
    named = [in_use.get(effect.name, effect) for effect in effects]
    groups = alternatives(comparison, named, system)
    errors = lasting(search) if correlated else {}
    return Explored(named, prepared, search, comparison, groups, repeats, apart, changes, errors)


def _unknown(comparison: ModelComparison, found: _Searched) -> float:
    """Log odds, on the rows searched, of the likeliest function that the best set leaves out and that time alone does
    not give."""
    share = float(found.some_rows.rows.inside.sum() / found.search.rows.inside.sum())
    return share * max((one.log_odds for one in comparison.functions if one.variable != "time"), default=0.0)


def _on_all_rows(search: Search, rows: Segments, progress: Progress | None) -> Search:
    """A search that has not begun, run and continued on all `rows`; with jumps of the velocities as process noise,
    where these explain more."""
    jumping = with_jumps(search)
    if jumping is None:
        search.run(progress)
        return on_all_rows(search, rows)
    rows = replace(rows, jumps=True)
    if colour_left_by(jumping, jumping.best) is not None:
        # A machine that resonates: its larger sets are looked for with coloured noise alone.
        return best_on_all_rows(jumping, rows)
    jumping.run(progress)
    return on_all_rows(jumping, rows)

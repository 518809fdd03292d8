"""The gap as predictions of held-out episodes show it: of the source, of the causes, and of a black box beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from visadapt.diagnosis.prediction_errors import PredictionErrors
from visadapt.diagnosis.result import Gap
from visadapt.diagnosis.search import heldout
from visadapt.diagnosis.search.causes import Alternative, GapClosed
from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.diagnosis.search.heldout import RolloutErrors
from visadapt.diagnosis.search.model_comparison import ModelComparison
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.verdict import MIN_GAP_CLOSED
from visadapt.estimation.fit_states import Effects
from visadapt.estimation.likelihood import FitState
from visadapt.progress import Progress

RUNNERS_UP = 2  # Sets after the best for which the share of the gap that they close is computed

PARTS = 3  # Of the progress: source and best set, all other sets, the black box


@dataclass(frozen=True)
class MeasuredGap:
    """Predictions of held-out episodes, and what they say of the gap."""

    source: RolloutErrors
    corrected: RolloutErrors  # with the best set
    errors: PredictionErrors
    closed: GapClosed
    improvable: bool  # whether a black box beside the best set clearly predicts better

    @property
    def gap(self) -> Gap:
        """The errors at the longest horizon."""
        return self.errors.gap()


def measure(
    search: Search,
    comparison: ModelComparison,
    groups: Sequence[Sequence[Alternative]],
    with_repeats: RolloutErrors | None,
    jobs: int = 1,
    progress: Progress | None = None,
) -> MeasuredGap:
    """Predict with the source, the best set, the set less each effect, each cause alone and the runners-up.

    Args:
        groups: the causes, each with those that fit as well.
        with_repeats: the source's predictions against readings that include the repeated ones, where there are any.
        jobs: processes that share the work.
    """

    def done(parts: int) -> None:
        if progress is not None:
            progress(parts, PARTS, math.nan)

    rows, best = search.rows, comparison.best
    alone = [search.single(effect) for effect in dict.fromkeys(one.canonical for group in groups for one in group)]
    runners_up = [compared.model for compared in comparison.models[1 : 1 + RUNNERS_UP]]
    without = [search.without(best, effect) for effect in best.effects]
    noise = (best.fits.log_noise[0] / 2).exp()
    shown = {frozenset(f.names): f for f in [search.source, replace(best, fits=comparison.predicting)]}
    sets = {names: f for f in [*alone, *without, *runners_up] if (names := frozenset(f.names)) not in shown}
    rollouts = heldout.held_out(search.system, rows, _fitted(shown), lambda errors: errors, jobs)
    done(1)
    source, corrected = rollouts[0], rollouts[-1]
    rms = [errors.rms(noise) for errors in rollouts]
    reached = rms[-1]
    rms += heldout.held_out(search.system, rows, _fitted(sets), lambda errors: errors.rms(noise), jobs)
    done(2)
    source = with_repeats or source
    source_rms, held_out, several = source.rms(noise), rows.shape[0] > 1, len(rows.episode.unique()) > 1
    floor = corrected.floor(noise)
    errors = PredictionErrors(source_rms, reached, floor, reached, noise, rows.period, held_out, several)
    improvable = False
    if held_out and errors.gap().closed < MIN_GAP_CLOSED:  # else a black box cannot close enough of what is left
        black_box = heldout.beside_black_box(search.system, rows, best.effects, best.fits, jobs)
        best_reached = min((reached, black_box.rms(noise)), key=lambda error: float(heldout.overall(error)[-1]))
        errors = replace(errors, black_box=best_reached)
        gap = errors.gap()
        left = heldout.closed(gap.before, gap.black_box, gap.floor) - gap.closed
        improvable = left > 1 - MIN_GAP_CLOSED and heldout.predicts_better(black_box, corrected, noise)
    done(PARTS)
    closed = {names: errors.closed_by(each) for names, each in zip([*shown, *sets], rms, strict=True)}
    return MeasuredGap(source, corrected, errors, closed, improvable)


def _fitted(sets: Mapping[frozenset[str], ScoredModel]) -> list[tuple[Effects, FitState]]:
    return [(each.effects, each.fits) for each in sets.values()]

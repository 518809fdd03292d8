"""Effects whose size changes within a recording: a battery runs down, a bearing warms up, a load is dropped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from visadapt.diagnosis.search.fitted_models import FittedModels, ScoredModel, key_of
from visadapt.diagnosis.search.search import Search
from visadapt.effects import Role
from visadapt.estimation.fit_states import CAREFUL, with_effect

MOST_PARTS, FEWEST_PARTS = 6, 3
"""Stretches of a recording to which the same effects are fitted, each with sizes of its own: as many as there are
windows, within these limits."""

MOST_TRIED = (4, 2)
"""Sets of one effect and of two that are tried, the most probable first: of two where no single one explains all."""

MIN_LOG_ODDS = 10.0  # By which they must be likelier so than with one size: each stretch pays for sizes of its own

MAX_LEFT = 0.15
"""Share of what the set leaves to process noise with one size that it may leave with one for each stretch, the stretch
with most of it aside: there a load may have been dropped. Foreign effects left half of it or more."""

AS_LIKELY = 5.0  # Log odds behind the best set up to which another one is said too

IN_TIME = {Role.START, Role.END, Role.FREQUENCY, Role.PHASE}  # of parameters of effects that say when they act


@dataclass(frozen=True)
class Changing:
    """A set of effects that explains every stretch of a recording, with other sizes in each."""

    fits: tuple[ScoredModel, ...]  # in the order of time
    log_odds: float


def changing(search: Search) -> tuple[Changing, ...]:
    """What explains a recording if its sizes may change within it, the most probable first; nothing, where they do not
    or that does not explain it either."""
    parts = _stretches(search)
    if len(parts) < FEWEST_PARTS:
        return ()
    fitted = [FittedModels(search.system, search.rows.select(part), search.catalogue) for part in parts]
    for tried in _tried(search):
        if found := [one for each in tried if (one := _in_stretches(search, fitted, each))]:
            found.sort(key=lambda one: -one.log_odds)
            return tuple(one for one in found if one.log_odds >= found[0].log_odds - AS_LIKELY)
    return ()


def _in_stretches(search: Search, stretches: Sequence[FittedModels], whole: ScoredModel) -> Changing | None:
    """A set fitted to each stretch, if that explains the recording."""
    start = whole.fits.theta[0].tolist()
    fits = [each.fit([(whole.effects, with_effect(each.source.fits, start))], CAREFUL)[0] for each in stretches]
    left = sorted(each.without_process_noise([fit])[0].left for each, fit in zip(stretches, fits, strict=True))
    fits = [each.fitted[key_of(whole.effects)] for each in stretches]  # perhaps a better one, without process noise
    # In a stretch in which nothing acts, the recording says nothing about the set, and the source is the answer.
    log_odds = sum(max(fit.log_odds, each.source.log_odds) for each, fit in zip(stretches, fits, strict=True))
    found = Changing(tuple(fits), log_odds)
    if found.log_odds <= search.best.log_odds + MIN_LOG_ODDS:
        return None
    return found if sum(left[:-1]) <= MAX_LEFT * search.without_process_noise([whole])[0].left else None


def _stretches(search: Search) -> list[Tensor]:
    """The windows of each stretch, in the order of time."""
    rows = search.rows
    order = sorted(range(rows.shape[0]), key=lambda k: (int(rows.episode[k]), float(rows.time[k, 0])))
    count = min(MOST_PARTS, len(order))
    edges = [len(order) * k // count for k in range(count + 1)]
    return [torch.tensor(sorted(order[a:b])) for a, b in pairwise(edges)]


def _tried(search: Search) -> list[list[ScoredModel]]:
    """The most probable sets of one effect, and those of two, that act all the time."""
    steady = [
        each
        for each in search.ranked
        if math.isfinite(each.log_odds) and not any(p.role in IN_TIME for e in each.effects for p in e.table)
    ]
    return [[each for each in steady if len(each.effects) == size][:count] for size, count in enumerate(MOST_TRIED, 1)]

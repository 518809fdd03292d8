"""Effects whose size changes within a recording, or between recordings: a battery runs down, a bearing warms up, a load
is dropped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.diagnosis.search.apart import windows_by_file
from visadapt.diagnosis.search.causes import is_at_end
from visadapt.diagnosis.search.fitted_models import FittedModels, NoFitError, ScoredModel, key_of
from visadapt.diagnosis.search.search import Search
from visadapt.effects import Effect, Role
from visadapt.estimation.fit_states import CAREFUL, neutral, posterior, with_effect

MOST_PARTS, FEWEST_PARTS = 6, 3
"""Files are the stretches where there are MOST_PARTS at most, and sizes that change between them explain all. Otherwise
the windows are cut into MOST_PARTS stretches, or are stretches themselves, FEWEST_PARTS at least."""

MOST_TRIED = (4, 2)
"""Sets of one effect and of two that are tried, the most probable first: of two where no single one explains all."""

MIN_LOG_ODDS = 10.0  # By which they must be likelier so than with one size: each stretch pays for sizes of its own

MIN_CHANGE = 4.0
"""Deviations by which the size of an effect must depart from its mean in a stretch: the noise may change as well."""

MAX_LEFT = 0.15
"""Share of what the set leaves to process noise with one size that it may leave with one for each stretch, the stretch
with most of it aside: there a load may have been dropped. Sets that were not what changed left half of it or more."""

AS_LIKELY = 5.0  # Log odds behind the best set up to which another one is said too

IN_TIME = {Role.START, Role.END, Role.FREQUENCY, Role.PHASE}
"""Roles of parameters of effects that act in a region of a state or of time, or periodically: these are not tried."""


@dataclass(frozen=True)
class Changing:
    """A set of effects that explains every stretch of a recording, with other sizes in each."""

    effects: tuple[type[Effect], ...]
    values: tuple[tuple[float, ...], ...]  # of their parameters, in each stretch, in the order of time
    log_odds: float
    files: tuple[str, ...] = ()  # which the stretches are, where sizes change from file to file alone; else none
    starts: tuple[float, ...] = ()  # s at which the stretches start, where all are of one episode; else none


def changing(search: Search, sources: Sequence[str], unknown: float = 0.0) -> tuple[Changing, ...]:
    """What explains a recording if its sizes may change within it, the most probable first; nothing, where they do not
    or that does not explain it either. Where sizes that change from file to file explain it, it is these.

    Args:
        search: that has run.
        sources: those of the recording's episodes (`Recording.sources`).
        unknown: log odds that an unknown function of constant size adds to the best set; changes must add more.
    """
    files = windows_by_file(search.rows, sources)
    least = search.best.log_odds + max(MIN_LOG_ODDS, unknown)
    if 1 < len(files) <= MOST_PARTS and (found := _between(search, list(files.values()), least)):
        return tuple(replace(one, files=tuple(files)) for one in found)
    count = search.rows.shape[0]
    if count < FEWEST_PARTS:
        return ()
    parts = torch.arange(count).tensor_split(min(MOST_PARTS, count))
    one_episode = len(search.rows.episode.unique()) == 1
    starts = tuple(float(search.rows.time[part[0], 0]) for part in parts if one_episode)
    return tuple(replace(one, starts=starts) for one in _between(search, parts, least))


def _between(search: Search, parts: Sequence[Tensor], least: float) -> tuple[Changing, ...]:
    """What explains a recording, with more than the `least` log odds, if its sizes may change from one of these parts,
    of the windows, to the next."""
    try:
        stretches = [
            FittedModels(search.system, search.rows.select(part), search.catalogue, jobs=search.jobs) for part in parts
        ]
    except NoFitError:
        return ()
    for tried in _tried(search):
        found = [one for each in tried if (one := _in_stretches(search, stretches, each))]
        if found := [one for one in found if one.log_odds > least]:
            found.sort(key=lambda one: -one.log_odds)
            return tuple(one for one in found if one.log_odds >= found[0].log_odds - AS_LIKELY)
    return ()


def _in_stretches(search: Search, stretches: Sequence[FittedModels], whole: ScoredModel) -> Changing | None:
    """A set with sizes of its own in each stretch, if they change, and that explains the recording."""
    start = whole.fits.theta[0].tolist()
    fits = [each.fit([(whole.effects, with_effect(each.source.fits, start))], CAREFUL)[0] for each in stretches]
    left = sorted(each.without_process_noise([fit])[0].left for each, fit in zip(stretches, fits, strict=True))
    if sum(left if len(left) < FEWEST_PARTS else left[:-1]) > MAX_LEFT * search.without_process_noise([whole])[0].left:
        return None
    fits = [each.fitted[key_of(whole.effects)] for each in stretches]  # perhaps a better one, without process noise
    if not _change(fits):
        return None
    nothing = tuple(value for effect in whole.effects for value in neutral(effect))
    # In a stretch in which nothing acts, the recording says nothing about the set, and the source is the answer.
    acts = [fit.log_odds > each.source.log_odds for each, fit in zip(stretches, fits, strict=True)]
    values = [tuple(fit.fits.theta[0].tolist()) if act else nothing for fit, act in zip(fits, acts, strict=True)]
    log_odds = sum(max(fit.log_odds, each.source.log_odds) for each, fit in zip(stretches, fits, strict=True))
    if log_odds < sum(each.source.log_odds for each in stretches) + MIN_LOG_ODDS:
        return None  # the noise alone differs from stretch to stretch
    table = [parameter for effect in whole.effects for parameter in effect.table]
    sizes = [(parameter, size) for each in values for parameter, size in zip(table, each, strict=True)]
    if any(is_at_end(one, size, end) for one, size in sizes for end in (one.low, one.high)):
        return None  # what goes to the end of its range imitates something else
    return Changing(whole.effects, tuple(values), log_odds)


def _change(fits: Sequence[ScoredModel]) -> bool:
    """Whether a parameter departs from its mean over the stretches by more than the noise."""
    values = torch.cat([fit.fits.theta for fit in fits])
    variance = torch.stack(
        [torch.linalg.inv_ex(posterior(fit.effects, fit.fits)[1]).inverse.diagonal().clamp(min=0) for fit in fits]
    )
    mean = (values / variance).sum(0) / variance.reciprocal().sum(0)
    return bool(((values - mean).abs() > MIN_CHANGE * variance.sqrt()).any())


def _tried(search: Search) -> list[list[ScoredModel]]:
    """The most probable sets of one effect, and those of two, that act all the time."""
    steady = [
        each
        for each in search.ranked
        if math.isfinite(each.log_odds) and not any(p.role in IN_TIME for e in each.effects for p in e.table)
    ]
    return [[each for each in steady if len(each.effects) == size][:count] for size, count in enumerate(MOST_TRIED, 1)]

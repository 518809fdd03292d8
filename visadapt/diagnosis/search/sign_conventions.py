"""Whether a recording is to be read in another way: with another sign of the angle or the command, say."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.words import listed
from visadapt.effects import Effect
from visadapt.estimation.fit_states import QUICK
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import Convention, profile_of
from visadapt.estimation.segments import Segments
from visadapt.estimation.unmeasured_states import with_unmeasured
from visadapt.systems import System

SUSPICIOUS_LOG_PROCESS = math.log(0.02**2)
"""Log variance of the velocities' process noise, (m/s)^2 and (rad/s)^2, above which the source fits so badly that signs
and sensors are checked."""

MIN_GAIN_PER_READING = 0.1
"""Log likelihood per reading that another convention must gain to be taken for that of the recording."""

ALIKE = 10.0  # Log likelihood of the source within which two conventions are as likely

EFFECTS_ADDED, MOST_EFFECTS_ADDED, LEADS = 2, 6, 3
"""Before it is decided in which way a recording is read, EFFECTS_ADDED effects are added one by one to the source in
both, as it is given and in the best other way, since a large effect can look like a wrong sign. While the other way is
ahead, but not clearly, further effects are added, up to MOST_EFFECTS_ADDED. LEADS effects are tried for each one
added."""


def opposite_signs(
    system: System, rows: Segments, catalogue: Sequence[type[Effect]], source: FitState, fitted: FitState | None
) -> Convention | None:
    """The convention in which the recording is far likelier than in the source's, if there is one. Where a mirror image
    moves alike, several are as likely: it then has the names of all, and the signs of the first.

    `catalogue` are the effects that may be present, `source` is a fit of the source before bad readings were excluded,
    `fitted` that to `rows`, if known.
    """
    every = [
        each for each in profile_of(system).sign_conventions if each.commands or {*each.columns} & {*rows.channels}
    ]
    if not every or float(source.log_process.max()) < SUSPICIOUS_LOG_PROCESS:
        return None
    required = MIN_GAIN_PER_READING * float(rows.used.sum())
    as_given = Search(system, rows, catalogue, fitted)
    conventions = [with_unmeasured(to_source(rows, convention), system) for convention in every]
    others = [Search(system, each, catalogue, rival=_likelihood(as_given)) for each in conventions]
    most = max(_likelihood(each) for each in others)
    alike = [k for k, each in enumerate(others) if _likelihood(each) >= most - ALIKE]
    if not stays_ahead(others[alike[0]], as_given, required):
        return None
    return replace(every[alike[0]], name=listed([every[k].name for k in alike], "or"))


def stays_ahead(
    other: Search, as_given: Search, required: float, beside: Callable[[], Sequence[ScoredModel]] = tuple
) -> bool:
    """Whether a recording read in another way is likelier than as it is given, by the log likelihood that is required:
    under the source and, if it is, when effects are added to the source in both, and to sets `beside` it in the
    other, and with the other's best set in both."""
    if float(other.source.fits.likelihood[0] - as_given.source.fits.likelihood[0]) <= required:
        return False
    if not other.catalogue:
        return True
    # A sensor that is late by a period can look like a wrong sign, and the screening does not see it.
    for search in (as_given, other):
        search.try_late_sensors()
    bases = beside()
    for added in range(MOST_EFFECTS_ADDED):
        if added >= EFFECTS_ADDED and not 0 < _ahead(other, as_given) <= required:
            break
        for search in (as_given, other):
            search.extend([search.best], LEADS)
        bases = [max(other.extend([base], LEADS), key=lambda each: each.log_odds, default=base) for base in bases]
    if _ahead(other, as_given) <= required:
        return False
    # What explains the other way may explain this one as well, and not be among the leads of its own sets.
    same = as_given.fit([(other.best.effects, other.best.fits)], QUICK) if other.best.effects else []
    return all(_likelihood(other) - float(each.fits.likelihood[0]) > required for each in same)


def _ahead(one: Search, other: Search) -> float:
    """Log likelihood by which the best set so far of one search exceeds that of another."""
    return _likelihood(one) - _likelihood(other)


def _likelihood(search: Search) -> float:
    return float(search.best.fits.likelihood[0])


def signs(turned: Sequence[int], columns: Iterable[int]) -> Tensor:
    """(m,) factors of these columns: -1 of those that are `turned`, else 1."""
    return torch.tensor([-1.0 if column in turned else 1.0 for column in columns], dtype=torch.float64)


def to_source(rows: Segments, convention: Convention) -> Segments:
    """Rows of another convention in that of the source."""
    measured = rows.measured * signs(convention.columns, rows.channels)
    command = rows.command * signs(convention.commands, range(rows.command.shape[-1]))
    return replace(rows, measured=measured, command=command)

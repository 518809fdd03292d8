"""Which effects: a search over sets of them, forwards, backwards and sideways, judged by their evidence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.effects import Effect
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fit_states import (
    CAREFUL,
    QUICK,
    Effects,
    extended,
    first_fits,
    joined,
    neutral,
    only,
    posterior,
    widths,
)
from visadapt.estimation.likelihood import FitState, fit
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.screening import Candidate, screen
from visadapt.estimation.segments import Segments
from visadapt.progress import Progress
from visadapt.systems import System

MOST = 6
"""Effects in a set."""

LEADS = 8
"""Effects that are tried beside each set."""

SUSPICIOUS = 5.0
WIDE = 6
"""Log likelihood that process noise adds to the best set from which on the search is widened, to so many sets."""

CLOSE = 8.0
POLISHED = 8
"""Log posterior odds that a set may be behind the best to be fitted carefully, and how many are at most."""

UNLEARNT = 0.1
"""Share of its prior variance that a parameter may keep."""

DECADES = 3
"""Decades over which the prior of a strength is spread."""

PRIOR = -1.0
"""Log prior odds that one effect more is there, whichever of the catalogue."""


@dataclass(frozen=True)
class ScoredModel:
    """One set of effects, fitted to a recording."""

    effects: Effects
    fits: FitState
    """of this set alone, in the order of its effects' parameters"""
    evidence: float
    """log posterior odds, up to a constant"""

    @property
    def names(self) -> tuple[str, ...]:
        """Standard names."""
        return tuple(effect.name for effect in self.effects)


class Search:
    """The sets fitted so far to one recording, and how to fit more.

    Args:
        system: the source.
        rows: the recording.
        catalogue: the effects that are searched.
        source: the fit of the source to these rows, where it is known already.
    """

    def __init__(
        self,
        system: System,
        rows: Segments,
        catalogue: Sequence[type[Effect]],
        source: FitState | None = None,
    ) -> None:
        self.system = system
        self.profile = profile_of(system)
        self.rows = rows
        self.catalogue = tuple(catalogue)
        self.fitted: dict[frozenset[str], ScoredModel] = {}
        self._slopes: tuple[Tensor, Tensor] | None = None
        self._screened: dict[tuple[str, ...], tuple[FitState, list[Candidate]]] = {}
        if source is None:
            self.fit([((), first_fits(system, rows))], CAREFUL)
        else:
            self.fitted[frozenset()] = ScoredModel((), source, float(source.likelihood[0]))

    def run(self, progress: Progress | None = None) -> None:
        """Grow sets while that makes them more probable; then try their neighbours."""
        beam = [self.source]
        for size in range(MOST):
            if progress is not None:
                progress(size, MOST, -self.best.evidence)
            before = self.best
            children = self.extend(beam)
            if not children:
                break
            beam = sorted(children, key=lambda f: -f.evidence)[: self.profile.beam]
            if beam[0].evidence < before.evidence:
                break
        self._settle()
        if self.leftover([self.best])[0] > SUSPICIOUS:
            # Something is left: perhaps two effects that show only together, behind singles that seem to do.
            self._widen()
            self._settle()
        if progress is not None:
            progress(MOST, MOST, -self.best.evidence)

    def _settle(self) -> None:
        """Exchange, take away and fit carefully until the best set stays the best."""
        for _ in range(3):
            before = self.best
            self.neighbours(before)
            self.polish()
            if self.best.names == before.names:
                return

    def _widen(self) -> None:
        """Pairs from many singles, and triples from many pairs."""
        for size in (1, 2):
            bases = [f for f in self.ranked if len(f.effects) == size and f.evidence > -math.inf][:WIDE]
            self.extend(bases)

    @property
    def source(self) -> ScoredModel:
        """The empty set."""
        return self.fitted[frozenset()]

    @property
    def ranked(self) -> list[ScoredModel]:
        """The most probable first."""
        return sorted(self.fitted.values(), key=lambda f: -f.evidence)

    @property
    def best(self) -> ScoredModel:
        """The most probable."""
        return self.ranked[0]

    def extend(self, bases: Sequence[ScoredModel], leads: int = LEADS) -> list[ScoredModel]:
        """Every base with one effect more, its most promising ones."""
        starts = []
        seen = set()
        for base in bases:
            for lead in self._leads(base)[:leads]:
                effects = (*base.effects, lead.effect)
                key = frozenset(e.name for e in effects)
                if key not in self.fitted and key not in seen:
                    seen.add(key)
                    starts.append((effects, extended(base.fits, lead.values)))
        return self.fit(starts, QUICK)

    def _leads(self, base: ScoredModel) -> list[Candidate]:
        """What is worth fitting beside a set, the most promising first."""
        fits, leads = self._screened.get(base.names, (None, []))
        if fits is not base.fits:
            rest = [e for e in self.catalogue if e not in base.effects]
            every = screen(self.system, base.effects, base.fits, self.rows, rest)
            least, each = self.profile.promising
            beside = self.profile.rivalling * max((lead.gain for lead in every), default=0.0)
            leads = [lead for lead in every if lead.gain >= max(beside, least + each * len(lead.values))]
            self._screened[base.names] = base.fits, leads
        return leads

    def neighbours(self, centre: ScoredModel) -> None:
        """Sets with one effect less, and with one exchanged for another."""
        smaller = []
        starts = []
        for gone in centre.effects:
            effects = tuple(e for e in centre.effects if e is not gone)
            key = frozenset(e.name for e in effects)
            if key in self.fitted and not self.profile.retried:
                smaller.append(self.fitted[key])
            else:
                starts.append((effects, _shrunk(centre, gone)))
        smaller += self.fit(starts, QUICK)
        self.extend(smaller, leads=5)

    def polish(self) -> None:
        """Fit those carefully that may be the answer, and the best set's subsets, against which its effects count."""
        best = self.best
        close = [f for f in self.ranked if f.evidence > best.evidence - CLOSE][:POLISHED]
        smaller = [self.fitted.get(frozenset(best.names) - {name}) for name in best.names]
        close += [f for f in smaller if f is not None and all(f is not other for other in close)]
        self.fit([(f.effects, f.fits) for f in close], CAREFUL)

    def single(self, effect: type[Effect]) -> ScoredModel:
        """One effect alone."""
        key = frozenset({effect.name})
        if key not in self.fitted:
            self.fit([((effect,), self._lead(self.source, effect))], QUICK)
        return self.fitted[key]

    def exchange(self, whole: ScoredModel, gone: type[Effect], new: type[Effect]) -> ScoredModel:
        """A set with one of its effects exchanged for another."""
        kept = tuple(e for e in whole.effects if e is not gone)
        base = self.fitted.get(frozenset(e.name for e in kept)) or self.fit([(kept, _shrunk(whole, gone))], QUICK)[0]
        return self.fit([((*base.effects, new), self._lead(base, new))], CAREFUL)[0]

    def _lead(self, base: ScoredModel, effect: type[Effect]) -> FitState:
        leads = screen(self.system, base.effects, base.fits, self.rows, [effect])
        return extended(base.fits, leads[0].values if leads else neutral(effect))

    def leftover(self, sets: Sequence[ScoredModel]) -> list[float]:
        """Log likelihood that process noise adds to each set: how much it leaves unexplained."""
        models = [CandidateModel(self.system, f.effects, self.rows) for f in sets]
        quiet = fit(models, joined([f.fits for f in sets]), self._counts(len(sets)), QUICK[0], still=True)
        return [max(0.0, float(f.fits.likelihood[0] - q)) for f, q in zip(sets, quiet.likelihood, strict=True)]

    def fit(self, starts: Sequence[tuple[Effects, FitState]], effort: tuple[int, int]) -> list[ScoredModel]:
        """Fit sets of effects, each from a start, QUICK or CAREFUL; what is better than before is kept."""
        if not starts:
            return []
        iterations, care = effort
        models = [CandidateModel(self.system, effects, self.rows, care) for effects, _ in starts]
        for model in models:
            model.slopes = self._slopes
        out = fit(models, joined([fits for _, fits in starts]), self._counts(len(starts)), iterations)
        if self._slopes is None:
            self._slopes = models[0].slopes
        results = []
        for k, (effects, _) in enumerate(starts):
            own = only(out, k, len(models[k].table))
            fitted = ScoredModel(effects, own, evidence(effects, own, len(self.catalogue)))
            key = frozenset(fitted.names)
            if key not in self.fitted or self.fitted[key].evidence < fitted.evidence:
                self.fitted[key] = fitted
            results.append(self.fitted[key])
        return results

    def _counts(self, count: int) -> Tensor:
        return torch.ones(count, self.rows.shape[0], dtype=torch.float64)


def evidence(effects: Effects, fits: FitState, catalogue: int) -> float:
    """Log posterior odds of a set, by Laplace's approximation; -inf where the data say nothing of an effect.

    A strength is as likely in any decade (Jeffreys' prior, over DECADES below its range), to either side; a shape is
    as likely anywhere in its range. MacKay (2003), Information Theory, Inference and Learning Algorithms, chapter 28.
    """
    table = [p for e in effects for p in e.table]
    if not table:
        return float(fits.likelihood[0])
    width = widths(effects)
    precision, whole = posterior(effects, fits)
    sure = torch.linalg.inv(whole).diagonal()
    if _vague(effects, fits, sure, precision):
        return -math.inf
    density = -width.log()
    for k, parameter in enumerate(table):
        if parameter.neutral is not None:
            size = max(abs(float(fits.theta[0, k]) - parameter.neutral), math.sqrt(float(sure[k])))
            sides = 1 + (parameter.low < parameter.neutral < parameter.high)
            density[k] = -math.log(sides * DECADES * math.log(10) * size)
    occam = (
        float(density.sum()) + 0.5 * len(table) * math.log(2 * math.pi) - 0.5 * float(torch.linalg.slogdet(whole)[1])
    )
    return float(fits.likelihood[0]) + min(0.0, occam) + len(effects) * (PRIOR - math.log(max(1, catalogue)))


def _vague(effects: Effects, fits: FitState, sure: Tensor, precision: Tensor) -> bool:
    """Whether all strengths of an effect may be nothing, or all its shapes are unlearnt: a gust that never ends."""
    first = 0
    for effect in effects:
        strengths, shapes = [], []
        for k, parameter in enumerate(effect.table, first):
            unlearnt = float(sure[k] * precision[k]) > UNLEARNT
            if parameter.neutral is None:
                shapes.append(unlearnt)
            else:
                away = abs(float(fits.theta[0, k]) - parameter.neutral)
                strengths.append(unlearnt and away < 2 * math.sqrt(float(sure[k])))
        first += len(effect.table)
        # One shape alone may trade places with another effect's strength: a spring's rest with a force.
        if (strengths and all(strengths)) or (len(shapes) > 1 and all(shapes)):
            return True
    return False


def _shrunk(whole: ScoredModel, gone: type[Effect]) -> FitState:
    kept = [e is not gone for e in whole.effects for _ in e.table]
    base = whole.fits
    theta = base.theta[:, torch.tensor(kept, dtype=torch.bool)]
    # What is missing then is disturbance, which has to be there from the start to be found.
    process = base.log_process.clamp(min=math.log(0.02**2))
    return replace(base, theta=theta, log_process=process)

"""The search over sets of effects: add, remove and exchange effects while that raises the posterior odds.

Sets grow from the source and from every effect alone. Those near the best are then tried: with one effect fewer, with
one exchanged, and with two exchanged for one, since two effects often imitate a third (a weaker motor and a lighter
pole, a heavier cart).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import torch
from torch import Tensor

from visadapt.diagnosis.search.model_evidence import log_posterior_odds
from visadapt.effects import Effect
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fit_states import (
    CAREFUL,
    FINAL,
    QUICK,
    Effects,
    initial_fit,
    neutral,
    single_fit,
    stacked,
    with_effect,
)
from visadapt.estimation.fitting import OUT_OF_REACH, fit
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.screening import Candidate, screen
from visadapt.estimation.segments import Segments
from visadapt.processes import shared_out
from visadapt.progress import Progress
from visadapt.systems import System

MAX_EFFECTS = 6  # Effects in a set at most

ROWS_AT_ONCE = 100_000  # Rows times sets that are fitted together, so that memory is bounded

MAX_CANDIDATES, MAX_EXCHANGES = 8, 5
"""Effects that are fitted in addition to each set when sets grow, and when effects are exchanged."""

LEADERS = 4  # Sets that are fitted before the others, where some fall far behind

FIT_ALL_ABOVE = 100.0  # Log likelihood that the best effect promises, above which every effect is fitted alone

EXCHANGE_LOG_PROCESS = math.log(0.003**2)
"""Least log variance of the velocities' process noise, (m/s)^2 and (rad/s)^2, with which a fit starts after an
exchange: room for what the new effect does not yet explain, and little to shed where it explains all."""

WIDEN_ABOVE = 5.0
WIDEN_MODELS = 6
"""Log likelihood that process noise adds to the best set, above which the search is widened, and to how many of the
best sets of one and of two effects."""

POLISH_WITHIN, POLISH_SIMPLER_WITHIN = 8.0, 60.0
POLISH_MODELS = 8
"""Log posterior odds behind the best within which sets are fitted carefully, sets with fewer parameters within more,
since a quick fit of a set that is right may not have shed all its process noise; and the most of them."""


class NoFitError(ValueError):
    """The source's fit to a recording ends in numbers that are not finite; the message is one line."""


@dataclass(frozen=True)
class ScoredModel:
    """One set of effects, fitted to a recording."""

    effects: Effects
    fits: FitState  # of this set alone (C = 1), parameters in the order of the effects
    log_odds: float  # log posterior odds, up to a constant

    @property
    def names(self) -> tuple[str, ...]:
        """Standard names of the effects."""
        return tuple(effect.name for effect in self.effects)


class Search:
    """The sets of effects of a catalogue fitted so far to one recording, and how to fit more.

    Args:
        source: the fit of the source to these rows, if it is already known, or to some of them, where it then starts.
        jobs: processes that share the work.
        rival: log likelihood of a fit to the same readings; fits that cannot come near it stop early.
    """

    def __init__(
        self,
        system: System,
        rows: Segments,
        catalogue: Sequence[type[Effect]],
        source: FitState | None = None,
        jobs: int = 1,
        rival: float = -math.inf,
    ) -> None:
        self.system = system
        self.profile = profile_of(system)
        self.rows = rows
        self.catalogue = tuple(catalogue)
        self.jobs = jobs
        self._rival = rival
        self.fitted: dict[frozenset[str], ScoredModel] = {}
        self._slopes: tuple[Tensor, Tensor] | None = None
        self._screened: dict[tuple[str, ...], tuple[FitState, list[Candidate]]] = {}
        self._exchanged: set[tuple[frozenset[str], frozenset[str]]] = set()
        if source is None:
            self.fit([((), initial_fit(system, rows))], CAREFUL)
        elif source.state.shape[1] < rows.shape[0]:
            self.fit([((), replace(source, state=initial_fit(system, rows).state))], FINAL)
        else:
            self.fitted[frozenset()] = ScoredModel((), source, float(source.likelihood[0]))
        if not math.isfinite(self.source.log_odds):
            raise NoFitError(
                f"no states of a {system.name} come near this recording, so that nothing can be computed of it; "
                "readings and parameters that a machine may have are right"
            )

    def run(self, progress: Progress | None = None) -> None:
        """Grow sets while that raises the posterior odds, then try sets near the best."""
        beam = [self.source]
        for size in range(MAX_EFFECTS):
            if progress is not None:
                progress(size, MAX_EFFECTS, -self.best.log_odds)
            before = self.best
            children = (size == 0 and self._alone()) or self.extend(beam)
            if not children:
                break
            beam = sorted(children, key=lambda f: -f.log_odds)[: self.profile.beam_width]
            if beam[0].log_odds < before.log_odds:
                break
        self._settle()
        if self.leftover([self.best])[0] > WIDEN_ABOVE:
            # Something is unexplained: perhaps two effects that only together beat single effects which fit fairly.
            for size in (1, 2):
                bases = [f for f in self.ranked if len(f.effects) == size and f.log_odds > -math.inf]
                self.extend(bases[:WIDEN_MODELS])
            self._settle()
        if progress is not None:
            progress(MAX_EFFECTS, MAX_EFFECTS, -self.best.log_odds)

    def promised(self) -> float:
        """Log likelihood that the best effect adds to the source, by the screening."""
        return max((one.gain for one in self._screening(self.source)), default=0.0)

    def _alone(self) -> list[ScoredModel]:
        """Every effect alone, where effects are so large that the screening, a linear response, may mislead."""
        leads = self._screening(self.source)
        if not leads or leads[0].gain < FIT_ALL_ABOVE:
            return []
        values = {one.effect: one.values for one in leads}
        order = [*values, *(e for e in self.catalogue if e not in values)]
        return self._in_turn([((e,), with_effect(self.source.fits, values.get(e, neutral(e)))) for e in order])

    def _in_turn(self, starts: Sequence[tuple[Effects, FitState]]) -> list[ScoredModel]:
        """Fit the first few sets, which promise most, then the others, which stop early where they fall far behind."""
        return self.fit(starts[:LEADERS], QUICK) + self.fit(starts[LEADERS:], QUICK)

    def _settle(self) -> None:
        """Exchange, remove and fit carefully until the best set stays the best."""
        for _ in range(3):
            before = self.best
            self.neighbours(before)
            self.polish()
            if self.best.names == before.names:
                return

    @property
    def source(self) -> ScoredModel:
        """The source, that is, the empty set."""
        return self.fitted[frozenset()]

    @property
    def ranked(self) -> list[ScoredModel]:
        """All fitted sets, the most probable first."""
        return sorted(self.fitted.values(), key=lambda f: -f.log_odds)

    @property
    def best(self) -> ScoredModel:
        """The most probable set."""
        return self.ranked[0]

    def extend(self, bases: Sequence[ScoredModel], most: int = MAX_CANDIDATES) -> list[ScoredModel]:
        """Every base with one more effect, fitted unless it was, for the `most` best candidates of its screening."""
        leads = [(base, candidate) for base in bases for candidate in self.candidates(base)[:most]]
        promised = [float(base.fits.likelihood[0]) + candidate.gain for base, candidate in leads]
        known, starts = [], {}
        for k in sorted(range(len(leads)), key=lambda k: -promised[k]):
            base, candidate = leads[k]
            effects = (*base.effects, candidate.effect)
            key = _key(effects)
            if key in self.fitted:
                known.append(self.fitted[key])
            elif key not in starts:
                starts[key] = effects, with_effect(base.fits, candidate.values)
        far_behind = leads and max(promised) - min(promised) > OUT_OF_REACH
        every = list(starts.values())
        return known + (self._in_turn(every) if far_behind else self.fit(every, QUICK))

    def candidates(self, base: ScoredModel) -> list[Candidate]:
        """Effects whose screening promises enough to fit them in addition to a set, the largest gain first."""
        return self._promising(self._screening(base))

    def _screening(self, base: ScoredModel) -> list[Candidate]:
        """All other effects that raise the likelihood of a fitted set."""
        fits, screened = self._screened.get(base.names, (None, []))
        if fits is not base.fits:
            rest = [e for e in self.catalogue if e not in base.effects]
            screened = screen(self.system, base.effects, base.fits, self.rows, rest, self.jobs)
            self._screened[base.names] = base.fits, screened
        return screened

    def _promising(self, screened: Sequence[Candidate]) -> list[Candidate]:
        profile = self.profile
        relative = profile.min_gain_share * max((one.gain for one in screened), default=0.0)

        def required(one: Candidate) -> float:
            return max(relative, profile.min_gain + profile.min_gain_per_parameter * len(one.values))

        return [one for one in screened if one.gain >= required(one)]

    def neighbours(self, centre: ScoredModel) -> None:
        """Fit the sets with one effect removed, with one exchanged for another, and with two exchanged for one."""
        # Sets that were fitted before too: from the larger set's parameters a fit may reach what it did not alone.
        self.fit([_without(centre, [removed]) for removed in centre.effects], QUICK)
        exchanges = []
        for removed in (*combinations(centre.effects, 1), *combinations(centre.effects, 2)):
            # Along the states of the whole set what is removed shows as a disturbance, without a fit of what is left.
            kept, fits = _without(centre, removed)
            if (exchange := (_key(centre.effects), _key(kept))) in self._exchanged:
                continue
            self._exchanged.add(exchange)
            rest = [e for e in self.catalogue if e not in centre.effects]
            screened = screen(self.system, kept, fits, self.rows, rest, self.jobs)
            for candidate in self._promising(screened)[:MAX_EXCHANGES]:
                process, noise = centre.fits.log_process.clamp(min=EXCHANGE_LOG_PROCESS), centre.fits.log_noise
                start = replace(with_effect(fits, candidate.values), log_process=process, log_noise=noise)
                exchanges.append(((*kept, candidate.effect), start))
        self.fit(exchanges, QUICK)

    def polish(self) -> None:
        """Fit carefully the sets close to the best, and the best set less each effect, with which it is compared."""
        self.fit([(f.effects, f.fits) for f in self.close()], CAREFUL)

    def close(self) -> list[ScoredModel]:
        """The sets close to the best, and the best set less each effect, where these were fitted."""
        best = self.best
        fewer = [f.fits.theta.shape[1] < best.fits.theta.shape[1] for f in self.ranked]
        within = [POLISH_SIMPLER_WITHIN if simpler else POLISH_WITHIN for simpler in fewer]
        close = [f for f, most in zip(self.ranked, within, strict=True) if f.log_odds >= best.log_odds - most]
        close = close[:POLISH_MODELS]
        smaller = [self.fitted.get(frozenset(best.names) - {name}) for name in best.names]
        return close + [f for f in smaller if f is not None and all(f is not other for other in close)]

    def single(self, effect: type[Effect]) -> ScoredModel:
        """The set of one effect alone."""
        key = frozenset({effect.name})
        if key not in self.fitted:
            self.fit([((effect,), self._start(self.source, effect))], QUICK)
        return self.fitted[key]

    def without(self, whole: ScoredModel, removed: type[Effect]) -> ScoredModel:
        """A set less one of its effects."""
        start = _without(whole, [removed])
        return self.fitted.get(_key(start[0])) or self.fit([start], QUICK)[0]

    def exchange(self, whole: ScoredModel, removed: type[Effect], new: type[Effect]) -> ScoredModel:
        """A set with one of its effects exchanged for another."""
        base = self.without(whole, removed)
        return self.fit([((*base.effects, new), self._start(base, new))], CAREFUL)[0]

    def _start(self, base: ScoredModel, effect: type[Effect]) -> FitState:
        """A start for a set with one more effect, at the best values of its screening."""
        found = screen(self.system, base.effects, base.fits, self.rows, [effect])
        return with_effect(base.fits, found[0].values if found else neutral(effect))

    def leftover(self, sets: Sequence[ScoredModel]) -> list[float]:
        """Log likelihood that process noise adds to each set: a measure of what it leaves unexplained."""

        def of_share(indices: Sequence[int]) -> list[float]:
            models = [CandidateModel(self.system, sets[k].effects, self.rows) for k in indices]
            start = stacked([sets[k].fits for k in indices])
            without = fit(models, start, QUICK[0], process_noise=False).likelihood
            return without.tolist()

        without = shared_out(of_share, len(sets), self.jobs)
        return [max(0.0, float(f.fits.likelihood[0]) - other) for f, other in zip(sets, without, strict=True)]

    def fit(self, starts: Sequence[tuple[Effects, FitState]], effort: tuple[int, int]) -> list[ScoredModel]:
        """Fit sets of effects, each from a start, with effort QUICK or CAREFUL; return the best fit so far of each."""
        if not starts:
            return []
        iterations, accuracy = effort
        rival = max((float(each.fits.likelihood[0]) for each in self.fitted.values()), default=self._rival)

        def fitted_share(indices: Sequence[int]) -> list[FitState]:
            at_once = max(1, ROWS_AT_ONCE // self.rows.used[..., 0].numel())
            groups = [indices[first : first + at_once] for first in range(0, len(indices), at_once)]
            return [one for group in groups for one in fitted_together(group)]

        def fitted_together(indices: Sequence[int]) -> list[FitState]:
            models = [CandidateModel(self.system, starts[k][0], self.rows, accuracy) for k in indices]
            for model in models:
                model.slopes = self._slopes
            out = fit(models, stacked([starts[k][1] for k in indices]), iterations, rival=rival)
            if self._slopes is None:
                self._slopes = models[0].slopes
            return [single_fit(out, k, len(model.table)) for k, model in enumerate(models)]

        results = []
        for (effects, _), fits in zip(starts, shared_out(fitted_share, len(starts), self.jobs), strict=True):
            fitted = ScoredModel(effects, fits, log_posterior_odds(effects, fits, len(self.catalogue)))
            key = _key(effects)
            if key not in self.fitted or self.fitted[key].log_odds < fitted.log_odds:
                self.fitted[key] = fitted
            results.append(self.fitted[key])
        return results


def _key(effects: Effects) -> frozenset[str]:
    """A set of effects, whatever their order."""
    return frozenset(effect.name for effect in effects)


def _without(whole: ScoredModel, removed: Sequence[type[Effect]]) -> tuple[Effects, FitState]:
    """A set less some of its effects, and a start for its fit."""
    kept = [e not in removed for e in whole.effects for _ in e.table]
    base = whole.fits
    theta = base.theta[:, torch.tensor(kept, dtype=torch.bool)]
    # The removed effect then acts as a disturbance; a fit that starts with too little process noise would not find it.
    process = base.log_process.clamp(min=math.log(0.02**2))
    return tuple(e for e in whole.effects if e not in removed), replace(base, theta=theta, log_process=process)

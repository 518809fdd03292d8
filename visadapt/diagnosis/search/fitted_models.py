"""Sets of effects fitted to one recording: what is known of each, and how to fit and to screen more."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

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
from visadapt.estimation.fitting import fit
from visadapt.estimation.iterated_smoother import smoothed_states
from visadapt.estimation.likelihood import FitState, min_log_process
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.screening import Candidate, screen
from visadapt.estimation.segments import Segments
from visadapt.processes import shared_out
from visadapt.systems import System

ROWS_AT_ONCE = 100_000  # Rows times sets that are fitted together, so that memory is bounded

MIN_BETTER = 5.0  # Log likelihood by which a fit without process noise must be better to be kept

MIN_LEFTOVER = 5.0
"""Log likelihood that process noise must add to a set for something to count as unexplained, and the most that a set's
score is lowered for it where sets are compared."""


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

    def by_effect(self, values: Tensor) -> dict[type[Effect], Tensor]:
        """Values (P,) of the parameters of all effects, in their order, by effect."""
        counts = [len(effect.table) for effect in self.effects]
        return dict(zip(self.effects, values[: sum(counts)].split(counts), strict=True))


@dataclass(frozen=True)
class WithoutProcessNoise:
    """The fit of a set without process noise."""

    fits: FitState
    left: float  # log likelihood that process noise adds to the set: a measure of what it leaves unexplained


class FittedModels:
    """The sets of effects of a catalogue fitted so far to one recording, and how to fit more.

    Args:
        source: the fit of the source to these rows, if known; or to some of them, from which the fit then starts.
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
        self._careful: dict[frozenset[str], ScoredModel] = {}  # what the last careful fit of each set left
        self._explains: dict[tuple[str, ...], tuple[FitState, bool]] = {}
        self._slopes: tuple[Tensor, Tensor] | None = None
        self._screened: dict[tuple[str, ...], tuple[FitState, list[Candidate]]] = {}
        if source is None:
            self.fit([((), _from_readings(system, rows))], CAREFUL)
        elif source.state.shape[1] < rows.shape[0]:
            self.fit([((), replace(source, state=_from_readings(system, rows).state))], FINAL)
        else:
            self.fitted[frozenset()] = ScoredModel((), source, float(source.likelihood[0]))
        if not math.isfinite(self.source.log_odds):
            raise NoFitError(
                f"the likelihood of a {system.name} on this recording is not finite; check units, signs and the "
                "parameters of the rig (--params)"
            )

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

    def screening(self, base: ScoredModel) -> list[Candidate]:
        """All other effects that raise the likelihood of a fitted set."""
        fits, screened = self._screened.get(base.names, (None, []))
        if fits is not base.fits:
            rest = [e for e in self.catalogue if e not in base.effects]
            screened = screen(self.system, base.effects, base.fits, self.rows, rest, self.jobs)
            self._screened[base.names] = base.fits, screened
        return screened

    def single(self, effect: type[Effect]) -> ScoredModel:
        """The set of one effect alone."""
        key = key_of((effect,))
        if key not in self.fitted:
            self.fit([((effect,), self._start(self.source, effect))], QUICK)
        return self.fitted[key]

    def without(self, whole: ScoredModel, removed: type[Effect]) -> ScoredModel:
        """A set less one of its effects."""
        start = less(whole, [removed])
        return self.fitted.get(key_of(start[0])) or self.fit([start], QUICK)[0]

    def exchange(self, whole: ScoredModel, removed: type[Effect], new: type[Effect]) -> ScoredModel:
        """A set with one of its effects exchanged for another, fitted with and without process noise: noise left from
        the set without either would widen the intervals."""
        base = self.without(whole, removed)
        found = self.fit([((*base.effects, new), self._start(base, new))], CAREFUL)[0]
        self._quiet([found])
        return self.fitted[key_of(found.effects)]

    def _start(self, base: ScoredModel, effect: type[Effect]) -> FitState:
        """A start for a set with one more effect, at the best values of its screening."""
        found = screen(self.system, base.effects, base.fits, self.rows, [effect])
        return with_effect(base.fits, found[0].values if found else neutral(effect))

    def without_process_noise(self, sets: Sequence[ScoredModel]) -> list[WithoutProcessNoise]:
        """Fit each set without process noise."""
        return [
            WithoutProcessNoise(fits, max(0.0, float(each.fits.likelihood - fits.likelihood)))
            for each, fits in zip(sets, self._quiet(sets), strict=True)
        ]

    def explains_all(self, found: ScoredModel) -> bool:
        """Whether process noise adds next to nothing to a fitted set."""
        known, explains = self._explains.get(found.names, (None, False))
        if known is not found.fits:
            needed = float(found.fits.likelihood[0]) - MIN_LEFTOVER
            explains = float(self._quiet([found], needed)[0].likelihood[0]) >= needed
            self._explains[found.names] = self.fitted[key_of(found.effects)].fits, explains
        return explains

    def _quiet(self, sets: Sequence[ScoredModel], rival: float = -math.inf) -> list[FitState]:
        """The fits of sets without process noise; those that cannot come near `rival` stop early.

        Where a set is likelier without, that fit replaces the other one, which has ended where process noise explains
        what other parameters would.
        """
        starts = [(each.effects, self._at_rest(each)) for each in sets]
        out = self._fits(starts, CAREFUL, rival, process_noise=False)
        for each, fits in zip(sets, out, strict=True):
            if fits.likelihood > each.fits.likelihood + MIN_BETTER:
                self._keep(each.effects, fits)
        return out

    def fit_at_rest(self, found: ScoredModel) -> None:
        """Fit a set with dry friction from states at which its joints come to rest, to which the usual fit may not have
        come; that fit is kept if it is clearly better."""
        if _rubs(found):
            self._quiet([found])

    def _at_rest(self, found: ScoredModel) -> FitState:
        """The fit of a set with dry friction with the states that are most probable without process noise; of another
        set, as it is."""
        if self.rows.colour is not None or not _rubs(found):
            return found.fits
        model = CandidateModel(self.system, found.effects, self.rows, CAREFUL[1])
        least = torch.full_like(found.fits.log_process, min_log_process(self.rows.period))
        state = smoothed_states(model, replace(found.fits, log_process=least))
        return replace(found.fits, state=state[None])

    def fit(
        self,
        starts: Sequence[tuple[Effects, FitState]],
        effort: tuple[int, int],
        process_noise: bool = True,
        to_the_end: bool = False,
    ) -> list[ScoredModel]:
        """Fit sets of effects, each from a start; return the best fit so far of each. `effort`: QUICK, CAREFUL, FINAL.

        Without process noise, a fit reaches parameters that explain all, if there are any, from afar. With it, a fit
        that cannot come near the likeliest set stops early, unless it is to go on `to_the_end`.
        """
        rival = max((float(each.fits.likelihood[0]) for each in self.fitted.values()), default=self._rival)
        stops = process_noise and not to_the_end
        out = self._fits(starts, effort, rival if stops else -math.inf, process_noise)
        return [self._keep(effects, fits) for (effects, _), fits in zip(starts, out, strict=True)]

    def _fits(
        self, starts: Sequence[tuple[Effects, FitState]], effort: tuple[int, int], rival: float, process_noise: bool
    ) -> list[FitState]:
        """The fits of sets of effects, each from a start."""
        iterations, accuracy = effort

        def fitted_share(indices: Sequence[int]) -> list[FitState]:
            at_once = max(1, ROWS_AT_ONCE // self.rows.used[..., 0].numel())
            groups = [indices[first : first + at_once] for first in range(0, len(indices), at_once)]
            return [one for group in groups for one in fitted_together(group)]

        def fitted_together(indices: Sequence[int]) -> list[FitState]:
            models = [CandidateModel(self.system, starts[k][0], self.rows, accuracy) for k in indices]
            for model in models:
                model.slopes = self._slopes
            out = fit(models, stacked([starts[k][1] for k in indices]), iterations, process_noise, rival)
            if self._slopes is None:
                self._slopes = models[0].slopes
            return [single_fit(out, k, len(model.table)) for k, model in enumerate(models)]

        return shared_out(fitted_share, len(starts), self.jobs) if starts else []

    def _keep(self, effects: Effects, fits: FitState) -> ScoredModel:
        """The best fit so far of a set, this one among them."""
        fitted = ScoredModel(effects, fits, log_posterior_odds(effects, fits, len(self.catalogue)))
        key = key_of(effects)
        if key not in self.fitted or _is_better(fitted, self.fitted[key]):
            self.fitted[key] = fitted
        return self.fitted[key]


def _from_readings(system: System, rows: Segments) -> FitState:
    """The start of the source's fit. With coloured noise, its states are smoothed: the steps of a fit, which lead to
    the states that are most probable under white noise, are rejected where the coloured readings are likelier."""
    start = initial_fit(system, rows)
    if rows.colour is None:
        return start
    noise = {"log_process": rows.colour.log_process[None], "log_noise": rows.colour.log_noise[None]}
    state = smoothed_states(CandidateModel(system, (), rows), replace(start, **noise))
    return replace(start, state=state[None])


def _rubs(found: ScoredModel) -> bool:
    """Whether a set brings dry friction."""
    return any(effect.rubs() for effect in found.effects)


def _is_better(one: ScoredModel, other: ScoredModel) -> bool:
    """Whether a fit is better than another one of the same set."""
    if not (math.isfinite(one.fits.likelihood[0]) and math.isfinite(other.fits.likelihood[0])):
        return math.isfinite(one.fits.likelihood[0])
    if math.inf in (-one.log_odds, -other.log_odds):
        # A likelier fit about which the recording is uninformative shows that the other one has stopped short of it.
        gain = float(one.fits.likelihood[0] - other.fits.likelihood[0])
        return gain > (MIN_BETTER if one.log_odds == -math.inf else -MIN_BETTER)
    return one.log_odds > other.log_odds


def key_of(effects: Effects) -> frozenset[str]:
    """A set of effects, whatever their order."""
    return frozenset(effect.name for effect in effects)


def less(whole: ScoredModel, removed: Sequence[type[Effect]]) -> tuple[Effects, FitState]:
    """A set less some of its effects, and a start for its fit."""
    kept = [e not in removed for e in whole.effects for _ in e.table]
    base = whole.fits
    theta = base.theta[:, torch.tensor(kept, dtype=torch.bool)]
    # The removed effect then acts as a disturbance; a fit that starts with too little process noise would not find it.
    process = base.log_process.clamp(min=math.log(0.02**2))
    return tuple(e for e in whole.effects if e not in removed), replace(base, theta=theta, log_process=process)

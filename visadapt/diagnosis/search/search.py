"""The search over sets of effects: add, remove and exchange effects while that raises the posterior odds.

Sets grow from the source and from every effect alone. Those near the best are then tried: with one effect fewer and, if
they are small, with one exchanged, and with two exchanged for one, since two effects often imitate a third (a weaker
motor and a lighter pole, a heavier cart). Where a set explains all, so that process noise adds nothing to it, only sets
near it grow further. From SMALL_SET effects on, only the best set of a size grows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import replace
from itertools import combinations

from visadapt.diagnosis.search.fitted_models import MIN_BETTER, FittedModels, ScoredModel, key_of, less
from visadapt.effects import ActuationEffect, Effect
from visadapt.effects.actuation import follows_late
from visadapt.effects.late_sensors import LateSensors, MeasurementDelay
from visadapt.estimation.episode_phases import has_episode_phases, with_episode_phases
from visadapt.estimation.fit_states import CAREFUL, QUICK, Effects, neutral, with_effect
from visadapt.estimation.fitting import OUT_OF_REACH
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.screening import Candidate, screen
from visadapt.progress import Progress

MAX_EFFECTS = 6  # Effects in a set at most

MAX_CANDIDATES, MAX_EXCHANGES = 8, 3
"""Most effects that are tried with a set: when sets grow, and in the place of those that are exchanged."""

TIED, MAX_TIED = 1.0, 8
"""Log likelihood by which the screening of effects may differ that are tied with the first, and how many of these are
tried at most: where one of them is fitted, all are. Of a shaft that turns one way, dry friction, a bias of the motor
and a constant load do the same."""

SMALL_SET = 4
"""Effects at most in a set of which effects are exchanged, and from which on only the best set of a size grows. Larger
sets describe something that no effect explains: what a wider search finds there is another imitation of it, and would
take most of the time."""

MAX_ROUNDS = 3  # In which the best set is exchanged for one that has as many effects, or more

LEADERS = 4  # Sets that are fitted before the others, where some fall far behind

FIT_ALL_ABOVE = 100.0  # Log likelihood that the best effect promises, above which every effect is fitted alone

EXCHANGE_LOG_PROCESS = math.log(0.003**2)
"""Least log variance of the velocities' process noise, (m/s)^2 and (rad/s)^2, with which a fit starts after an
exchange: room for what the new effect does not yet explain, and little to shed where it explains all."""

LATE_SHARE, LATE_BASES = 0.3, 3
"""Late sensors are fitted even where the screening proposes none: added to the source, to the best set and to the
LATE_BASES best single effects, with a delay that starts at LATE_SHARE of the longest."""

POLISH_WITHIN, POLISH_SIMPLER_WITHIN = 8.0, 60.0
POLISH_MODELS = 8
"""Log posterior odds behind the best set up to which sets are fitted carefully, POLISH_MODELS at most. Sets with fewer
parameters than the best may be farther behind, since a quick fit of the right set may keep too much process noise."""

SETTLED_STEP = MAX_EFFECTS + 3
LAST_STEP = SETTLED_STEP + 3
"""Steps of progress after which the sets near the best are fitted, and after which all else is: where much stays
unexplained, either takes as long as three additions of an effect."""

Exchanges = set[frozenset[str]]
"""Sets, by the names of their effects, that were kept so far when others were exchanged."""


class Search(FittedModels):
    """How sets grow from the source, and which sets near the best are tried."""

    def run(self, progress: Progress | None = None) -> None:
        """Grow sets while that raises the posterior odds, then try sets near the best."""
        beam, exchanged = [self.source], Exchanges()
        for size in range(MAX_EFFECTS):
            self._report(progress, size, LAST_STEP)
            before = self.best
            children = self.extend(beam) if size else self.fit_singles()
            if not children:
                break
            ranked = sorted(children, key=lambda f: -f.log_odds)
            if ranked[0].log_odds < before.log_odds:
                break
            beam = self._worth_extending(ranked)
        self._report(progress, MAX_EFFECTS, LAST_STEP)
        self._settle(exchanged)
        if not self.explains_all(self.best):
            self._report(progress, SETTLED_STEP, LAST_STEP)
            self._grow_late(self.try_late_sensors())
            self._settle(exchanged)
            self._phases_of_episodes()
        self._report(progress, LAST_STEP, LAST_STEP)

    def fit_singles(self) -> list[ScoredModel]:
        """The fitted sets of one effect. If there are none yet, fit them: every effect, if effects are so large that
        the screening may mislead (FIT_ALL_ABOVE), else those whose screening promises enough."""
        return [f for f in self.ranked if len(f.effects) == 1] or self._alone() or self.extend([self.source])

    def go_on_from(
        self, starts: Sequence[tuple[Effects, FitState]], *, exchange: bool, progress: Progress | None = None
    ) -> None:
        """Fit sets that were found with other noise, and every promising effect alone; then grow the best of them and,
        with `exchange`, try sets near it, while that raises the posterior odds."""
        self.fit([each for each in starts if each[0]], QUICK)
        self.extend([self.source])
        exchanged, settled = Exchanges(), None
        for _ in range(MAX_EFFECTS):
            if self.best.names == settled:
                break
            self.grow_best(progress)
            settled = self.best.names
            if exchange:
                self._settle(exchanged)
            else:
                self._polish()
        self._report(progress, MAX_EFFECTS)

    def grow_best(self, progress: Progress | None = None) -> None:
        """Add effects to the best set while that raises the posterior odds."""
        self._grow(self.best, progress)

    def _grow(self, one: ScoredModel, progress: Progress | None = None) -> None:
        """Add effects to a set while that raises its posterior odds."""
        before = None
        while one is not before and len(one.effects) < MAX_EFFECTS:
            before = one
            self._report(progress, len(one.effects))
            children = self.extend([one])
            # Of the set itself, a better fit may have been found on the way.
            one = max((self.fitted[key_of(one.effects)], *children), key=lambda each: each.log_odds)

    def resume(self, found: ScoredModel) -> bool:
        """Fit a set that another search has found; return whether the best set is another one than before.

        If it is, sets near it are tried, unless process noise is jumps.
        """
        before = self.best
        self._fit_from_quiet([(found.effects, found.fits)], CAREFUL)
        if self.best.names == before.names:
            return False
        if not self.rows.jumps:
            self._settle(Exchanges())
        return True

    def _report(self, progress: Progress | None, step: int, last: int = MAX_EFFECTS) -> None:
        """Report a step, of which there are `last`, with the loss of the best set so far."""
        if progress is not None:
            progress(step, last, -self.best.log_odds)

    def promised(self) -> float:
        """Log likelihood that the best effect adds to the source, by the screening."""
        return max((one.gain for one in self.screening(self.source)), default=0.0)

    def _alone(self) -> list[ScoredModel]:
        """Every effect alone, where effects are so large that the screening, a linear response, may mislead."""
        leads = self.screening(self.source)
        if not leads or leads[0].gain < FIT_ALL_ABOVE:
            return []
        values = {one.effect: one.values for one in leads}
        order = [*values, *(e for e in self.catalogue if e not in values)]
        starts = [((e,), with_effect(self.source.fits, values.get(e, neutral(e)))) for e in order]
        first = len(_leading(leads, LEADERS))
        alone = self.fit(starts[:first], QUICK)
        if not self.explains_all(max(alone, key=lambda each: each.log_odds)):
            alone += self.fit(starts[first:], QUICK)
            # Process noise may stand for most of what a large effect does, at a value far from the right one: a delay
            # of 80 ms was fitted as one of 45, in steps of 50, and five more effects for the rest.
            best = sorted(alone, key=lambda each: -each.log_odds)[:LEADERS]
            self._fit_from_quiet([(each.effects, each.fits) for each in best], QUICK)
        return [self.fitted[key_of(each.effects)] for each in alone]

    def _worth_extending(self, ranked: Sequence[ScoredModel]) -> list[ScoredModel]:
        """The best of sets of one size, the most probable first, that may lead to a better one: not those that gain
        nothing by having more parameters than another and, where the best explains all, not those far behind."""
        beam = ranked[: self.profile.beam_width if len(ranked[0].effects) < SMALL_SET else 1]
        if self.explains_all(beam[0]):
            beam = [each for each in beam if each.log_odds > beam[0].log_odds - OUT_OF_REACH]
        return [each for each in beam if not any(_imitates(each, other) for other in beam)]

    def _fit_from_quiet(self, starts: Sequence[tuple[Effects, FitState]], effort: tuple[int, int]) -> list[ScoredModel]:
        """Fit sets without process noise and, from there, with it."""
        # Not from the best fit so far of each set, which may be likelier than the one without process noise; and with
        # the noise of the start: from almost none, a fit far from the right parameters rises slowly and is given up.
        quiet = self._fits(starts, effort, -math.inf, process_noise=False)
        again = [
            (effects, replace(found, log_process=start.log_process, log_noise=start.log_noise))
            for (effects, start), found in zip(starts, quiet, strict=True)
        ]
        return self.fit(again, effort)

    def try_late_sensors(self) -> list[ScoredModel]:
        """The source, the best set and the best single effects with each late sensor in addition, as fitted.

        The screening, which is linear in the delay, does not see a sensor that is far too late. It is made along states
        that were fitted to the late readings as if these were on time: there a small delay gains little, and a joint
        stops when its late readings do.
        """
        alone = [each for each in self.ranked if len(each.effects) == 1]
        bases = {each.names: each for each in (self.source, self.best, *alone[:LATE_BASES])}
        return self._fit_late([(base.effects, base.fits) for base in bases.values()])

    def fit_delays(self) -> list[ScoredModel]:
        """Each delay alone, which starts at half a period."""
        return self._fit_delays([effect for effect in self.catalogue if _is_delay(effect)], 0.5)

    def fit_late_commands(self) -> list[ScoredModel]:
        """The delay of all commands alone, or of all readings, which does the same, from nearly a period on; none, if
        it is not in the catalogue."""
        delays = [effect for effect in self.catalogue if _is_delay(effect)]
        readings = [effect for effect in delays if issubclass(effect, MeasurementDelay)]
        commands = [effect for effect in delays if issubclass(effect, ActuationEffect)]
        return self._fit_delays([*readings, *commands][:1], 0.9)

    def _fit_delays(self, delays: Sequence[type[Effect]], start: float) -> list[ScoredModel]:
        """Delays alone, which start at a share of a period."""
        return self.fit([((e,), with_effect(self.source.fits, [start * self.rows.period])) for e in delays], QUICK)

    def _grow_late(self, late: Sequence[ScoredModel]) -> None:
        """Add effects to a set with a late sensor that is the best of its size, while that raises the posterior odds.

        All sets so far grew from others, which may have more effects and be more probable: a lag, a delay far from the
        right one and three more effects, in the place of a delay and dry friction.
        """
        for one in late:
            if one is next(each for each in self.ranked if len(each.effects) == len(one.effects)):
                self._grow(one)

    def _fit_late(self, bases: Sequence[tuple[Effects, FitState]]) -> list[ScoredModel]:
        """Fit sets, each with its states, with each late sensor in addition."""
        late = [e for e in self.catalogue if issubclass(e, LateSensors)]
        starts = [
            ((*effects, e), with_effect(fits, [LATE_SHARE * e.table[0].high]))
            for effects, fits in bases
            for e in late
            if e not in effects
        ]
        return self._fit_from_quiet(starts, QUICK)

    def _settle(self, exchanged: Exchanges) -> None:
        """Exchange, remove and fit carefully until the best set stays the best, or has changed MAX_ROUNDS times without
        losing effects; no exchange is made again, and those that are made are added to `exchanged`."""
        rounds = 0
        while rounds < MAX_ROUNDS:
            before = self.best
            self._fit_neighbours(before, exchanged)
            self._polish()
            if self.best.names == before.names:
                return
            rounds += len(self.best.effects) >= len(before.effects)

    def _phases_of_episodes(self) -> None:
        """Where something is unexplained, try periodic effects with a phase for each episode; keep them if they win."""
        catalogue = tuple(with_episode_phases(effect, len(self.rows.command)) for effect in self.catalogue)
        if catalogue == self.catalogue or self.explains_all(self.best):
            return
        periodic = {effect.name for effect in catalogue if has_episode_phases(effect)}
        other = copy(self)
        other.catalogue, other._screened = catalogue, {}
        other.fitted = {names: each for names, each in self.fitted.items() if not names & periodic}
        other.extend(list({each.names: each for each in (other.source, other.best)}.values()))
        if any(has_episode_phases(effect) for effect in other.best.effects):
            other._settle(Exchanges())
        if other.best.log_odds > self.best.log_odds:
            self.fitted, self.catalogue, self._screened = other.fitted, other.catalogue, other._screened

    def extend(self, bases: Sequence[ScoredModel], most: int = MAX_CANDIDATES) -> list[ScoredModel]:
        """Every base with one more effect, fitted unless it was, for the `most` best candidates of its screening."""
        leads = [(base, candidate) for base in bases for candidate in self.candidates(base)[:most]]
        promised = [float(base.fits.likelihood[0]) + candidate.gain for base, candidate in leads]
        known, starts = [], {}
        for k in sorted(range(len(leads)), key=lambda k: -promised[k]):
            base, candidate = leads[k]
            effects = (*base.effects, candidate.effect)
            key = key_of(effects)
            if key in self.fitted:
                known.append(self.fitted[key])
            elif key not in starts:
                starts[key] = effects, with_effect(base.fits, candidate.values)
        far_behind = leads and max(promised) - min(promised) > OUT_OF_REACH
        every = list(starts.values())
        if not far_behind:
            return known + self.fit(every, QUICK)
        # First the few that promise most: the others then stop early where they fall far behind.
        return known + self.fit(every[:LEADERS], QUICK) + self.fit(every[LEADERS:], QUICK)

    def candidates(self, base: ScoredModel) -> list[Candidate]:
        """Effects whose screening promises enough to fit them in addition to a set, the largest gain first.

        To a set that explains all, they must add a little less than what one more effect costs in prior odds: the
        linear response then promises about what a fit gains.
        """
        least = math.log(max(1, len(self.catalogue))) if self.explains_all(base) else 0.0
        return self._promising(self.screening(base), least)

    def _promising(self, screened: Sequence[Candidate], least: float = 0.0) -> list[Candidate]:
        """The candidates that gain `least`, and what the system's profile asks for."""
        profile = self.profile
        relative = profile.min_gain_share * max((one.gain for one in screened), default=0.0)

        def required(one: Candidate) -> float:
            return max(relative, max(least, profile.min_gain) + profile.min_gain_per_parameter * len(one.values))

        return [one for one in screened if one.gain >= required(one)]

    def _fit_neighbours(self, centre: ScoredModel, exchanged: Exchanges) -> None:
        """Fit the sets with one effect removed and, of a set of at most SMALL_SET effects, with one exchanged for
        another, and with two exchanged for one, but for exchanges made before."""
        # Also sets that were fitted before: from the larger set's parameters a fit may reach a better optimum.
        self.fit([less(centre, [removed]) for removed in centre.effects], QUICK)
        exchanges, slow = [], []
        for removed in (*combinations(centre.effects, 1), *_pairs(centre.effects)):
            # Along the states of the whole set a removed effect shows as a disturbance, without a fit of the rest.
            kept, fits = less(centre, removed)
            if key_of(kept) in exchanged:
                continue
            exchanged.add(key_of(kept))
            if any(follows_late(effect, self.system) for effect in removed):
                slow.append((kept, fits))
            if len(centre.effects) > SMALL_SET:
                continue
            rest = [e for e in self.catalogue if e not in centre.effects]
            screened = screen(self.system, kept, fits, self.rows, rest, self.jobs)
            for candidate in _leading(self._promising(screened), MAX_EXCHANGES):
                process, noise = centre.fits.log_process.clamp(min=EXCHANGE_LOG_PROCESS), centre.fits.log_noise
                start = replace(with_effect(fits, candidate.values), log_process=process, log_noise=noise)
                exchanges.append(((*kept, candidate.effect), start))
        self.fit(exchanges, QUICK)
        # A lag and a few more effects imitate a delay, which the screening does not see (`try_late_sensors`).
        self._fit_late(slow)

    def exchange_in_rejected(self) -> None:
        """Where the set that fits best cannot be named, try the sets near it.

        Of an effect that does what a simpler one does, as Stribeck friction whose breakaway is its force at speed, the
        simpler one may be named.
        """
        finite = [f for f in self.fitted.values() if math.isfinite(f.fits.likelihood[0])]
        likeliest = max(finite, key=lambda f: float(f.fits.likelihood[0]))
        better = float(likeliest.fits.likelihood[0] - self.best.fits.likelihood[0]) > MIN_BETTER
        if better and likeliest.log_odds == -math.inf:
            self._fit_neighbours(likeliest, Exchanges())

    def _polish(self) -> None:
        """Fit carefully the sets close to the best, and the best set less each effect, with which it is compared, but
        for those whose best fit is a careful one already."""
        rough = [f for f in self.near_best() if self._careful.get(key_of(f.effects)) is not f]
        careful = self.fit([(f.effects, f.fits) for f in rough], CAREFUL)
        self._careful |= {key_of(f.effects): f for f in careful}

    def near_best(self) -> list[ScoredModel]:
        """The sets close to the best, and the best set less each effect, where these were fitted."""
        best = self.best
        fewer = [f.fits.theta.shape[1] < best.fits.theta.shape[1] for f in self.ranked]
        within = [POLISH_SIMPLER_WITHIN if simpler else POLISH_WITHIN for simpler in fewer]
        close = [f for f, most in zip(self.ranked, within, strict=True) if f.log_odds >= best.log_odds - most]
        close = close[:POLISH_MODELS]
        smaller = [self.fitted.get(frozenset(best.names) - {name}) for name in best.names]
        return close + [f for f in smaller if f is not None and all(f is not other for other in close)]


def _leading(screened: Sequence[Candidate], count: int) -> Sequence[Candidate]:
    """The first `count` candidates of a screening, and those tied with the first one."""
    tied = sum(one.gain > screened[0].gain - TIED for one in screened)
    return screened[: max(count, min(tied, MAX_TIED))]


def _imitates(one: ScoredModel, other: ScoredModel) -> bool:
    """Whether a set has more parameters than another, but fits no better, as friction that differs by direction does
    where it does not differ."""
    more = one.fits.theta.shape[1] - other.fits.theta.shape[1]
    return more > 0 and float(one.fits.likelihood[0] - other.fits.likelihood[0]) < more


def _pairs(effects: Effects) -> Iterable[tuple[type[Effect], ...]]:
    """The pairs of effects that are exchanged for one."""
    return combinations(effects, 2) if len(effects) <= SMALL_SET else ()


def _is_delay(effect: type[Effect]) -> bool:
    return [parameter.name for parameter in effect.table] == ["delay"]

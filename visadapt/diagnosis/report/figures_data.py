"""The figures behind a result: errors by horizon and state, and what the report draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from visadapt.diagnosis.result import Evidence, Gap, Growth, PolicyTerms, Prediction, Region
from visadapt.diagnosis.search import heldout
from visadapt.diagnosis.search.heldout import RolloutErrors
from visadapt.diagnosis.search.localisation import Disturbance, disturbance, profile, spectrum
from visadapt.diagnosis.search.model_comparison import ModelComparison
from visadapt.diagnosis.search.search import Search
from visadapt.estimation.candidate import CandidateModel
from visadapt.systems import System

SHOWN = 3
"""Held-out predictions that the report draws."""

PROFILES = 4
"""Variables over which it draws what is left."""


@dataclass(frozen=True)
class Errors:
    """Root mean square errors of held-out predictions by horizon and channel (H, m), in deviations of the noise."""

    before: Tensor
    after: Tensor
    floor: Tensor
    black_box: Tensor
    deviation: Tensor
    """(m,) of the noise"""

    @classmethod
    def of(cls, source: RolloutErrors, corrected: RolloutErrors, boxed: RolloutErrors, deviation: Tensor) -> Errors:
        """From predictions of the source, of the source with the causes, and of the source with a black box."""
        every = (source.rms(deviation), corrected.rms(deviation), corrected.floor(deviation), boxed.rms(deviation))
        return cls(*every, deviation)

    def closed_by(self, ahead: RolloutErrors) -> float:
        """Share of the gap that a set closes."""
        reached = heldout.overall(ahead.rms(self.deviation))[-1]
        return heldout.closed(_last(self.before), float(reached), _last(self.floor))

    def gap(self) -> Gap:
        """As the result states it."""
        before, after, floor, box = (_last(e) for e in (self.before, self.after, self.floor, self.black_box))
        measure = (
            f"root mean square error of predictions {heldout.AHEAD:g} s ahead on held-out episodes, "
            "in standard deviations of the measurement noise"
        )
        return Gap(measure, before, after, floor, box, heldout.closed(before, after, floor))

    def growth(self, period: float) -> Growth:
        """Over the horizon."""
        seconds = period * np.arange(1, len(self.before) + 1)
        every = (heldout.overall(e).numpy() for e in (self.before, self.after, self.floor, self.black_box))
        return Growth(seconds, *every)

    def by_state(self, system: System, channels: Sequence[int], explained: bool) -> dict[str, float]:
        """Share of the gap by state: of what the causes close, or else of what is there; NaN where unmeasured."""
        least = self.after if explained else self.floor
        excess = (self.before[-1].square() - least[-1].square()).clamp(min=0)
        whole = float(excess.sum())
        shares = {variable.name: math.nan for variable in system.states}
        for k, channel in enumerate(channels):
            shares[system.states[channel].name] = float(excess[k]) / whole if whole > 0 else 0.0
        return shares


def _last(errors: Tensor) -> float:
    return float(heldout.overall(errors)[-1])


def disturbances(search: Search, comparison: ModelComparison) -> tuple[Disturbance, Disturbance]:
    """What acts beside the source, and beside the best set, smoothed alike."""
    source, best = search.source, comparison.best
    # The same room for a disturbance in both, or the smoother one would look cleaner for that alone.
    room = source.fits.log_process.clamp(min=math.log(0.01**2))
    return (
        disturbance(CandidateModel(search.system, (), search.rows), source.fits, room),
        disturbance(CandidateModel(search.system, best.effects, search.rows), best.fits, room),
    )


def evidence(
    search: Search,
    source: RolloutErrors,
    corrected: RolloutErrors,
    errors: Errors,
    before: Disturbance,
    after: Disturbance,
    regions: Sequence[Region],
    policy: PolicyTerms | None,
) -> Evidence:
    """What the report draws."""
    units = {v.name: v.unit for v in (*search.system.states, *search.system.actions)} | {"time": "s"}
    drawn = [region.variable for region in regions] + list(search.profile.drawn)
    names = [name for name in dict.fromkeys(drawn) if name in units][:PROFILES]
    return Evidence(
        _predictions(search, source, corrected),
        tuple(profile(name, units[name], search.profile.residual, before, after) for name in names),
        errors.growth(search.rows.period),
        spectrum(search.profile.residual, before, after, search.rows.period),
        policy,
    )


def _predictions(search: Search, source: RolloutErrors, corrected: RolloutErrors) -> tuple[Prediction, ...]:
    """Stretches in which the source errs most, from windows of their own."""
    rows = search.rows
    horizon = source.predicted.shape[2] - 1
    wrong = source.error[-1].square().sum(-1) * source.there[-1].prod(-1)
    out = []
    for window in wrong.max(1).values.argsort(descending=True)[:SHOWN].tolist():
        end = int(wrong[window].argmax())
        start = end - horizon
        if start < 0 or float(wrong[window, end]) == 0:
            continue
        measured = np.full((horizon + 1, source.predicted.shape[-1]), np.nan)
        measured[:, list(rows.channels)] = rows.measured[window, start : end + 1].numpy()
        out.append(
            Prediction(
                int(rows.episode[window]),
                rows.time[window, start : end + 1].numpy(),
                measured,
                source.predicted[window, start].numpy(),
                corrected.predicted[window, start].numpy(),
            )
        )
    return tuple(out)

"""Causes that are read off repeated readings: rows that were lost, and an angle sensor that stands still in a zone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.diagnosis.result import Cause, Estimate
from visadapt.diagnosis.search import heldout
from visadapt.diagnosis.search.causes import NINETY
from visadapt.diagnosis.search.heldout import RolloutErrors
from visadapt.diagnosis.search.model_comparison import ModelComparison
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.search.sensor_checks import BAND, Readings
from visadapt.effects import Dropout, FrozenZone
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.repeated_readings import zone
from visadapt.evaluation.intervals import wilson

FEWEST = 2
"""Repeated readings from which on they are a cause."""

ROUGH = 1 / 3
"""Deviation of a smoothed angle, in deviations of a measured one."""


@dataclass(frozen=True)
class Held:
    """A cause, and the log likelihood that its readings would cost if they were taken for readings."""

    cause: Cause
    cost: float


def held_causes(readings: Readings, search: Search, comparison: ModelComparison) -> list[Held]:
    """What repeated readings show; sure, since noise never repeats."""
    out = []
    lost, rows = sum(int(x.sum()) for x in readings.holds.lost), sum(len(x) - 1 for x in readings.holds.lost)
    if lost >= FEWEST:
        parameters = {"rate": Estimate(lost / rows, Dropout.table[0].unit, wilson(lost, rows, NINETY))}
        out.append(
            Held(Cause(Dropout.name, parameters, 1.0, math.nan), _cost(readings, search, comparison, whole=True))
        )
    frozen = sum(int(x.sum()) for x in readings.holds.frozen)
    if frozen >= FEWEST and (readings.defect is not None or int(_marks(readings, whole=False).sum()) >= FEWEST):
        start, end, deviation = _zone(readings, search, comparison)
        unit = FrozenZone.table[0].unit
        parameters = {
            name: Estimate(edge, unit, (edge - NINETY * deviation, edge + NINETY * deviation))
            for name, edge in (("start", start), ("end", end))
        }
        cost = _cost(readings, search, comparison, whole=False)
        out.append(Held(Cause(FrozenZone.name, parameters, 1.0, math.nan), cost))
    return out


def unaware(readings: Readings, search: Search) -> RolloutErrors:
    """What the source predicts where held readings are taken as they were read."""
    blind = Search(search.system, readings.raw, ())
    return heldout.held_out(search.system, readings.raw, [((), blind.source.fits)])[0]


def _marks(readings: Readings, whole: bool) -> Tensor:
    """(W, T) where whole rows, or the angle alone, were held."""
    rows = readings.rows
    out = torch.zeros(rows.shape, dtype=torch.bool)
    marks = readings.holds.lost if whole else readings.holds.frozen
    for window, (episode, first) in enumerate(zip(rows.episode.tolist(), rows.first.tolist(), strict=True)):
        own = marks[episode][first : first + rows.shape[1]]
        out[window, : len(own)] = own
    return out & (rows.inside > 0)


def _cost(readings: Readings, search: Search, comparison: ModelComparison, whole: bool) -> float:
    best = comparison.best
    model = CandidateModel(search.system, best.effects, readings.raw)
    state = best.fits.state[0]
    measured = readings.raw.measured
    error = measured - model.measure(best.fits.theta[0], state.flatten(0, 1)).reshape(measured.shape)
    square = (error.square() / best.fits.log_noise[0].exp()).sum(-1)
    return float(0.5 * square[_marks(readings, whole)].sum())


def _zone(readings: Readings, search: Search, comparison: ModelComparison) -> tuple[float, float, float]:
    """Start, end and the deviation of either, of the angles at which the sensor stands still."""
    rows = readings.rows
    fits = comparison.best.fits
    inside = rows.inside > 0
    if readings.defect is not None:
        return *readings.defect, BAND
    channel = rows.channels.index(search.profile.held[0])
    deviation = ROUGH * float((fits.log_noise[0, channel] / 2).exp())
    angle = fits.state[0, ..., search.profile.held[0]][inside]
    return zone(_marks(readings, whole=False)[inside], torch.atan2(angle.sin(), angle.cos()), deviation)

"""Causes found from repeated readings: lost rows, and an angle sensor that stands still in a zone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from visadapt.confidence import wilson
from visadapt.diagnosis.result import Cause, Estimate
from visadapt.diagnosis.search import heldout
from visadapt.diagnosis.search.angle_defect import BAND
from visadapt.diagnosis.search.causes import Z_90
from visadapt.diagnosis.search.draft import PreparedRecording
from visadapt.diagnosis.search.heldout import RolloutErrors
from visadapt.diagnosis.search.model_comparison import ModelComparison
from visadapt.diagnosis.search.search import Search
from visadapt.effects import Dropout, Effect, FrozenZone
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.repeated_readings import SMOOTHING_RATIO, zone
from visadapt.estimation.segments import Segments

MIN_REPEATS = 2  # Repeated readings required for a cause


def repeated_reading_causes(
    recording: PreparedRecording, search: Search, comparison: ModelComparison, lost_rows: type[Effect] = Dropout
) -> list[tuple[Cause, float]]:
    """The causes of repeated readings; their probability is 1, since noise never repeats a reading.

    `lost_rows` is the effect that repeats whole rows. Each cause comes with the log likelihood that would be lost if
    the readings that it repeats were taken for measurements.
    """
    out = []
    repeats = recording.repeats
    lost, rows = sum(int(x.sum()) for x in repeats.lost), sum(int(x[1:].sum()) for x in repeats.seen)
    if lost >= MIN_REPEATS:
        parameters = {"rate": Estimate(lost / rows, lost_rows.table[0].unit, wilson(lost, rows, Z_90))}
        cost = _cost(recording, search, comparison, repeats.lost)
        out.append((Cause(lost_rows.name, parameters, 1.0, math.nan), cost))
    frozen = sum(int(x.sum()) for x in repeats.frozen)
    in_windows = int(_in_windows(recording.rows, repeats.frozen).sum())
    if frozen >= MIN_REPEATS and (recording.defect is not None or in_windows >= MIN_REPEATS):
        edges, deviations = _zone(recording, search, comparison)
        low, high = (edges - Z_90 * deviations).tolist(), (edges + Z_90 * deviations).tolist()
        parameters = {
            parameter.name: Estimate(edge, parameter.unit, (low[k], high[k]))
            for k, (parameter, edge) in enumerate(zip(FrozenZone.table, edges.tolist(), strict=True))
        }
        cost = _cost(recording, search, comparison, repeats.frozen)
        out.append((Cause(FrozenZone.name, parameters, 1.0, math.nan), cost))
    return out


def errors_with_repeats(recording: PreparedRecording, search: Search) -> RolloutErrors:
    """Prediction errors of the source fitted with repeated readings taken for measurements."""
    source = Search(search.system, recording.raw, ()).source
    return heldout.held_out(search.system, recording.raw, [((), source.fits)], lambda errors: errors)[0]


def _in_windows(rows: Segments, marks: Sequence[Tensor]) -> Tensor:
    """(W, T) the windows' rows of marks (T,) by episode."""
    out = torch.zeros(rows.shape, dtype=torch.bool)
    for window, (episode, first) in enumerate(zip(rows.episode.tolist(), rows.first.tolist(), strict=True)):
        marked = marks[episode][first : first + rows.shape[1]]
        out[window, : len(marked)] = marked
    return out & (rows.inside > 0)


def _cost(
    recording: PreparedRecording, search: Search, comparison: ModelComparison, repeated: Sequence[Tensor]
) -> float:
    """Half the squared errors, in noise variances, of the best model against the repeated readings."""
    best = comparison.best
    model = CandidateModel(search.system, best.effects, recording.raw)
    theta, state = best.fits.theta[0], best.fits.state[0]
    error = model.shown(theta)[0] - model.measure(theta, state)
    square = error.square() / best.fits.log_noise[0].exp()
    marked = _in_windows(recording.rows, repeated)[..., None].expand_as(square)
    return float(0.5 * (square * model.rows.later(marked.double(), model.rows_later(theta))).sum())


def _zone(recording: PreparedRecording, search: Search, comparison: ModelComparison) -> tuple[Tensor, Tensor]:
    """Start and end (2,) of the angles at which the sensor stands still, and their standard deviations."""
    rows = recording.rows
    fits = comparison.best.fits
    inside = (rows.inside > 0) & ~_in_windows(rows, recording.repeats.silent)
    if recording.defect is not None:
        edges = torch.tensor(recording.defect, dtype=torch.float64)
        return edges, torch.full_like(edges, BAND)
    channel = rows.channels.index(search.profile.angle_sensor[0])
    deviation = SMOOTHING_RATIO * float((fits.log_noise[0, channel] / 2).exp())
    angle = fits.state[0, ..., search.profile.angle_sensor[0]][inside]
    return zone(_in_windows(rows, recording.repeats.frozen)[inside], angle, deviation)

"""Defects of an angle sensor: a band of angles in which its readings contradict the physics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from visadapt.diagnosis.search.disturbance import disturbance
from visadapt.diagnosis.search.sign_conventions import SUSPICIOUS_LOG_PROCESS
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

BAND = 0.1
"""rad, width of the bands of angle that are tested."""

POWER_RATIO = 25.0
MIN_BAND_ROWS = 5
MAX_ROWS_SHARE = 0.15
"""A band is defective if the mean square of the disturbance torque in it exceeds POWER_RATIO times the median
over bands, on at least MIN_BAND_ROWS rows; all defective bands together hold at most MAX_ROWS_SHARE of the rows."""

FULL_TURN_SHARE = 0.8
"""Share of the circle's bands that the pole visits, above which it turns all the way round."""

MIN_STRETCH_ROWS = 15
"""Rows between two passes of a defective band for them to be used."""


@dataclass(frozen=True)
class Defect:
    """A band of angles in which the sensor is defective."""

    low: float
    """rad"""
    high: float
    """rad"""
    full_turns: bool
    """whether the pole turns all the way round"""


def find(system: System, rows: Segments, fits: FitState) -> Defect | None:
    """The band of angles where following the readings takes far greater torques than elsewhere, by the source's fit."""
    angle_sensor = profile_of(system).angle_sensor
    if not angle_sensor or float(fits.log_process[0, 1]) < SUSPICIOUS_LOG_PROCESS:
        return None
    found = disturbance(CandidateModel(system, (), rows), fits, fits.log_process)
    here = found.valid > 0
    theta = found.variables[system.states[angle_sensor[0]].name][here]
    band = ((torch.atan2(theta.sin(), theta.cos()) + math.pi) / BAND).long()
    power = found.load[..., 1][here].square()
    count = torch.zeros(int(2 * math.pi / BAND) + 1, dtype=power.dtype).index_add_(0, band, torch.ones_like(power))
    mean = torch.zeros_like(count).index_add_(0, band, power) / count.clamp(min=1)
    defective = (mean > POWER_RATIO * mean[count > 0].median()) & (count >= MIN_BAND_ROWS)
    if not bool(defective.any()) or float(count[defective].sum()) > MAX_ROWS_SHARE * float(count.sum()):
        return None
    bands = defective.nonzero()[:, 0]
    low, high = (BAND * float(edge) - math.pi for edge in (bands.min(), bands.max() + 1))
    return Defect(low, high, float((count > 0).double().mean()) > FULL_TURN_SHARE)


def between(theta: Tensor, low: float, high: float) -> Tensor:
    """Whether angles, wrapped to [-pi, pi], lie between two others."""
    wrapped = torch.atan2(theta.sin(), theta.cos())
    return (wrapped >= low) & (wrapped <= high)


def on_one_turn(measured: Tensor, angle: int, edge: float) -> Tensor:
    """Measurements (T, m) with the angle's column on the turn that starts or ends at `edge` and contains upright, 0."""
    start = edge if edge < 0 else edge - 2 * math.pi
    out = measured.clone()
    out[:, angle] = (measured[:, angle] - start).remainder(2 * math.pi) + start
    return out


def stretches_without(bad: Sequence[Tensor]) -> list[tuple[int, int, int]]:
    """Stretches of episodes without bad rows (T,): episode index, first row, row past the last."""
    out = []
    for index, rows in enumerate(bad):
        edges = [-1, *rows.nonzero()[:, 0].tolist(), len(rows)]
        out += [(index, a + 1, b) for a, b in pairwise(edges) if b - a - 1 >= MIN_STRETCH_ROWS]
    return out


def without(rows: Segments, angle_sensor: Sequence[int], low: float, high: float) -> Segments:
    """Rows in which the angle sensor's readings between two angles are not used."""
    bad = between(rows.measured[..., rows.channels.index(angle_sensor[0])], low, high)
    affected = torch.tensor([channel in angle_sensor for channel in rows.channels])
    return replace(rows, used=rows.used * ~(bad[..., None] & affected))

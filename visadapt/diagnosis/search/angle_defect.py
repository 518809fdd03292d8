"""An angle sensor that is defective in a band of angles, and the recording without its readings there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.diagnosis.search.disturbance import disturbance
from visadapt.diagnosis.search.sign_conventions import SUSPICIOUS_LOG_PROCESS
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

BANDS = 63  # bands of equal width that the circle is tested in
BAND = 2 * math.pi / BANDS  # rad, width of one

POWER_RATIO = 25.0
MIN_BAND_ROWS = 5
MAX_ROWS_SHARE = 0.15
"""A band is defective if the mean square of the disturbance torque in it exceeds POWER_RATIO times the median
over bands, on at least MIN_BAND_ROWS rows; the arc that holds all defective bands has at most MAX_ROWS_SHARE of the
rows."""

FULL_TURN_SHARE = 0.8  # Share of the circle's bands that the pole visits, above which it turns all the way round


def defective_band(system: System, rows: Segments, fits: FitState) -> tuple[tuple[float, float], bool] | None:
    """The band of angles where following the readings takes far greater torques than elsewhere, by the source's fit.

    Its edges in rad, and whether the pole turns all the way round; None where there is no such band. The lower edge
    lies in [-pi, pi], the upper one above it, so beyond pi where the band holds the hanging pole.
    """
    profile = profile_of(system)
    if not profile.angle_sensor:
        return None
    angle, rate = profile.angle_sensor
    driven = next(k for k, velocities in enumerate(profile.driven) if rate in velocities)
    if float(fits.log_process[0, driven]) < SUSPICIOUS_LOG_PROCESS:
        return None
    found = disturbance(CandidateModel(system, (), rows), fits, fits.log_process)
    here = found.valid > 0
    theta = found.variables[system.states[angle].name][here]
    band = ((theta + math.pi).remainder(2 * math.pi) / BAND).long().clamp(max=BANDS - 1)
    torque = found.load[..., system.coordinates.index((angle, rate))]
    power = torque[here].square()
    count = torch.zeros(BANDS, dtype=power.dtype).index_add_(0, band, torch.ones_like(power))
    mean = torch.zeros_like(count).index_add_(0, band, power) / count.clamp(min=1)
    defective = (mean > POWER_RATIO * mean[count > 0].median()) & (count >= MIN_BAND_ROWS)
    if not bool(defective.any()):
        return None
    first, last = shortest_arc(defective.nonzero()[:, 0].tolist(), BANDS)
    if float(count[torch.arange(first, last + 1) % BANDS].sum()) > MAX_ROWS_SHARE * float(count.sum()):
        return None
    edges = (BAND * first - math.pi, BAND * (last + 1) - math.pi)
    return edges, float((count > 0).double().mean()) > FULL_TURN_SHARE


def shortest_arc(members: Sequence[int], size: int) -> tuple[int, int]:
    """First and last place of the shortest run round a circle of `size` places that holds all `members`, in ascending
    order; the last is `size` or more where the run passes the end."""
    onward = [*members[1:], members[0] + size]
    k = max(range(len(members)), key=lambda k: onward[k] - members[k])
    first = onward[k] % size
    last = members[k]
    return first, last if last >= first else last + size


def between(theta: Tensor, low: float, high: float) -> Tensor:
    """Whether angles, whole turns apart or not, lie on the arc from `low` up to `high`, at most a turn above it."""
    return (theta - low).remainder(2 * math.pi) <= high - low


def on_one_turn(measured: Tensor, angle: int, edge: float) -> Tensor:
    """Measurements (T, m) with the angle's column on the turn that starts or ends at `edge` and contains upright, 0."""
    start = edge if edge < 0 else edge - 2 * math.pi
    out = measured.clone()
    out[:, angle] = (measured[:, angle] - start).remainder(2 * math.pi) + start
    return out


def without_angles(rows: Segments, angle_sensor: Sequence[int], low: float, high: float) -> Segments:
    """Rows in which the angle sensor's readings between two angles are not used."""
    bad = between(rows.measured[..., rows.channels.index(angle_sensor[0])], low, high)
    affected = torch.tensor([channel in angle_sensor for channel in rows.channels])
    return replace(rows, used=rows.used * ~(bad[..., None] & affected))

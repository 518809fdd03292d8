"""Sensors that are not as the source assumes: other signs, derived velocities, coarse steps, a defective angle."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from visadapt.diagnosis.search.disturbance import disturbance
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.words import listed
from visadapt.effects import Effect
from visadapt.estimation.candidate import CandidateModel
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

EFFECTS_WITH_SIGNS, MOST_EFFECTS_WITH_SIGNS, LEADS_WITH_SIGNS = 2, 6, 3
"""Before a sign convention is decided on, EFFECTS_WITH_SIGNS effects are added one by one to the source in both, the
source's convention and the best other one, since a large effect can look like a wrong sign. While the other one is
ahead, but not clearly, further effects are added, up to MOST_EFFECTS_WITH_SIGNS. LEADS_WITH_SIGNS effects are tried for
each one added."""


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
    other = others[alike[0]]
    if _ahead(other, as_given) <= required:
        return None
    # A sensor that is late by a period can look like a wrong sign, and the screening does not see it.
    for search in (as_given, other):
        search.try_late_sensors()
    for added in range(MOST_EFFECTS_WITH_SIGNS):
        if added >= EFFECTS_WITH_SIGNS and not 0 < _ahead(other, as_given) <= required:
            break
        for search in (as_given, other):
            search.extend([search.best], LEADS_WITH_SIGNS)
    if _ahead(other, as_given) <= required:
        return None
    return replace(every[alike[0]], name=listed([every[k].name for k in alike], "or"))


def _ahead(one: Search, other: Search) -> float:
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


MAX_LAG = 0.2
"""Largest lag, in periods, of a measured velocity behind the slope of its position; backward differences lag by 0.5."""

SURE = 2.0  # Standard errors by which a lag must exceed MAX_LAG: noise alone also gives lags in few readings


def derived_velocities(system: System, rows: Segments) -> dict[str, float]:
    """Names of velocities that lag behind the slope of their position, with the lag in s.

    Differences of past positions lag, and filtered ones do more. Readings alone decide, so that no model has to be
    right: the slope between the rows before and after a row does not lag.
    """
    position_of = profile_of(system).position_of
    span = rows.time[:, 2:] - rows.time[:, :-2]
    inside = rows.inside[:, 2:] * rows.inside[:, :-2]
    out = {}
    for k, channel in enumerate(rows.channels):
        if position_of.get(channel) not in rows.channels:
            continue
        position, velocity = rows.measured[..., rows.channels.index(position_of[channel])], rows.measured[..., k]
        acceleration = (velocity[:, 2:] - velocity[:, :-2]) / span
        error = velocity[:, 1:-1] - (position[:, 2:] - position[:, :-2]) / span
        used = inside * rows.used[..., k].unfold(1, 3, 1).amin(-1)
        # Least squares of error = -lag acceleration.
        information = (acceleration.square() * used).sum()
        lag = -(error * acceleration * used).sum() / information
        variance = ((error + lag * acceleration).square() * used).sum() / used.sum()
        if lag - SURE * (variance / information).sqrt() > MAX_LAG * rows.period:
            out[system.states[channel].name] = float(lag)
    return out


COARSE_SHARE = 0.1
"""Rounding error of a position, as a share of the standard deviation of its readings, above which its steps are coarse.
On simulated machines with 2,000 to 8,192 counts a turn it is at most 0.025."""


@dataclass(frozen=True)
class CoarseSteps:
    """A position that is read in steps which are coarse for its motion."""

    state: str  # name of the position
    unit: str
    step: float  # in `unit`
    deviation: float  # standard deviation of the readings, in `unit`

    def __str__(self) -> str:
        return (
            f"{self.state} is read in steps of {self.step:.3g} {self.unit} and varies by {self.deviation:.3g} "
            f"{self.unit} (standard deviation): what is smaller than a step does not show"
        )


def coarse_steps(system: System, rows: Segments) -> tuple[CoarseSteps, ...]:
    """The positions whose steps are coarse; velocities are left out, since those of an encoder count its steps."""
    velocities = profile_of(system).position_of
    out = []
    for k, (channel, step) in enumerate(zip(rows.channels, rows.resolution, strict=True)):
        readings = rows.measured[..., k][rows.used[..., k] > 0]
        deviation = float(readings.std())
        if channel not in velocities and step / math.sqrt(12) > COARSE_SHARE * deviation:
            variable = system.states[channel]
            out.append(CoarseSteps(variable.name, variable.unit, step, deviation))
    return tuple(out)


BANDS = 63  # bands of equal width that the circle is tested in
BAND = 2 * math.pi / BANDS  # rad, width of one

POWER_RATIO = 25.0
MIN_BAND_ROWS = 5
MAX_ROWS_SHARE = 0.15
"""A band is defective if the mean square of the disturbance torque in it exceeds POWER_RATIO times the median
over bands, on at least MIN_BAND_ROWS rows; the arc that holds all defective bands has at most MAX_ROWS_SHARE of the
rows."""

FULL_TURN_SHARE = 0.8  # Share of the circle's bands that the pole visits, above which it turns all the way round

MIN_STRETCH_ROWS = 15  # Rows between two passes of a defective band for them to be used


def angle_defect(system: System, rows: Segments, fits: FitState) -> tuple[tuple[float, float], bool] | None:
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


def stretches_without(bad: Sequence[Tensor]) -> list[tuple[int, int, int]]:
    """Stretches of episodes without bad rows (T,): episode index, first row, row past the last."""
    out = []
    for index, rows in enumerate(bad):
        edges = [-1, *rows.nonzero()[:, 0].tolist(), len(rows)]
        out += [(index, a + 1, b) for a, b in pairwise(edges) if b - a - 1 >= MIN_STRETCH_ROWS]
    return out


def without_angles(rows: Segments, angle_sensor: Sequence[int], low: float, high: float) -> Segments:
    """Rows in which the angle sensor's readings between two angles are not used."""
    bad = between(rows.measured[..., rows.channels.index(angle_sensor[0])], low, high)
    affected = torch.tensor([channel in angle_sensor for channel in rows.channels])
    return replace(rows, used=rows.used * ~(bad[..., None] & affected))

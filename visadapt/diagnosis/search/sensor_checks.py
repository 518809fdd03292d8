"""A recording made ready to be fitted: what is no reading of its own set aside, and not more rows than need be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from visadapt.diagnosis.search.localisation import disturbance
from visadapt.diagnosis.search.search import Search
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import Convention, profile_of
from visadapt.estimation.repeated_readings import Holds, find_holds
from visadapt.estimation.segments import Segments, cut
from visadapt.recordings import Recording
from visadapt.systems import System

WRONG = math.log(0.02**2)
"""Log variance of a change of velocity in a period, from which on it is asked whether a sign is wrong."""

FAR_LIKELIER = 0.1
"""Log likelihood per reading that another sign must bring to be taken for the right one."""

BAND = 0.1
"""rad, the width of the bands of angle in which defects of the sensor are looked for."""

LOUDER = 25.0
FEWEST = 5
PART = 0.15
"""A band is defective where the torque's power is so many times its median, on so many rows, a part of all at most."""

ROUND = 0.8
"""Share of the circle in which a pole is met that turns all the way round."""

SHORTEST = 15
"""Rows between two passes of a defective band that are worth a window."""

LATE = 0.2
"""Share of a period by which a velocity may lag the slope of its position and still be a measurement of its own."""


@dataclass(frozen=True)
class Readings:
    """What is fitted."""

    rows: Segments
    """held readings are not used"""
    raw: Segments
    """the same windows with held readings as they were read"""
    holds: Holds
    defect: tuple[float, float] | None
    """rad, between which the angle sensor is defective, in the source's convention"""
    warnings: tuple[str, ...]
    source: FitState | None = None
    """the fit of the source to `rows`, where it was needed on the way"""

    @classmethod
    def of(cls, recording: Recording, system: System) -> Readings:
        """From a recording of the states, or some of them, and the commands of a system."""
        profile = profile_of(system)
        channels = tuple(system.index(name) for name in recording.measured)
        measured = [torch.tensor(np.asarray(e.state, dtype=np.float64)) for e in recording.episodes]
        attitude = [k for k, channel in enumerate(channels) if channel in profile.attitude]
        measured = [_one_sign(values, attitude) for values in measured]
        commands = [torch.tensor(np.asarray(e.action, dtype=np.float64)) for e in recording.episodes]
        holds = find_holds(measured, channels, profile.held)
        warnings: list[str] = []

        def windows(stretches: list[tuple[int, int, int]] | None, notes: list[str]) -> tuple[Segments, Segments]:
            every = [torch.ones_like(m) for m in measured]
            rows = cut(measured, holds.used, commands, channels, recording.period, profile.window, stretches)
            raw = cut(measured, every, commands, channels, recording.period, profile.window, stretches)
            count, length = rows.shape
            most = max(4, int(profile.rows / float(rows.inside.sum(1).mean())))
            if count > most:
                chosen = torch.linspace(0, count - 1, most).round().long()
                rows, raw = rows.of(chosen), raw.of(chosen)
                notes.append(
                    f"of {count} windows of up to {length} rows, {most}, spread evenly over the recording, were used"
                )
            return rows, raw

        thinned: list[str] = []
        rows, raw = windows(None, thinned)
        if not profile.doubted:
            return cls(rows, raw, holds, None, tuple(thinned))
        every, source = rows, Search(system, rows, ()).source.fits
        defect = _contradicted(system, rows, source)
        band = None
        if defect is not None:
            low, high, beyond = defect
            band = (low, high)
            angle = channels.index(profile.held[0])
            bad = [_within(m[:, angle], low, high) for m in measured]
            if beyond:
                # A gap in a potentiometer's turn: of unknown width, so nothing is carried across it, and the turn
                # runs from one of its edges to the other, so that a scale acts alike on either side of upright.
                measured = [_on_one_turn(m, angle, 0.5 * (low + high)) for m in measured]
                thinned = []
                rows, raw = windows(_apart(bad), thinned)
            else:
                rows = _without(rows, profile.held, low, high)
            warnings.append(
                f"{sum(int(b.sum()) for b in bad)} readings of theta between {low:.2f} and {high:.2f} rad contradict "
                "those around them and the physics: the sensor is defective there; they were set aside"
            )
        warnings += thinned
        derived = _derived(system, rows)
        kept = [k for k, channel in enumerate(channels) if system.states[channel].name not in derived]
        warnings += [
            f"{name} is {late:.3g} s late against the slope of its position: derived on the rig, not measured; left out"
            for name, late in derived.items()
        ]
        if derived:
            rows, raw = rows.reading(kept), raw.reading(kept)
        # Velocities that lag would speak for the wrong sign.
        fitted = source if rows is every else None
        turned = _turned(system, rows, source, fitted)
        if turned is not None:
            rows, raw = (_turn(each, turned, profile.held) for each in (rows, raw))
            if band is not None and turned.states < 0:
                band = (-band[1], -band[0])
            warnings.append(f"{turned.what} has the other sign than the source's: it was turned round")
        return cls(rows, raw, holds, band, tuple(warnings), fitted if turned is None else None)


def _contradicted(system: System, rows: Segments, fits: FitState) -> tuple[float, float, bool] | None:
    """Angles, a small part of all, at which it would take far greater torques than elsewhere to follow the readings.

    And whether the pole turns all the way round.
    """
    worn = profile_of(system).held
    if not worn or float(fits.log_process[0, 1]) < WRONG:
        return None
    found = disturbance(CandidateModel(system, (), rows), fits, fits.log_process)
    here = found.there > 0
    theta = found.variables[system.states[worn[0]].name][here]
    place = ((torch.atan2(theta.sin(), theta.cos()) + math.pi) / BAND).long()
    power = found.load[..., 1][here].square()
    count = torch.zeros(int(2 * math.pi / BAND) + 1, dtype=power.dtype).index_add_(0, place, torch.ones_like(power))
    mean = torch.zeros_like(count).index_add_(0, place, power) / count.clamp(min=1)
    loud = (mean > LOUDER * mean[count > 0].median()) & (count >= FEWEST)
    if not bool(loud.any()) or float(count[loud].sum()) > PART * float(count.sum()):
        return None
    bands = loud.nonzero()[:, 0]
    low, high = (BAND * (float(k) + extra) - math.pi for k, extra in ((bands.min(), 0), (bands.max(), 1)))
    return low, high, float((count > 0).double().mean()) > ROUND


def _one_sign(measured: Tensor, attitude: Sequence[int]) -> Tensor:
    """An episode (T, m) whose quaternion does not jump to the other one of the same attitude."""
    if not attitude:
        return measured
    quaternion = measured[:, attitude]
    turned = (quaternion[1:] * quaternion[:-1]).sum(1) < 0
    out = measured.clone()
    out[1:, attitude] *= torch.where(turned, -1.0, 1.0).to(measured).cumprod(0)[:, None]
    return out


def _within(theta: Tensor, low: float, high: float) -> Tensor:
    """Whether angles, of any turn, lie between two of the first."""
    wrapped = torch.atan2(theta.sin(), theta.cos())
    return (wrapped >= low) & (wrapped <= high)


def _on_one_turn(measured: Tensor, angle: int, edge: float) -> Tensor:
    """The angle on the turn that begins, or ends, at `edge` and in which upright is 0."""
    start = edge if edge < 0 else edge - 2 * math.pi
    out = measured.clone()
    out[:, angle] = (measured[:, angle] - start).remainder(2 * math.pi) + start
    return out


def _apart(bad: list[Tensor]) -> list[tuple[int, int, int]]:
    """Stretches without bad rows that are long enough: an episode's index, the first row, and the row past the last."""
    out = []
    for index, rows in enumerate(bad):
        edges = [-1, *rows.nonzero()[:, 0].tolist(), len(rows)]
        out += [(index, a + 1, b) for a, b in pairwise(edges) if b - a - 1 >= SHORTEST]
    return out


def _without(rows: Segments, worn: Sequence[int], low: float, high: float) -> Segments:
    """The worn sensor's readings at these angles not used."""
    bad = _within(rows.measured[..., rows.channels.index(worn[0])], low, high)
    own = torch.tensor([channel in worn for channel in rows.channels])
    return replace(rows, used=rows.used * ~(bad[..., None] & own))


def _turn(rows: Segments, other: Convention, columns: Sequence[int]) -> Segments:
    """Rows of another convention, which has other signs of these columns and of the command, in the source's."""
    sign = torch.tensor([other.states if channel in columns else 1.0 for channel in rows.channels], dtype=torch.float64)
    return replace(rows, measured=rows.measured * sign, command=rows.command * other.command)


def _turned(system: System, rows: Segments, source: FitState, fitted: FitState | None) -> Convention | None:
    """The convention that the recording is in, if it is not the source's: one in which it is far likelier."""
    profile = profile_of(system)
    if not profile.conventions or float(source.log_process.max()) < WRONG:
        return None
    own = fitted or Search(system, rows, ()).source.fits
    likelihoods = [
        float(Search(system, _turn(rows, other, profile.held), ()).source.fits.likelihood[0])
        for other in profile.conventions
    ]
    best = max(range(len(likelihoods)), key=likelihoods.__getitem__)
    gained = likelihoods[best] - float(own.likelihood[0])
    return profile.conventions[best] if gained > FAR_LIKELIER * float(rows.used.sum()) else None


def _derived(system: System, rows: Segments) -> dict[str, float]:
    """Velocities that lag their position by a good part of a period, and by how much: differences, or filtered ones."""
    slopes = profile_of(system).slopes
    positions = [k for k, channel in enumerate(rows.channels) if channel not in slopes]
    velocities = [k for k, channel in enumerate(rows.channels) if slopes.get(channel) in rows.channels]
    if not velocities:
        return {}
    state = Search(system, rows.reading(positions), ()).source.fits.state[0]
    both = rows.inside[:, 2:] * rows.inside[:, :-2]
    out = {}
    for k in velocities:
        true = state[..., rows.channels[k]]
        slope = (true[:, 2:] - true[:, :-2]) / (2 * rows.period)
        used = both * rows.used[:, 1:-1, k]
        late = float(
            -((rows.measured[:, 1:-1, k] - true[:, 1:-1]) * slope * used).sum() / (slope.square() * used).sum()
        )
        if late > LATE * rows.period:
            out[system.states[rows.channels[k]].name] = late
    return out

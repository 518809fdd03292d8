"""Recordings in another sign convention than the source's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.diagnosis.search.search import Search
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import Convention, profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

SUSPICIOUS_LOG_PROCESS = math.log(0.02**2)
"""Log variance of the velocities' process noise, (m/s)^2 and (rad/s)^2, above which the source fits so badly that signs
and sensors are checked."""

MIN_GAIN_PER_READING = 0.1
"""Log likelihood per reading that another convention must gain to be taken for that of the recording."""


def continuous_quaternion(measured: Tensor, quaternion: Sequence[int]) -> Tensor:
    """An episode (T, m) whose quaternion, in these columns, does not jump to the opposite sign."""
    if not quaternion:
        return measured
    values = measured[:, quaternion]
    jumps = (values[1:] * values[:-1]).sum(1) < 0
    out = measured.clone()
    out[1:, quaternion] *= torch.where(jumps, -1.0, 1.0).to(measured).cumprod(0)[:, None]
    return out


def find(system: System, rows: Segments, source: FitState, fitted: FitState | None) -> Convention | None:
    """The convention in which the recording is far likelier than in the source's, if there is one.

    Args:
        system: the source.
        rows: the recording.
        source: a fit of the source to the recording before bad readings were excluded.
        fitted: its fit to `rows`, if known.
    """
    profile = profile_of(system)
    if not profile.sign_conventions or float(source.log_process.max()) < SUSPICIOUS_LOG_PROCESS:
        return None
    fitted = fitted or Search(system, rows, ()).source.fits
    likelihoods = [
        float(Search(system, to_source(rows, other, profile.angle_sensor), ()).source.fits.likelihood[0])
        for other in profile.sign_conventions
    ]
    best = max(range(len(likelihoods)), key=likelihoods.__getitem__)
    gained = likelihoods[best] - float(fitted.likelihood[0])
    return profile.sign_conventions[best] if gained > MIN_GAIN_PER_READING * float(rows.used.sum()) else None


def to_source(rows: Segments, convention: Convention, angle_sensor: Sequence[int]) -> Segments:
    """Rows of another convention in that of the source."""
    signs = [convention.angle if channel in angle_sensor else 1.0 for channel in rows.channels]
    sign = torch.tensor(signs, dtype=torch.float64)
    return replace(rows, measured=rows.measured * sign, command=rows.command * convention.command)

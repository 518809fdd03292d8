"""Loads that pass over a vehicle in one episode, such as a gust.

The loads by which a smoother makes a fitted set follow the recording are averaged over a while. Where that mean is many
times its usual size, which is its median over the recording, something passes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from visadapt.diagnosis.result import Push
from visadapt.diagnosis.search.causes import Z_90
from visadapt.diagnosis.search.disturbance import Disturbance, disturbance
from visadapt.diagnosis.search.fitted_models import FittedModels, ScoredModel
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fit_states import FINAL
from visadapt.estimation.segments import Segments, joined
from visadapt.recordings.runs import runs
from visadapt.systems import Variable

WIDTH = 0.6  # Prediction times over which loads are averaged

MIN_RATIO = 12.0
"""Mean load over its median size from which something passes. In three flights of a quadrotor by another simulator, the
largest on which nothing did was 7.3."""

NORMAL = 1.4826  # Standard deviation of what is normally distributed over its median size

IMPULSE_ERROR = 0.05  # Deviation of an impulse, as a share of it: the smoother's load begins early and ends late

EDGE = 0.5  # Share of its peak at which what passes begins and ends: the mean rises over WIDTH, half of it before


@dataclass(frozen=True)
class _Track:
    """One load in one episode, at N instants a period apart, but for gaps."""

    episode: int
    time: NDArray[np.float64]  # (N,) s since the episode began, from which the load acts for a period
    load: NDArray[np.float64]  # (N,)
    mean: NDArray[np.float64]  # (N,) over WIDTH about each instant


def passing_loads(models: FittedModels, found: ScoredModel, fitted: Segments) -> tuple[Push, ...]:
    """What passes beyond a set of effects, in the order of time; `models` are fitted to all rows, the set to those that
    are `fitted`."""
    system, rows = models.system, models.rows
    fits = found.fits
    if fitted is not rows:
        # States and process noise of all rows; the effects are as they were found.
        start = replace(models.source.fits, theta=fits.theta)
        fits = replace(models.fit([(found.effects, start)], FINAL)[0].fits, theta=fits.theta)
    # At the ends of windows, which are episodes here, a load is underestimated.
    rows, state = joined(rows, fits.state[0])
    load = disturbance(CandidateModel(system, found.effects, rows), replace(fits, state=state[None]), fits.log_process)
    count = max(1, round(WIDTH * system.prediction_time / rows.period))
    pushes = [
        push
        for k, port in enumerate(system.loads)
        for push in _passing(_tracks(load, k, count), port, rows.period, count)
    ]
    return tuple(sorted(pushes, key=lambda push: (push.episode, push.start)))


def _tracks(found: Disturbance, number: int, count: int) -> list[_Track]:
    """A load in each episode, and its mean over `count` rows."""
    out, episodes = [], found.variables["episode"]
    for episode in episodes[:, 0].unique().tolist():
        here = (episodes == episode) & (found.valid > 0)
        time, load = found.variables["time"][here].numpy(), found.load[..., number][here].numpy()
        if len(load) >= count:
            out.append(_Track(int(episode), time, load, np.convolve(load, np.full(count, 1 / count), "same")))
    return out


def _passing(tracks: list[_Track], port: Variable, period: float, count: int) -> Iterator[Push]:
    """What passes on one load, whose means are over `count` rows."""
    usual = float(np.median(np.abs(np.concatenate([track.mean for track in tracks])))) if tracks else 0.0
    if usual == 0:
        return
    tries = sum(len(track.mean) for track in tracks)
    for track in tracks:
        size = np.abs(track.mean) / usual
        large = size > EDGE * size.max()
        for start, end in runs(large):
            peak = start + int(size[start:end].argmax())
            if not large[start] or size[peak] < MIN_RATIO:
                continue
            around = slice(max(0, start - count // 2), end + count // 2)
            impulse = period * float(track.load[around].sum())
            usual_impulse = np.median(np.abs(_impulses(tracks, end - start + 2 * (count // 2), period)))
            spread = Z_90 * math.hypot(NORMAL * float(usual_impulse), IMPULSE_ERROR * impulse)
            p_value = min(1.0, tries * math.erfc(size[peak] / NORMAL / math.sqrt(2)))
            yield Push(
                track.episode,
                port.name,
                float(track.time[start]),
                float(track.time[end - 1]) + period,
                float(track.mean[peak]),
                port.unit,
                impulse,
                (impulse - spread, impulse + spread),
                p_value,
            )


def _impulses(tracks: list[_Track], rows: int, period: float) -> NDArray[np.float64]:
    """Impulses of the load over as many rows, wherever these begin."""
    long = [track.load for track in tracks if len(track.load) >= rows]
    return period * np.concatenate([np.convolve(load, np.ones(rows), "valid") for load in long])

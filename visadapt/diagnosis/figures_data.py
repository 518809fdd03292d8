"""The data of the figures that the report plots."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from visadapt.diagnosis.frames import Film
from visadapt.diagnosis.measured_gap import MeasuredGap
from visadapt.diagnosis.prediction_errors import PredictionErrors
from visadapt.diagnosis.result import Chart, Curve, FigureData, FilmFrames, Prediction, Region
from visadapt.diagnosis.search import heldout
from visadapt.diagnosis.search.disturbance import Disturbance, binned, disturbance
from visadapt.diagnosis.search.heldout import RolloutErrors
from visadapt.diagnosis.search.model_comparison import ModelComparison
from visadapt.diagnosis.search.search import Search
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.segments import Segments

MAX_FRAMES = 100  # Of a film; 120 by 100 px with noise take 25 kB each in the page

MAX_PREDICTIONS, MAX_PROFILES = 3, 3
"""Figures of held-out predictions, and of the residual over a variable; more would hide the instructive ones."""

SOURCE, CORRECTED = "simulator", "with the causes"
"""Labels of curves."""


def disturbances(search: Search, comparison: ModelComparison) -> tuple[Disturbance, Disturbance]:
    """Disturbance estimates of the source, and of the best set."""
    source, best = search.source, comparison.best
    # The same process noise in both: less of it alone would make the second estimate smoother.
    log_process = source.fits.log_process.clamp(min=math.log(0.01**2))
    return (
        disturbance(CandidateModel(search.system, (), search.rows), source.fits, log_process),
        disturbance(CandidateModel(search.system, best.effects, search.rows), best.fits, log_process),
    )


def figure_data(
    search: Search, measured: MeasuredGap, before: Disturbance, after: Disturbance, regions: Sequence[Region]
) -> FigureData:
    """What the report plots; the disturbances are those of the source, and of the best set."""
    units = {v.name: v.unit for v in (*search.system.states, *search.system.actions)} | {"time": "s"}
    plotted = [region.variable for region in regions] + list(search.profile.plotted_variables)
    names = [name for name in dict.fromkeys(plotted) if name in units][:MAX_PROFILES]
    residual = search.profile.residual_name, search.system.loads[0].unit
    return FigureData(
        _predictions(search, measured.source, measured.corrected),
        tuple(_profile(name, units[name], residual, before, after) for name in names),
        _growth(measured.errors, search.rows.period),
        _spectrum(residual, before, after, search.rows.period),
        held_out=measured.errors.held_out,
    )


def _growth(errors: PredictionErrors, period: float) -> Chart:
    """The errors over the horizon, over all channels; `period` in s."""
    labelled = {SOURCE: errors.before, CORRECTED: errors.after, "black box": errors.black_box, "noise": errors.floor}
    curves = tuple(Curve(label, heldout.overall(error).numpy()) for label, error in labelled.items())
    return Chart("predicted ahead", "s", "error", "", period * np.arange(1, len(errors.before) + 1), curves)


def _predictions(search: Search, source: RolloutErrors, corrected: RolloutErrors) -> tuple[Prediction, ...]:
    """The prediction of largest error in each of the windows in which the source errs most."""
    rows = search.rows
    horizon = source.predicted.shape[2] - 1
    size = source.error[-1].square().sum(-1) * source.valid[-1].prod(-1)
    out = []
    for window in size.max(1).values.argsort(descending=True)[:MAX_PREDICTIONS].tolist():
        best = int(size[window].argmax())
        if float(size[window, best]) == 0:
            continue
        start = best * source.stride
        end = start + horizon
        channels = list(rows.channels)
        measured = np.full((horizon + 1, source.predicted.shape[-1]), np.nan)
        shown = rows.measured[window, start : end + 1].masked_fill(rows.used[window, start : end + 1] == 0, math.nan)
        measured[:, channels] = shown.numpy()
        out.append(
            Prediction(
                int(rows.episode[window]),
                rows.time[window, start : end + 1].numpy(),
                measured,
                source.expected(window, best, channels).numpy(),
                corrected.expected(window, best, channels).numpy(),
            )
        )
    return tuple(out)


def film_frames(film: Film, rows: Segments, corrected: RolloutErrors) -> FilmFrames | None:
    """The first frames for which there are predictions; None where there are fewer than two."""
    ahead = corrected.predicted.shape[2] - 1
    windows, starts = corrected.valid[-1].prod(-1).nonzero()[:MAX_FRAMES].T
    if len(windows) < 2:
        return None
    ends = starts * corrected.stride + ahead
    there = rows.measured[windows, ends] + corrected.error[-1, windows, starts]
    drawn = film.seen(*there.float().T)
    episode = rows.episode[windows]
    index = (rows.first[windows] + ends).tolist()
    return FilmFrames(
        np.stack([film.frames[one][row] for one, row in zip(episode.tolist(), index, strict=True)]),
        (255 * drawn).round().clamp(0, 255).to(torch.uint8).numpy(),
        rows.time[windows, ends].numpy(),
        episode.numpy(),
        ahead * rows.period,
        (255 * film.left.clamp_min(0).sqrt()).numpy(),
    )


def _profile(name: str, unit: str, residual: tuple[str, str], before: Disturbance, after: Disturbance) -> Chart:
    """The mean disturbance on the first load over one variable, without and with the causes.

    `residual` is what the load is called, and its unit.
    """
    here = before.valid.flatten() > 0
    values = before.variables[name].flatten()[here]
    edges, bins = binned(values)
    count = len(edges) - 1
    curves = []
    for label, found in ((SOURCE, before), (CORRECTED, after)):
        load = found.load[..., 0].flatten()[here]
        binned_load = [load[bins == k] for k in range(count)]
        mean = np.array([float(s.mean()) if len(s) else math.nan for s in binned_load])
        error = np.array([float(s.std() / math.sqrt(len(s))) if len(s) > 1 else math.nan for s in binned_load])
        curves.append(Curve(label, mean, error))
    centres = np.array([float(values[bins == k].mean()) if bool((bins == k).any()) else math.nan for k in range(count)])
    return Chart(name, unit, *residual, centres, tuple(curves))


def _spectrum(residual: tuple[str, str], before: Disturbance, after: Disturbance, period: float) -> Chart:
    """Power spectral density of the disturbance on the first load, averaged over windows (Welch 1967, one Hann window
    over the rows of each)."""
    curves = []
    for label, found in ((SOURCE, before), (CORRECTED, after)):
        load, rows = found.load[..., 0], found.valid > 0
        hann = torch.zeros_like(load)
        for window, own in zip(hann, rows, strict=True):
            window[own] = torch.hann_window(int(own.sum()), dtype=load.dtype)
        power = torch.fft.rfft(load * hann, dim=1).abs().square().sum(0)
        curves.append(Curve(label, (2 * period * power / hann.square().sum()).numpy()))
    frequency = np.fft.rfftfreq(before.load.shape[1], period)
    quantity, unit = residual
    squared = f"({unit})2" if " " in unit else f"{unit}2"
    return Chart("frequency", "Hz", quantity, f"{squared}/Hz", frequency, tuple(curves))

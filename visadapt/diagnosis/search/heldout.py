"""How far the gap shrinks: errors of predictions several steps ahead, on episodes that were held out.

Every set is fitted again without the episodes that it then predicts. A prediction starts from the state that the
fitted model's smoother estimates in the held-out episode, and runs the simulator on with the commands that were
given, without looking at a measurement (simulation error with estimated initial state; Ljung 1999, System
Identification, section 16.5). Errors are in standard deviations of the measurement noise; the floor is what the
smoothed states themselves leave of the same measurements: noise, where the model is right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.diagnosis.search import unexplained
from visadapt.estimation.candidate import COARSE, CandidateModel
from visadapt.estimation.fit_states import Effects, joined
from visadapt.estimation.kalman import backward, forward
from visadapt.estimation.likelihood import FitState, fit, linear_problem, variances
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

AHEAD = 0.5
"""s ahead: the horizon at which the gap is measured."""

REFIT = 5
"""Iterations of a fit that starts from the fit to all episodes."""

FAR = 1e3
"""A prediction that runs away stops here; it is wrong enough."""


@dataclass(frozen=True)
class RolloutErrors:
    """Predictions 0 to H rows ahead of every row, on held-out windows."""

    error: Tensor
    """(H + 1, W, T, m) prediction minus measurement, at the row where the prediction ends; 0 where there is none"""
    there: Tensor
    """(H + 1, W, T, m) 1 where a prediction and a measurement are"""
    predicted: Tensor
    """(W, T, H + 1, n) states from each row on"""

    def rms(self, deviation: Tensor) -> Tensor:
        """(H, m) root mean square errors from 1 row ahead on, in units of `deviation` (m,)."""
        count = self.there[1:].sum((1, 2)).clamp(min=1)
        return (self.error[1:].square().sum((1, 2)) / count).sqrt() / deviation

    def floor(self, deviation: Tensor) -> Tensor:
        """(H, m) what the estimated states themselves leave of the measurements where the predictions end."""
        count = self.there[1:].sum((1, 2)).clamp(min=1)
        return ((self.error[0].square() * self.there[1:]).sum((1, 2)) / count).sqrt() / deviation


def overall(errors: Tensor) -> Tensor:
    """(H,) root mean square over the channels of errors (H, m)."""
    return errors.square().mean(-1).sqrt()


def closed(before: float, after: float, floor: float) -> float:
    """(before - after) / (before - floor); NaN where there is no gap to close."""
    return (before - after) / (before - floor) if before > floor * 1.001 else math.nan


def folds(rows: Segments, most: int) -> Tensor:
    """(F, W) 1 for the windows that are held out; by episode where there are several."""
    units = rows.episode if int(rows.episode.max()) > 0 else torch.arange(rows.shape[0])
    count = min(most, int(units.max()) + 1)
    return torch.stack([(units % count == k).double() for k in range(count)])


def held_out(
    system: System, rows: Segments, sets: Sequence[tuple[Effects, FitState]], black_box: bool = False
) -> list[RolloutErrors]:
    """Each set, fitted without each fold and predicting it; with a black box beside it, if one is asked for."""
    out = folds(rows, profile_of(system).folds)
    count = len(out)
    models = [CandidateModel(system, effects, rows, COARSE) for effects, _ in sets for _ in range(count)]
    starts = joined([fits for _, fits in sets for _ in range(count)])
    counts = (1 - out).repeat(len(sets), 1) if count > 1 else torch.ones(len(sets), rows.shape[0], dtype=out.dtype)
    fitted = fit(models, starts, counts, REFIT)
    parts = []
    for k, model in enumerate(models):
        own = fitted.of(torch.tensor([k]))
        own = replace(own, theta=own.theta[:, : len(model.table)])
        extra = unexplained.black_box(model, own, counts[k]) if black_box else None
        parts.append(ahead(model, own, extra))
    return [_merged(parts[k * count : (k + 1) * count], out.argmax(0)) for k in range(len(sets))]


def ahead(model: CandidateModel, fits: FitState, extra: Tensor | None = None) -> RolloutErrors:
    """What one fitted set, with what a black box may add to its states (W, T - 1, n), predicts from every row."""
    rows = model.rows
    windows, length = rows.shape
    horizon = max(1, round(AHEAD / rows.period))
    extra = torch.zeros_like(fits.state[0, :, 1:]) if extra is None else extra
    problem = linear_problem([model], fits)
    problem = replace(problem.data(), drive=problem.drive[..., :1] + extra[..., None])
    smoothed, _ = backward(problem, forward(problem, *variances(model, fits.log_process, fits.log_noise)))
    predicted = _run_on(model, fits.theta[0], fits.state[0] + smoothed[..., 0], horizon, extra)
    shape = (horizon + 1, windows, length, len(rows.channels))
    error, there = torch.zeros(shape, dtype=torch.float64), torch.zeros(shape, dtype=torch.float64)
    for h in range(horizon + 1):
        ends = predicted[:, : length - h, h]
        read = model.measure(fits.theta[0], ends.flatten(0, 1))
        error[h, :, h:] = read.reshape(windows, length - h, -1) - rows.measured[:, h:]
        there[h, :, h:] = rows.used[:, h:]
    return RolloutErrors(error * there, there, predicted)


def _run_on(model: CandidateModel, theta: Tensor, state: Tensor, horizon: int, extra: Tensor) -> Tensor:
    """(W, T, horizon + 1, n) the simulator from every row on, under the commands that were given."""
    rows = model.rows
    windows, length = rows.shape
    # Beyond a window's end nothing is measured, so whatever stands there will do.
    beyond = torch.zeros(windows, horizon + 1, extra.shape[-1], dtype=extra.dtype)
    extra = torch.cat((extra, beyond), 1)
    commands = model.commands(theta[None])[0]
    commands = torch.cat((commands, commands[:, -1:].expand(-1, horizon, -1, -1)), 1)
    world = model.at(theta)
    out = [state]
    for h in range(horizon):
        time = (rows.time + h * rows.period).flatten()
        here = commands[:, h : h + length].flatten(0, 1)
        after = world.integrate(time, out[-1].flatten(0, 1), here).reshape(state.shape) + extra[:, h : h + length]
        out.append(after.nan_to_num(FAR, FAR, -FAR).clamp(-FAR, FAR))
    return torch.stack(out, 2)


def _merged(parts: Sequence[RolloutErrors], owner: Tensor) -> RolloutErrors:
    """Every window as predicted by the fit that did not see it; `owner` (W,) says which."""
    windows = torch.arange(len(owner))

    def pick(name: str, axis: int) -> Tensor:
        stacked = torch.stack([getattr(part, name).movedim(axis, 0) for part in parts])
        return stacked[owner, windows].movedim(0, axis)

    return RolloutErrors(pick("error", 1), pick("there", 1), pick("predicted", 0))

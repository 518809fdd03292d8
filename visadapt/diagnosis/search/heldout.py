"""How far a set of effects closes the gap: errors of predictions several steps ahead on held-out episodes.

Every set is fitted again without the episodes that it then predicts. A prediction starts from the state that the
fitted model's smoother estimates in the held-out episode, and simulates with the recorded commands, without using
measurements (simulation error with estimated initial state; Ljung 1999, System Identification, section 16.5). Errors
are in standard deviations of the measurement noise; the floor is the error of the smoothed states against the same
measurements, which is noise if the model is right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.diagnosis.search.black_box import BlackBox, fit_black_box, inputs
from visadapt.diagnosis.search.unexplained import loads_of
from visadapt.estimation.candidate import COARSE, CandidateModel
from visadapt.estimation.fit_states import Effects, single_fit, stacked
from visadapt.estimation.kalman import backward, forward
from visadapt.estimation.likelihood import FitState, fit, linear_problem, variances
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.processes import shared_out
from visadapt.systems import System

PREDICTION_TIME = 0.5  # s; the horizon at which the gap is measured

REFIT_ITERATIONS = 5  # Iterations of a fit without a fold, which starts from the fit to all episodes

STATE_LIMIT = 1e3
"""Bound on predicted states, in their units, so that an unstable prediction gives a large but finite error."""


@dataclass(frozen=True)
class RolloutErrors:
    """Errors of predictions 0 to H rows ahead from every row of W held-out windows of T rows."""

    error: Tensor
    """(H + 1, W, T, m) prediction minus measurement, at the row where the prediction ends; 0 where not `valid`"""
    valid: Tensor  # (H + 1, W, T, m) 1 where there are both a prediction and a measurement
    predicted: Tensor  # (W, T, H + 1, n) states predicted from each row

    def rms(self, deviation: Tensor) -> Tensor:
        """(H, m) root mean square errors 1 to H rows ahead, in units of `deviation` (m,)."""
        count = self.valid[1:].sum((1, 2)).clamp(min=1)
        return (self.error[1:].square().sum((1, 2)) / count).sqrt() / deviation

    def floor(self, deviation: Tensor) -> Tensor:
        """(H, m) root mean square errors of the estimated states at the rows where these predictions end."""
        count = self.valid[1:].sum((1, 2)).clamp(min=1)
        return ((self.error[0].square() * self.valid[1:]).sum((1, 2)) / count).sqrt() / deviation

    def by_stretch(self, deviation: Tensor) -> Tensor:
        """(S,) mean square errors H rows ahead in stretches of H rows, in units of `deviation` (m,)."""
        horizon = len(self.error) - 1
        parts = ((self.error[-1] / deviation).square().sum(-1), self.valid[-1].sum(-1))
        padding = -parts[0].shape[1] % horizon
        square, count = (pad(each, (0, padding)).unflatten(1, (-1, horizon)).sum(-1).flatten() for each in parts)
        return square[count > 0] / count[count > 0]


def overall(errors: Tensor) -> Tensor:
    """(H,) root mean square over the channels of errors (H, m)."""
    return errors.square().mean(-1).sqrt()


MIN_GAP = 1.02  # Error of the source over the noise floor, below which there is no gap to close


def closed(before: float, after: float, floor: float) -> float:
    """(before - after) / (before - floor); NaN where there is no gap to close."""
    return (before - after) / (before - floor) if before > floor * MIN_GAP else math.nan


CLEAR = 3.0  # Value of t from which one model counts as predicting better than another: p < 0.01 from 10 stretches


def predicts_better(other: RolloutErrors, one: RolloutErrors, deviation: Tensor) -> bool:
    """Whether `other` predicts the same rows better than `one` by more than chance.

    A paired t-test of the log errors at the longest horizon, in stretches of one horizon: those are nearly independent.
    """
    gain = (one.by_stretch(deviation) / other.by_stretch(deviation)).log()
    return float(gain.mean() / gain.std() * math.sqrt(len(gain))) > CLEAR


def folds(rows: Segments, most: int) -> Tensor:
    """(F, W) 1 for the windows that each of at most `most` folds holds out: whole episodes if there are several."""
    units = rows.episode if int(rows.episode.max()) > 0 else torch.arange(rows.shape[0])
    count = min(most, int(units.max()) + 1)
    return torch.stack([(units % count == k).double() for k in range(count)])


def held_out(
    system: System, rows: Segments, sets: Sequence[tuple[Effects, FitState]], black_box: bool = False, jobs: int = 1
) -> list[RolloutErrors]:
    """Cross-validated predictions of each set of effects, given its fit to all rows, perhaps with a black box added.

    `jobs` processes share the work.
    """
    out = folds(rows, profile_of(system).folds)
    count = len(out)
    used = 1 - out if count > 1 else torch.ones_like(out)

    def predicted(indices: Sequence[int]) -> list[RolloutErrors]:
        chosen = [(*sets[k // count], used[k % count]) for k in indices]
        models = [CandidateModel(system, effects, rows, COARSE) for effects, _, _ in chosen]
        windows = torch.stack([windows for *_, windows in chosen])
        fitted = fit(models, stacked([fits for _, fits, _ in chosen]), windows, REFIT_ITERATIONS)
        parts = []
        for k, model in enumerate(models):
            one = single_fit(fitted, k, len(model.table))
            parts.append(rollout_errors(model, one, fit_black_box(model, one, windows[k]) if black_box else None))
        return parts

    parts = shared_out(predicted, len(sets) * count, jobs)
    return [_merged(parts[k * count : (k + 1) * count], out.argmax(0)) for k in range(len(sets))]


def rollout_errors(model: CandidateModel, fits: FitState, black_box: BlackBox | None = None) -> RolloutErrors:
    """Errors of one fitted set from every row, perhaps with a black box, whose loads follow the predicted states."""
    rows = model.rows
    windows, length = rows.shape
    horizon = max(1, round(PREDICTION_TIME / rows.period))
    fits = fits if black_box is None else black_box.fits
    problem = linear_problem([model], fits).data()
    if black_box is not None:
        loads = black_box.loads(inputs(model, fits.state[0])[:, :-1, None]) * rows.inside[:, 1:, None, None]
        problem = replace(problem, drive=problem.drive + (loads_of(model, fits) * loads).sum(-1, keepdim=True))
    smoothed, _ = backward(forward(problem, *variances(model, fits.log_process, fits.log_noise)))
    predicted = _rollouts(model, fits.theta[0], fits.state[0] + smoothed[..., 0], horizon, black_box)
    shape = (horizon + 1, windows, length, len(rows.channels))
    error, valid = torch.zeros(shape, dtype=torch.float64), torch.zeros(shape, dtype=torch.float64)
    for h in range(horizon + 1):
        ends = predicted[:, : length - h, h]
        error[h, :, h:] = model.measure(fits.theta[0], ends, first=h) - rows.measured[:, h:]
        valid[h, :, h:] = rows.used[:, h:]
    return RolloutErrors(error * valid, valid, predicted)


def _rollouts(model: CandidateModel, theta: Tensor, state: Tensor, horizon: int, black_box: BlackBox | None) -> Tensor:
    """(W, T, horizon + 1, n) states simulated from every row with the recorded commands."""
    rows = model.rows
    length = rows.shape[1]

    # Padding: predictions that leave the window are not valid.
    def padded(values: Tensor) -> Tensor:
        return torch.cat((values, values[:, -1:].expand(-1, horizon, *values.shape[2:])), 1)

    commands, duration = padded(model.commands(theta[None])[0]), padded(rows.duration)
    commanded = padded(inputs(model, state)[..., state.shape[-1] : -1])
    world = model.at(theta)
    time, out = rows.time, [state]
    for h in range(horizon):
        now = slice(h, h + length)
        if black_box is not None:
            variables = torch.cat((out[-1], commanded[:, now], time[..., None]), -1)
            world = black_box.at(variables.flatten(0, 1))
        after = world.integrate(
            time.flatten(), out[-1].flatten(0, 1), commands[:, now].flatten(0, 1), duration[:, now].flatten()
        )
        time, after = time + duration[:, now], after.reshape(state.shape)
        out.append(after.nan_to_num(STATE_LIMIT, STATE_LIMIT, -STATE_LIMIT).clamp(-STATE_LIMIT, STATE_LIMIT))
    return torch.stack(out, 2)


def _merged(parts: Sequence[RolloutErrors], fold: Tensor) -> RolloutErrors:
    """Every window as predicted by the fit of the `fold` (W,) that holds it out."""
    windows = torch.arange(len(fold))

    def pick(name: str, axis: int) -> Tensor:
        every = torch.stack([getattr(part, name).movedim(axis, 0) for part in parts])
        return every[fold, windows].movedim(0, axis)

    return RolloutErrors(pick("error", 1), pick("valid", 1), pick("predicted", 0))

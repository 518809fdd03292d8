"""How far a set of effects closes the gap: errors of predictions several steps ahead on held-out episodes.

Every set is refitted, by one Gauss-Newton step, without the episodes that it then predicts. A prediction starts from
the state that the fitted model's smoother estimates in the held-out episode, and simulates with the recorded commands,
without using measurements (simulation error with estimated initial state; Ljung 1999, System Identification, section
16.5). A phase that is the held-out episode's own stays as it was fitted there. Errors are in standard deviations of the
measurement noise; the floor is the error of the smoothed states against the same measurements, which is noise if the
model is right.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.diagnosis.search.black_box import BlackBox, fit_black_box, inputs
from visadapt.diagnosis.search.unexplained import loads_of
from visadapt.estimation.candidate import COARSE, CandidateModel
from visadapt.estimation.fit_states import Effects
from visadapt.estimation.fitting import refitted
from visadapt.estimation.iterated_smoother import smoothed_states
from visadapt.estimation.kalman import Linear
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.processes import shared_out
from visadapt.systems import System

START_SPACING = 0.04
"""Share of the prediction time between the starts of predictions, where rows follow each other faster; they then hardly
differ."""

UNKNOWN = 0.2
"""Share of the prediction time from the first row of a window on in which no prediction starts: states there are
estimated without earlier readings, and where a joint sticks, later ones do not show its velocity."""

BLACK_BOX_ROWS = 1600  # Rows to which a black box is fitted: windows spread evenly over the recording

STATE_LIMIT = 1e3
"""Bound on predicted states, in their units, so that an unstable prediction gives a large but finite error; ten times
the largest value in a state's range where that is more."""


LEAST_FLOOR = 0.5  # Least noise floor, in standard deviations of the measurement noise


@dataclass(frozen=True)
class RolloutErrors:
    """Errors of predictions 0 to H rows ahead from S rows of each of W held-out windows of T rows."""

    error: Tensor  # (H + 1, W, S, m) prediction minus measurement; 0 where not `valid`
    valid: Tensor  # (H + 1, W, S, m) 1 where there are both a prediction and a measurement
    predicted: Tensor  # (W, S, H + 1, n) states predicted from each of these rows
    read: Tensor  # (H + 1, W, S, m) readings that these predictions expect
    left: Tensor  # (H + 1, W, S, m) errors of the states estimated at the rows where the predictions end
    stride: int  # rows from one start to the next

    def expected(self, window: int, start: int, channels: Sequence[int]) -> Tensor:
        """(H + 1, n) one prediction: in the measured `channels` the readings to be expected, in other columns the
        states themselves."""
        states = self.predicted[window, start].clone()
        states[:, channels] = self.read[:, window, start]
        return states

    def rms(self, deviation: Tensor) -> Tensor:
        """(H, m) root mean square errors 1 to H rows ahead, in units of `deviation` (m,)."""
        return self._rms(self.error) / deviation

    def floor(self, deviation: Tensor) -> Tensor:
        """(H, m) root mean square errors of the estimated states at the rows where these predictions end.

        At least LEAST_FLOOR: where readings have no noise, a fit assumes a least noise, and the states are far closer
        to the readings than that.
        """
        return (self._rms(self.left) / deviation).clamp(min=LEAST_FLOOR)

    def _rms(self, error: Tensor) -> Tensor:
        count = self.valid[1:].sum((1, 2)).clamp(min=1)
        return ((error[1:].square() * self.valid[1:]).sum((1, 2)) / count).sqrt()

    def by_stretch(self, deviation: Tensor) -> Tensor:
        """Mean square errors H rows ahead in stretches of H rows, in units of `deviation` (m,); NaN without any."""
        length = max(1, (len(self.error) - 1) // self.stride)
        parts = ((self.error[-1] / deviation).square().sum(-1), self.valid[-1].sum(-1))
        padding = -parts[0].shape[1] % length
        square, count = (pad(each, (0, padding)).unflatten(1, (-1, length)).sum(-1).flatten() for each in parts)
        return square / count


def overall(errors: Tensor) -> Tensor:
    """(H,) root mean square over the channels of errors (H, m)."""
    return errors.square().mean(-1).sqrt()


MIN_GAP = 1.02  # Ratio of prediction error to noise floor up to which predictions are as good as the noise allows


def closed(before: float, after: float, floor: float) -> float:
    """(before - after) / (before - floor); NaN where there is no gap to close."""
    return (before - after) / (before - floor) if before > floor * MIN_GAP else math.nan


CLEAR = (31.8, 6.96, 4.54, 3.75, 3.36, 3.14, 3.0)
"""Values of t from which one model counts as predicting better than another, p < 0.01, for 2, 3, ... 8 and more
stretches (quantiles of Student's t with one degree of freedom less)."""


def predicts_better(other: RolloutErrors, one: RolloutErrors, deviation: Tensor) -> bool:
    """Whether `other` predicts the same rows better than `one` by more than chance.

    A paired t-test of the log errors at the longest horizon, in stretches of one horizon: those are nearly independent.
    """
    gain = (one.by_stretch(deviation) / other.by_stretch(deviation)).log()
    gain = gain[~gain.isnan()]
    if len(gain) < 2:
        return False
    return float(gain.mean() / gain.std() * math.sqrt(len(gain))) > CLEAR[min(len(gain) - 2, len(CLEAR) - 1)]


def folds(rows: Segments, most: int) -> Tensor:
    """(F, W) 1 for the windows that each of at most `most` folds holds out: whole episodes if there are several."""
    episodes = rows.episode.unique(return_inverse=True)[1]
    units = episodes if int(episodes.max()) > 0 else torch.arange(rows.shape[0])
    count = min(most, int(units.max()) + 1)
    return torch.stack([(units % count == k).double() for k in range(count)])


Result = TypeVar("Result")


def held_out(
    system: System,
    rows: Segments,
    sets: Sequence[tuple[Effects, FitState]],
    of: Callable[[RolloutErrors], Result],
    jobs: int = 1,
) -> list[Result]:
    """What `of` makes of the cross-validated predictions of each set of effects, given its fit to all rows.

    `jobs` processes share the work.
    """
    every = range(_count(system, rows))

    def predicted(indices: Sequence[int]) -> list[Result]:
        return [of(_merged(_of_folds(system, rows, *sets[k], every))) for k in indices]

    return shared_out(predicted, len(sets), jobs)


def beside_black_box(system: System, rows: Segments, effects: Effects, fits: FitState, jobs: int = 1) -> RolloutErrors:
    """Cross-validated predictions of a set of effects with a black box, fitted for each fold to the other episodes."""

    def predicted(indices: Sequence[int]) -> list[tuple[Tensor, RolloutErrors]]:
        return _of_folds(system, rows, effects, fits, indices, black_box=True)

    return _merged(shared_out(predicted, _count(system, rows), jobs))


def _count(system: System, rows: Segments) -> int:
    return len(folds(rows, profile_of(system).folds))


def _of_folds(
    system: System, rows: Segments, effects: Effects, fits: FitState, indices: Sequence[int], black_box: bool = False
) -> list[tuple[Tensor, RolloutErrors]]:
    """The windows of some folds, and their predictions by a set that is refitted without them."""
    out = folds(rows, profile_of(system).folds)
    used = 1 - out if len(out) > 1 else torch.ones_like(out)
    model = CandidateModel(system, effects, rows, COARSE)
    without = refitted(model, fits, used)
    # Episodes may be shorter than the time of a prediction.
    horizon = max(1, min(round(system.prediction_time / rows.period), int(rows.inside.sum(1).max()) - 1))
    parts, stride = [], _stride(system, rows)
    for k in indices:
        box, refit = None, without[torch.tensor([k])]
        if black_box:
            others = used[k].nonzero()[:, 0]
            some = others[rows.select(others).spread(BLACK_BOX_ROWS)]
            with suppress(torch.linalg.LinAlgError):  # type: ignore[attr-defined]  # then nothing is predicted better than without it
                box = fit_black_box(model.on(some), refit.on(some))
        held = out[k].nonzero()[:, 0]
        parts.append((held, rollout_errors(model.on(held), refit.on(held), horizon, stride, box)))
    return parts


def _stride(system: System, rows: Segments) -> int:
    """Rows from one start of predictions to the next. They have no factor in common with the rows between a sensor's
    readings: else no prediction may end where it is read."""
    inside, read = rows.inside.sum(), rows.used.sum((0, 1)).clamp(min=1)
    apart = math.lcm(*(inside / read).round().int().tolist())
    fastest = max(1, int(START_SPACING * system.prediction_time / rows.period + 1e-9))
    return next(stride for stride in range(fastest, 0, -1) if math.gcd(stride, apart) == 1)


def rollout_errors(
    model: CandidateModel, fits: FitState, horizon: int, stride: int = 1, black_box: BlackBox | None = None
) -> RolloutErrors:
    """Errors of one fitted set up to `horizon` rows ahead of every `stride`-th, perhaps with a black box, whose loads
    follow the states."""
    rows = model.rows
    length = rows.shape[1]
    if black_box is not None:
        fits = replace(fits, log_process=black_box.fits.log_process)

    def with_black_box(model: CandidateModel, fits: FitState, problem: Linear) -> Linear:
        assert black_box is not None
        loads = black_box.loads(inputs(model, fits.state[0])[:, :-1, None]) * model.rows.inside[:, 1:, None, None]
        return replace(problem, drive=problem.drive + (loads_of(model, fits) * loads).sum(-1, keepdim=True))

    estimated = smoothed_states(model, fits, None if black_box is None else with_black_box)
    predicted = _rollouts(model, fits.theta[0], estimated, horizon, stride, black_box)

    measured, shown = model.shown(fits.theta[0])
    unknown = max(1, math.ceil(UNKNOWN * horizon / stride - 1e-9))
    later = (rows.inside.sum(1) - 1 - horizon).div(stride, rounding_mode="floor")  # starts after the first, by window
    left_out = torch.arange(unknown) < later[:, None]
    left = model.measure(fits.theta[0], estimated) - measured
    # Rows in which the predictions of each horizon end, read all at once: late sensors take a simulation to read.
    every_end = [torch.arange(h, length, stride) for h in range(horizon + 1)]
    sizes = [len(ends) for ends in every_end]
    found = torch.cat([predicted[:, :size, h] for h, size in enumerate(sizes)], 1)
    readings = model.measure(fits.theta[0], found, torch.cat(every_end)).split(sizes, 1)
    parts = []
    for ends, read in zip(every_end, readings, strict=True):
        used = shown[:, ends].clone()
        if used.shape[1]:
            used[:, :unknown][left_out[:, : used.shape[1]]] = 0
        every = (read - measured[:, ends]) * used, used, read, left[:, ends] * used
        # Predictions that would end beyond the window are not valid.
        parts.append([pad(x, (0, 0, 0, predicted.shape[1] - x.shape[1])) for x in every])
    error, valid, read, left = (torch.stack(each) for each in zip(*parts, strict=True))
    return RolloutErrors(error, valid, predicted, read, left, stride)


def _rollouts(
    model: CandidateModel, theta: Tensor, state: Tensor, horizon: int, stride: int, black_box: BlackBox | None
) -> Tensor:
    """(W, S, horizon + 1, n) states simulated from every `stride`-th row with the recorded commands."""
    rows = model.rows
    length = rows.shape[1]

    # Padding: predictions that leave the window are not valid.
    def padded(values: Tensor) -> Tensor:
        return torch.cat((values, values[:, -1:].expand(-1, horizon, *values.shape[2:])), 1)

    commands, duration = padded(model.commands(theta[None])[0]), padded(rows.duration)
    commanded = padded(inputs(model, state)[..., state.shape[-1] : -1])
    time, out = rows.time[:, ::stride], [state[:, ::stride]]
    values = model.by_row(theta, time.shape[1])
    world = model.at(values)
    if black_box is None:
        world, commands = model.stepping(values, commands)
    limit = torch.tensor([max(STATE_LIMIT, 10 * one.largest) for one in model.system.states], dtype=state.dtype)
    for h in range(horizon):
        now = slice(h, h + length, stride)
        if black_box is not None:
            variables = torch.cat((out[-1], commanded[:, now], time[..., None]), -1)
            world = black_box.at(variables.flatten(0, 1), values)
        after = world.integrate(
            time.flatten(), out[-1].flatten(0, 1), commands[:, now].flatten(0, 1), duration[:, now].flatten()
        )
        time, after = time + duration[:, now], after.reshape(out[-1].shape)
        out.append(torch.where(after.isnan(), limit, after).clamp(-limit, limit))
    return torch.stack(out, 2)


def _merged(parts: Sequence[tuple[Tensor, RolloutErrors]]) -> RolloutErrors:
    """The predictions of all windows, from those of the windows of each fold."""
    order = torch.cat([windows for windows, _ in parts]).argsort()

    def joined(name: str, axis: int) -> Tensor:
        return torch.cat([getattr(errors, name) for _, errors in parts], axis).index_select(axis, order)

    first = parts[0][1]
    return RolloutErrors(
        joined("error", 1),
        joined("valid", 1),
        joined("predicted", 0),
        joined("read", 1),
        joined("left", 1),
        first.stride,
    )

"""Maximum likelihood of many sets of effects at once, the states, the noise and the disturbances estimated with them.

    x_{t+1} = f(x_t, u_t; theta) + w_t,  w_t ~ N(0, Q)        y_t = h(x_t; theta) + v_t,  v_t ~ N(0, R)

One-step residuals mislead where states are noisy, so the states are unknowns too: Gauss-Newton on states and
parameters together, where the states are integrated out by a Kalman filter along their own estimate (a multiple
shooting in which every row starts a shot; Bock and Plitt 1984, and Kristensen, Madsen and Jorgensen 2004, Automatica
40(2), for the likelihood of innovations). Q and R follow by Fisher scoring on the same innovations. Where the effects
are right Q goes to nothing, and every row of an episode speaks on every parameter; where something is missing Q
grows to be as large as what is missing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from torch import Tensor

from visadapt.estimation.candidate import CandidateModel, linearise
from visadapt.estimation.kalman import Linear, backward, forward, log_likelihood
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

SMOOTH = 1e-6
"""Process noise of position and angle, m and rad: they follow from their velocities."""

QUIET = math.log(1e-4**2)
LOUD = math.log(3.0**2)
"""Bounds of the log variance of w in the velocities, (m/s)^2 and (rad/s)^2."""

ENOUGH = 0.02
"""Log likelihood that is not worth an iteration."""

TINY = 1e-12
"""Least variance of a measurement, in its unit squared."""

STUCK = 100.0
"""Damping from which on a step is too short to lead anywhere."""

LOG_STEP = 1e-3
GREATEST = 1.5
"""Finite difference, and greatest change in an iteration, of a log variance."""


@dataclass(frozen=True)
class FitState:
    """C sets of effects, fitted."""

    theta: Tensor
    """(C, K) parameters, 0 beyond what a set has"""
    state: Tensor
    """(C, W, T, n)"""
    log_process: Tensor
    """(C, G) log variances of w in the velocities, by group"""
    log_noise: Tensor
    """(C, m) log variances of the measurements"""
    likelihood: Tensor
    """(C,) log likelihood of the windows that count"""
    information: Tensor
    """(C, K, K) Fisher's"""

    def of(self, chosen: Tensor) -> FitState:
        """Only these."""
        return FitState(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})


def rough(rows: Segments, system: System) -> Tensor:
    """States (W, T, n) from the measurements alone: a velocity that was not measured is a difference."""
    out = torch.zeros(*rows.shape, len(system.states), dtype=torch.float64)
    for k, channel in enumerate(rows.channels):
        out[..., channel] = rows.measured[..., k]
    for channel, place in profile_of(system).slopes.items():
        if channel not in rows.channels:
            position = out[..., place]
            change = torch.zeros_like(position)
            change[:, 1:-1] = (position[:, 2:] - position[:, :-2]) / (2 * rows.period)
            change[:, 0] = (position[:, 1] - position[:, 0]) / rows.period
            out[..., channel] = change
    return out * rows.inside[..., None]


def linear_problem(models: Sequence[CandidateModel], fits: FitState) -> Linear:
    """The count, one after the other, along the states of `fits`."""
    rows = models[0].rows
    origin = rough(rows, models[0].system)[:, 0]
    used = rows.used[..., None]
    inside = rows.inside[:, 1:, None, None]
    windows, length, n = fits.state.shape[1:]
    columns = 1 + fits.theta.shape[1]
    identity = torch.eye(n, dtype=torch.float64)
    transition, sensing = [], []
    drive = torch.zeros(len(models), windows, length - 1, n, columns, dtype=torch.float64)
    reading = torch.zeros(len(models), windows, length, len(rows.channels), columns, dtype=torch.float64)
    start = torch.zeros(len(models), windows, n, columns, dtype=torch.float64)
    for c, model in enumerate(models):
        count = len(model.table)
        lin = linearise(model, fits.theta[c, :count], fits.state[c])
        if model.profile.refresh > 1:
            model.slopes = lin.transition, lin.sensing
        transition.append(torch.where(inside > 0, lin.transition, identity))
        sensing.append(lin.sensing * used)
        drive[c, ..., 0] = lin.following - fits.state[c, :, 1:]
        drive[c, ..., 1 : 1 + count] = lin.by_parameter
        reading[c, ..., 0] = rows.measured - lin.measured
        reading[c, ..., 1 : 1 + count] = -lin.sensing_by_parameter
        start[c, ..., 0] = origin - fits.state[c, :, 0]
    return Linear(
        torch.cat(transition),
        (drive * inside).flatten(0, 1),
        torch.cat(sensing),
        (reading * used).flatten(0, 1),
        start.flatten(0, 1),
        torch.tensor(models[0].profile.spread, dtype=torch.float64),
    )


def variances(model: CandidateModel, log_process: Tensor, log_noise: Tensor) -> tuple[Tensor, Tensor]:
    """Process covariances (C W, n, n) and measurement variances (C W, m) for the filter."""
    windows = model.rows.shape[0]
    process = torch.full((len(log_process), len(model.system.states)), SMOOTH**2, dtype=torch.float64)
    for k, group in enumerate(model.profile.driven):
        process[:, list(group)] = log_process[:, k, None].exp()
    return torch.diag_embed(process).repeat_interleave(windows, 0), log_noise.exp().repeat_interleave(windows, 0)


def noise_groups(model: CandidateModel) -> Tensor:
    """(G + S, G + m) which variances, of process noise by group and of channels, are one: 1 where it is this one."""
    groups, channels = len(model.profile.driven), model.rows.channels
    sensors = [[float(c in kind) for c in channels] for kind in model.profile.sensors]
    seen = torch.tensor([row for row in sensors if any(row)], dtype=torch.float64)
    return torch.block_diag(torch.eye(groups, dtype=torch.float64), seen)


Chosen = TypeVar("Chosen", "FitState", "Slope")


@dataclass(frozen=True)
class Slope:
    """What a linearisation says about where to go."""

    likelihood: Tensor
    """(C,)"""
    information: Tensor
    """(C, K, K)"""
    pull: Tensor
    """(C, K) gradient of the log likelihood in the free parameters"""
    noise_information: Tensor
    """(C, G + S, G + S) of the groups of process noise and the kinds of sensors"""
    noise_pull: Tensor
    """(C, G + S)"""
    smoothed: Tensor
    """(C, W, T, n, 1 + K) change of the states, and with each parameter"""


def slope(models: Sequence[CandidateModel], fits: FitState, counts: Tensor) -> Slope:
    """Likelihood, gradient and Fisher information at `fits`."""
    count, windows = counts.shape
    logs = torch.cat((fits.log_process, fits.log_noise), 1)
    problem = linear_problem(models, fits)
    used = models[0].rows.used.repeat(count, 1, 1) * counts.reshape(-1, 1, 1)
    here = forward(problem, *variances(models[0], fits.log_process, fits.log_noise))
    likelihood = log_likelihood(here, used).reshape(count, windows).sum(-1)
    white = (here.white * used[..., None]).reshape(count, -1, here.innovation.shape[-1])
    error, columns = white[..., :1], white[..., 1:]
    # The noise's turn: the data's column alone, filtered with each variance a little larger.
    alike = noise_groups(models[0])
    varied = (logs + LOG_STEP * alike[:, None]).flatten(0, 1).split((fits.log_process.shape[1], used.shape[-1]), 1)
    swayed = forward(_repeated(problem.data(), len(alike)), *variances(models[0], *varied))
    gains = log_likelihood(swayed, used.repeat(len(alike), 1, 1)).reshape(-1, count, windows).sum(-1) - likelihood

    def by_noise(there: Tensor, now: Tensor) -> Tensor:
        change = (there.reshape(-1, *now.shape) - now) / LOG_STEP * used
        return change.reshape(len(alike), count, -1).permute(1, 2, 0)

    sways = by_noise(swayed.variance.log(), here.variance.log())
    shifts = by_noise(swayed.innovation[..., 0], here.innovation[..., 0]) / here.variance.sqrt().reshape(count, -1, 1)
    smoothed, _ = backward(problem, here)
    return Slope(
        likelihood,
        columns.mT @ columns,
        -(columns.mT @ error)[..., 0],
        0.5 * sways.mT @ sways + shifts.mT @ shifts,
        (gains / LOG_STEP).T,
        smoothed.reshape(*fits.state.shape, -1),
    )


def _repeated(problem: Linear, count: int) -> Linear:
    """The same systems so many times."""

    def repeat(x: Tensor) -> Tensor:
        return x.repeat(count, *(1,) * (x.dim() - 1))

    every = {field.name: repeat(getattr(problem, field.name)) for field in fields(problem) if field.name != "spread"}
    return replace(problem, **every)


@dataclass(frozen=True)
class Bounds:
    """Of parameters (C, K), both 0 for those that a set does not have; and of the noise."""

    low: Tensor
    high: Tensor
    noise: Tensor
    """(m,) least log variances: rounding to steps is noise too, of a step over the root of 12"""


def fit(
    models: Sequence[CandidateModel], start: FitState, counts: Tensor, iterations: int, still: bool = False
) -> FitState:
    """Fit from `start`; `counts` (C, W) is 1 for the windows that count; `still` allows no process noise."""
    if still:
        start = replace(start, log_process=torch.full_like(start.log_process, QUIET))
    low, high = torch.zeros_like(start.theta), torch.zeros_like(start.theta)
    for c, model in enumerate(models):
        low[c, : len(model.table)], high[c, : len(model.table)] = model.low, model.high
    steps = torch.tensor(models[0].rows.step, dtype=torch.float64)
    bounds = Bounds(low, high, (steps.square() / 12 + TINY).log())
    damping = torch.full((len(models),), 1e-3, dtype=torch.float64)
    stale = torch.zeros(len(models), dtype=torch.long)
    live = torch.arange(len(models))
    here = best = start
    at: Slope | None = None
    refresh = models[0].profile.refresh
    for iteration in range(iterations):
        if (iteration + 1) % refresh == 0:
            for model in models:
                model.slopes = None
        now = slope([models[k] for k in live.tolist()], here.of(live), counts[live])
        tried = replace(here.of(live), likelihood=now.likelihood, information=now.information)
        if at is None:
            best, at = tried, now
        else:
            gain = tried.likelihood - best.likelihood[live]
            better = gain > 0
            damping[live] = torch.where(better, damping[live] / 4, (8 * damping[live]).clamp(min=0.1))
            stale[live] = torch.where(better & (gain < ENOUGH), stale[live] + 1, 0)
            best = _put(best, live[better], tried, better)
            at = _put(at, live[better], now, better)
            # Those that have settled leave the batch.
            live = live[(stale[live] < 2) & (damping[live] < STUCK)]
            if not len(live):
                break
        here = _step(best, at, damping, bounds, noise_groups(models[0]))
        if still:
            here = replace(here, log_process=start.log_process)
    return best


def _step(fits: FitState, at: Slope, damping: Tensor, bounds: Bounds, alike: Tensor) -> FitState:
    width = bounds.high - bounds.low
    # Weak enough to matter only where the data say nothing; a parameter that a set does not have stays where it is.
    prior = torch.where(width > 0, (2 / width).square(), 1.0)
    diagonal = torch.diagonal(at.information, dim1=1, dim2=2)
    matrix = at.information + torch.diag_embed(prior + damping[:, None] * diagonal)
    change = torch.linalg.solve(matrix, at.pull[..., None])[..., 0]
    theta = (fits.theta + change).clamp(bounds.low, bounds.high)
    change = theta - fits.theta
    moves = torch.cat((torch.ones(len(change), 1, dtype=change.dtype), change), 1)
    share = 1 / (1 + damping)[:, None]
    matrix = at.noise_information + 0.3 * torch.eye(at.noise_pull.shape[1], dtype=change.dtype)
    sway = torch.linalg.solve(matrix, at.noise_pull[..., None])[..., 0].clamp(-GREATEST, GREATEST) * share @ alike
    groups = fits.log_process.shape[1]
    return replace(
        fits,
        theta=theta,
        state=fits.state + (at.smoothed * moves[:, None, None, None]).sum(-1),
        log_process=(fits.log_process + sway[:, :groups]).clamp(QUIET, LOUD),
        log_noise=torch.maximum(fits.log_noise + sway[:, groups:], bounds.noise),
    )


def _put(into: Chosen, places: Tensor, values: Chosen, which: Tensor) -> Chosen:
    """`into` with the count at `places` replaced by those of `values` that `which` marks."""
    out = {}
    for field in fields(into):
        tensor = getattr(into, field.name).clone()
        tensor[places] = getattr(values, field.name)[which]
        out[field.name] = tensor
    return replace(into, **out)

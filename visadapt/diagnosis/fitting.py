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
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from visadapt.diagnosis.data import Rows
from visadapt.diagnosis.filtering import Filtered, Linear, backward, forward, log_likelihood
from visadapt.diagnosis.models import Family, linearise

SMOOTH = 1e-6
"""Process noise of position and angle, m and rad: they follow from their velocities."""

QUIET = math.log(1e-4**2)
LOUD = math.log(3.0**2)
"""Bounds of the log variance of w in the velocities, (m/s)^2 and (rad/s)^2."""

SPREAD = (0.3**2, 2.0**2, 0.3**2, 3.0**2)
"""Variances of the first state around its rough estimate."""

ENOUGH = 0.02
"""Log likelihood that is not worth an iteration."""

LOG_STEP = 1e-3
GREATEST = 1.5
"""Finite difference, and greatest change in an iteration, of a log variance."""


@dataclass(frozen=True)
class Fits:
    """C sets of effects, fitted."""

    theta: Tensor
    """(C, K) parameters, 0 beyond what a set has"""
    state: Tensor
    """(C, W, T, n)"""
    log_process: Tensor
    """(C, 2) log variances of w in the velocities"""
    log_noise: Tensor
    """(C, m) log variances of the measurements"""
    likelihood: Tensor
    """(C,) log likelihood of the windows that count"""
    information: Tensor
    """(C, K, K) Fisher's"""

    def of(self, chosen: Tensor) -> Fits:
        """Only these."""
        return Fits(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def rough(rows: Rows, n: int) -> Tensor:
    """States (W, T, n) from the measurements alone: a velocity that was not measured is a difference."""
    out = torch.zeros(*rows.shape, n, dtype=torch.float64)
    for k, channel in enumerate(rows.channels):
        out[..., channel] = rows.measured[..., k]
    for channel in (1, 3):
        if channel not in rows.channels:
            position = out[..., channel - 1]
            change = torch.zeros_like(position)
            change[:, 1:-1] = (position[:, 2:] - position[:, :-2]) / (2 * rows.period)
            change[:, 0] = (position[:, 1] - position[:, 0]) / rows.period
            out[..., channel] = change
    return out * rows.inside[..., None]


def linear_problem(families: Sequence[Family], fits: Fits, origin: Tensor) -> Linear:
    """The models, one after the other, along the states of `fits`; `origin` (W, n) is the rough first state."""
    rows = families[0].rows
    used = rows.used[..., None]
    inside = rows.inside[:, 1:, None, None]
    windows, length, n = fits.state.shape[1:]
    columns = 1 + fits.theta.shape[1]
    identity = torch.eye(n, dtype=torch.float64)
    transition, sensing = [], []
    drive = torch.zeros(len(families), windows, length - 1, n, columns, dtype=torch.float64)
    reading = torch.zeros(len(families), windows, length, len(rows.channels), columns, dtype=torch.float64)
    start = torch.zeros(len(families), windows, n, columns, dtype=torch.float64)
    for c, family in enumerate(families):
        count = len(family.table)
        lin = linearise(family, fits.theta[c, :count], fits.state[c])
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
        torch.tensor(SPREAD, dtype=torch.float64),
    )


def variances(log_process: Tensor, log_noise: Tensor, windows: int) -> tuple[Tensor, Tensor]:
    """Process (C W, 4) and measurement (C W, m) variances for the filter."""
    process = torch.full((len(log_process), 4), SMOOTH**2, dtype=torch.float64)
    process[:, 1::2] = log_process.exp()
    return process.repeat_interleave(windows, 0), log_noise.exp().repeat_interleave(windows, 0)


Chosen = TypeVar("Chosen", "Fits", "Slope")


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
    """(C, 2 + m, 2 + m)"""
    noise_pull: Tensor
    """(C, 2 + m)"""
    smoothed: Tensor
    """(C, W, T, n, 1 + K) change of the states, and with each parameter"""


def slope(families: Sequence[Family], fits: Fits, origin: Tensor, counts: Tensor) -> Slope:
    """Likelihood, gradient and Fisher information at `fits`."""
    models, windows = counts.shape
    logs = torch.cat((fits.log_process, fits.log_noise), 1)
    replicas = 1 + logs.shape[1]
    varied = logs[None].repeat(replicas, 1, 1)
    varied[1:] += LOG_STEP * torch.eye(replicas - 1, dtype=logs.dtype)[:, None]
    varied = varied.flatten(0, 1)
    problem = linear_problem(families, fits, origin)
    used = families[0].rows.used.repeat(models, 1, 1) * counts.reshape(-1, 1, 1)
    process, noise = variances(varied[:, :2], varied[:, 2:], windows)
    filtered = forward(_repeated(problem, replicas), process, noise)
    own = models * windows
    likelihoods = log_likelihood(filtered, used.repeat(replicas, 1, 1)).reshape(replicas, models, windows).sum(-1)
    here = _first(filtered, own)
    white = (here.white * used[..., None]).reshape(models, -1, here.innovation.shape[-1])
    error, columns = white[..., :1], white[..., 1:]

    def by_noise(values: Tensor) -> Tensor:
        values = values.reshape(replicas, own, *values.shape[1:])
        change = (values[1:] - values[:1]) / LOG_STEP * used
        return change.reshape(replicas - 1, models, -1).permute(1, 2, 0)

    sways = by_noise(filtered.variance.log())
    shifts = by_noise(filtered.innovation[..., 0]) / here.variance.sqrt().reshape(models, -1, 1)
    smoothed, _ = backward(problem, here)
    return Slope(
        likelihoods[0],
        columns.mT @ columns,
        -(columns.mT @ error)[..., 0],
        0.5 * sways.mT @ sways + shifts.mT @ shifts,
        ((likelihoods[1:] - likelihoods[0]) / LOG_STEP).T,
        smoothed.reshape(*fits.state.shape, -1),
    )


def _repeated(problem: Linear, count: int) -> Linear:
    def repeat(x: Tensor) -> Tensor:
        return x.repeat(count, *(1,) * (x.dim() - 1))

    return Linear(
        repeat(problem.transition),
        repeat(problem.drive),
        repeat(problem.sensing),
        repeat(problem.reading),
        repeat(problem.start),
        problem.spread,
    )


def _first(filtered: Filtered, count: int) -> Filtered:
    """The first so many systems."""
    return Filtered(
        [x[:count] for x in filtered.predicted],
        [x[:count] for x in filtered.covariance],
        [[g[:count] for g in row] for row in filtered.gain],
        filtered.innovation[:count],
        filtered.variance[:count],
    )


@dataclass(frozen=True)
class Bounds:
    """Ranges of parameters (C, K), both 0 for those that a set does not have."""

    low: Tensor
    high: Tensor


def fit(families: Sequence[Family], start: Fits, counts: Tensor, iterations: int, still: bool = False) -> Fits:
    """Fit from `start`; `counts` (C, W) is 1 for the windows that count; `still` allows no process noise."""
    if still:
        start = replace(start, log_process=torch.full_like(start.log_process, QUIET))
    origin = rough(families[0].rows, start.state.shape[-1])[:, 0]
    low, high = torch.zeros_like(start.theta), torch.zeros_like(start.theta)
    for c, family in enumerate(families):
        low[c, : len(family.table)], high[c, : len(family.table)] = family.low, family.high
    bounds = Bounds(low, high)
    damping = torch.full((len(families),), 1e-3, dtype=torch.float64)
    here, best, best_slope, quiet = start, start, None, 0
    for _ in range(iterations):
        now = slope(families, here, origin, counts)
        here = replace(here, likelihood=now.likelihood, information=now.information)
        if best_slope is None:
            best, best_slope = here, now
        else:
            gain = here.likelihood - best.likelihood
            better = gain > 0
            quiet = quiet + 1 if bool((gain < ENOUGH).all()) else 0
            damping = torch.where(better, damping / 4, damping * 8).clamp(1e-9, 1e9)
            best, best_slope = _where(better, here, best), _where(better, now, best_slope)
            if quiet >= 2:
                break
        here = _step(best, best_slope, damping, bounds)
        if still:
            here = replace(here, log_process=start.log_process)
    return best


def _step(fits: Fits, at: Slope, damping: Tensor, bounds: Bounds) -> Fits:
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
    sway = torch.linalg.solve(matrix, at.noise_pull[..., None])[..., 0].clamp(-GREATEST, GREATEST) * share
    return replace(
        fits,
        theta=theta,
        state=fits.state + (at.smoothed * moves[:, None, None, None]).sum(-1),
        log_process=(fits.log_process + sway[:, :2]).clamp(QUIET, LOUD),
        log_noise=fits.log_noise + sway[:, 2:],
    )


def _where(keep: Tensor, a: Chosen, b: Chosen) -> Chosen:
    def pick(x: Tensor, y: Tensor) -> Tensor:
        return torch.where(keep.reshape(-1, *(1,) * (x.dim() - 1)), x, y)

    return type(a)(*(pick(getattr(a, name), getattr(b, name)) for name in a.__dataclass_fields__))

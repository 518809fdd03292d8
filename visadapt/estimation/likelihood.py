"""Maximum likelihood fits of several sets of effects in one batch, with states, noise and disturbances estimated too.

    x_{t+1} = f(x_t, u_t; theta) + w_t,  w_t ~ N(0, Q)        y_t = h(x_t; theta) + v_t,  v_t ~ N(0, R)

One-step residuals mislead where states are noisy, so the states are unknowns too: Gauss-Newton on states and
parameters together, where the states are integrated out by a Kalman filter along their own estimate (a multiple
shooting in which every row starts a shot; Bock and Plitt 1984, and Kristensen, Madsen and Jorgensen 2004, Automatica
40(2), for the likelihood of innovations). Q and R follow by scoring on the smoothed noises. Where the effects
are right Q goes to zero, and every row of an episode informs every parameter; where an effect is missing Q grows to
the variance of what is missing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from visadapt.batch import Batch
from visadapt.estimation.candidate import CandidateModel, linearise
from visadapt.estimation.kalman import Linear, adjoints, forward, log_likelihood, noise_scores, respond, weights
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

POSITION_PROCESS_NOISE = 1e-6
"""Standard deviation of the process noise of states other than driven velocities, in their units (m, rad): practically
none, since they follow from their velocities."""

MIN_LOG_PROCESS = math.log(1e-4**2)
MAX_LOG_PROCESS = math.log(3.0**2)
"""Bounds of the log process noise variance of the driven velocities, (m/s)^2 and (rad/s)^2."""

MIN_ITERATION_GAIN = 0.02  # Log likelihood; a fit stops after two iterations in a row that gain less

MIN_MEASUREMENT_VARIANCE = 1e-12  # Lower bound of a measurement's variance, in its unit squared

MAX_DAMPING = 100.0  # Damping at which a fit stops, since its steps have become too short to gain anything

OUT_OF_REACH = 100.0
"""Log likelihood short of its rival's at which a fit stops: where it would end if it gained in every iteration that is
left what it gained in the last one."""

MAX_LOG_VARIANCE_CHANGE = 1.5  # Largest change of a log variance in one iteration


@dataclass(frozen=True)
class FitState(Batch):
    """Estimates for C sets of effects."""

    theta: Tensor  # (C, K) parameters, padded with 0 where a set has fewer than K
    state: Tensor  # (C, W, T, n) states along which the models are linearised
    log_process: Tensor  # (C, G) log process noise variances of the driven velocities, by group
    log_noise: Tensor  # (C, m) log variances of the measurements
    likelihood: Tensor  # (C,) log likelihood of the windows that the fit used
    information: Tensor  # (C, K, K) Fisher information of the parameters


def initial_states(rows: Segments, system: System) -> Tensor:
    """Initial guess (W, T, n) of the states: the measurements, and difference quotients for missing velocities."""
    out = torch.zeros(*rows.shape, len(system.states), dtype=torch.float64)
    for k, channel in enumerate(rows.channels):
        out[..., channel] = rows.measured[..., k]
    for channel, position_column in profile_of(system).position_of.items():
        if channel not in rows.channels:
            position = out[..., position_column]
            change = torch.zeros_like(position)
            change[:, 1:-1] = (position[:, 2:] - position[:, :-2]) / (rows.time[:, 2:] - rows.time[:, :-2])
            change[:, 0] = (position[:, 1] - position[:, 0]) / rows.duration[:, 0]
            out[..., channel] = change
    return out * rows.inside[..., None]


def linear_problem(models: Sequence[CandidateModel], fits: FitState) -> Linear:
    """The systems of all C models linearised along the states of `fits`, C W in all, model by model.

    Column 0 of the inputs is the data: defects of the states against the model, and measurement residuals. The others
    are derivatives by the K parameters. States of the linear system are corrections to those of `fits`.
    """
    rows = models[0].rows
    origin = initial_states(rows, models[0].system)[:, 0]
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
        if model.profile.relinearise_every > 1:
            model.slopes = lin.transition, lin.sensing
        transition.append(torch.where(inside > 0, lin.transition, identity))
        sensing.append(lin.sensing * used)
        drive[c, ..., 0] = lin.next_state - fits.state[c, :, 1:]
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
        torch.tensor(models[0].profile.initial_variance, dtype=torch.float64),
    )


def variances(model: CandidateModel, log_process: Tensor, log_noise: Tensor) -> tuple[Tensor, Tensor]:
    """Process noise covariances (C W, n, n) and measurement variances (C W, m) for the filter."""
    windows = model.rows.shape[0]
    process = torch.full((len(log_process), len(model.system.states)), POSITION_PROCESS_NOISE**2, dtype=torch.float64)
    for k, group in enumerate(model.profile.driven):
        process[:, list(group)] = log_process[:, k, None].exp()
    return torch.diag_embed(process).repeat_interleave(windows, 0), log_noise.exp().repeat_interleave(windows, 0)


def noise_members(model: CandidateModel) -> tuple[Tensor, Tensor]:
    """(G + S, n) and (G + S, m) 1 where the noise of a state or a channel has the row's free variance.

    There is one of each of G groups of driven velocities, and one of each of S kinds of sensors.
    """
    channels = model.rows.channels
    driven = [[float(k in group) for k in range(len(model.system.states))] for group in model.profile.driven]
    sensors = [[float(c in kind) for c in channels] for kind in model.profile.sensors]
    measured = [row for row in sensors if any(row)]
    whole = torch.block_diag(torch.tensor(driven), torch.tensor(measured)).double()
    return whole[:, : len(model.system.states)], whole[:, len(model.system.states) :]


Batched = TypeVar("Batched", "FitState", "Derivatives")


@dataclass(frozen=True)
class Derivatives(Batch):
    """Likelihood of C fits, with its derivatives."""

    likelihood: Tensor  # (C,)
    information: Tensor  # (C, K, K)
    gradient: Tensor  # (C, K) of the log likelihood by the parameters
    noise_information: Tensor
    """(C, G + S, G + S) Fisher information of the log variances of process noise groups and kinds of sensors"""
    noise_gradient: Tensor  # (C, G + S) of the log likelihood by these
    smoothed: Tensor  # (C, W, T, n, 1 + K) smoothed correction of the states, and its derivative by each parameter


def differentiate(models: Sequence[CandidateModel], fits: FitState, window_used: Tensor) -> Derivatives:
    """Likelihood, gradient and Fisher information at `fits`, over the windows where `window_used` (C, W) is 1."""
    count, windows = window_used.shape
    problem = linear_problem(models, fits)
    used = models[0].rows.used.repeat(count, 1, 1) * window_used.reshape(-1, 1, 1)
    process, noise = variances(models[0], fits.log_process, fits.log_noise)
    here = forward(problem, process, noise)

    def of_each(white: Tensor) -> Tensor:
        """Whitened innovations (C, readings, M) of every fit."""
        return (white * used[..., None]).reshape(count, -1, white.shape[-1])

    error, columns = of_each(here.white).split((1, fits.theta.shape[1]), -1)
    # The information of the log variances: that of inputs which are the smoothed noises of one group (Gilmour, Thompson
    # and Cullis 1995, Biometrics 51(4)), in the mean of the data and of data that the model draws. The data alone would
    # give steps that are too long far from the optimum, where they are unlike the model.
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(models[0].rows.used.shape, generator=generator, dtype=torch.float64)  # the same for every fit
    white = torch.cat((here.white, (drawn.repeat(count, 1, 1) * used)[..., None]), -1)
    adjoint = adjoints(here, white)
    smoothed = here.predicted - here.covariance @ adjoint[..., :-1]
    both = [0, -1]
    adjoint = adjoint[..., both]
    weight = weights(here, white[..., both], adjoint)
    process = process.diagonal(dim1=1, dim2=2)
    driven, measured = noise_members(models[0])
    by_process, by_noise = noise_scores(here, adjoint[..., 0], weight[..., 0], process, noise)
    score = (by_process * window_used.reshape(-1, 1, 1)).sum(1) @ driven.T + (by_noise * used).sum(1) @ measured.T
    # The smoothed w is minus Q times the adjoint; what inputs add to the states is subtracted from the readings.
    drive = (process[:, None, :, None] * adjoint[:, 1:])[..., None] * driven.T[:, None]
    reading = (noise[:, None, :, None] * weight)[..., None] * measured.T[:, None]
    working = of_each(respond(here, drive.flatten(-2), reading.flatten(-2)))
    working = working.unflatten(-1, (2, len(driven))).flatten(1, 2)
    return Derivatives(
        log_likelihood(here, used).reshape(count, windows).sum(-1),
        columns.mT @ columns,
        -(columns.mT @ error)[..., 0],
        0.25 * working.mT @ working,
        score.reshape(count, windows, -1).sum(1),
        smoothed.reshape(*fits.state.shape, -1),
    )


def fit(
    models: Sequence[CandidateModel],
    start: FitState,
    window_used: Tensor,
    iterations: int,
    process_noise: bool = True,
    rival: float = -math.inf,
) -> FitState:
    """The best fits of C models of the same rows in at most `iterations` damped Gauss-Newton steps from `start`.

    Args:
        window_used: (C, W) 1 for the windows that each fit uses.
        process_noise: without it, process noise stays at its lower bound.
        rival: log likelihood of another fit; fits that cannot come near it stop early.
    """
    if not process_noise:
        start = replace(start, log_process=torch.full_like(start.log_process, MIN_LOG_PROCESS))
    # (C, K); the bounds of padding are 0.
    low, high = torch.zeros_like(start.theta), torch.zeros_like(start.theta)
    for c, model in enumerate(models):
        low[c, : len(model.table)], high[c, : len(model.table)] = model.low, model.high
    damping = torch.full((len(models),), 1e-3, dtype=torch.float64)
    stalled = torch.zeros(len(models), dtype=torch.long)
    gained = torch.full_like(damping, math.inf)  # by the last step that gained something
    active = torch.arange(len(models))
    here = best = start
    at: Derivatives | None = None
    period = models[0].profile.relinearise_every
    for iteration in range(iterations):
        if (iteration + 1) % period == 0:
            for model in models:
                model.slopes = None
        now = differentiate([models[k] for k in active.tolist()], here[active], window_used[active])
        tried = replace(here[active], likelihood=now.likelihood, information=now.information)
        if at is None:
            best, at = tried, now
        else:
            gain = tried.likelihood - best.likelihood[active]
            better = gain > 0
            damping[active] = torch.where(better, damping[active] / 4, (8 * damping[active]).clamp(min=0.1))
            stalled[active] = torch.where(better & (gain < MIN_ITERATION_GAIN), stalled[active] + 1, 0)
            best = _replaced(best, active[better], tried, better)
            at = _replaced(at, active[better], now, better)
            gained[active] = torch.where(better, gain, gained[active])
            in_reach = best.likelihood + (iterations - 1 - iteration) * gained > rival - OUT_OF_REACH
            # Fits that have converged leave the batch.
            active = active[(stalled[active] < 2) & (damping[active] < MAX_DAMPING) & in_reach[active]]
            if not len(active):
                break
        here = _step(best, at, damping, (low, high), models[0])
        if not process_noise:
            here = replace(here, log_process=start.log_process)
    return best


def _step(
    fits: FitState, at: Derivatives, damping: Tensor, bounds: tuple[Tensor, Tensor], model: CandidateModel
) -> FitState:
    """The damped Gauss-Newton step from `fits`, with parameters within the bounds (C, K)."""
    low, high = bounds
    # A prior weak enough to matter only where the data hold no information; the 1.0 is for padding, which stays 0.
    prior = torch.where(high > low, (2 / (high - low)).square(), 1.0)
    diagonal = torch.diagonal(at.information, dim1=1, dim2=2)
    matrix = at.information + torch.diag_embed(prior + damping[:, None] * diagonal)
    change = torch.linalg.solve(matrix, at.gradient[..., None])[..., 0]
    theta = (fits.theta + change).clamp(low, high)
    change = theta - fits.theta
    moves = torch.cat((torch.ones(len(change), 1, dtype=change.dtype), change), 1)
    share = 1 / (1 + damping)[:, None]
    matrix = at.noise_information + 0.3 * torch.eye(at.noise_gradient.shape[1], dtype=change.dtype)
    move = torch.linalg.solve(matrix, at.noise_gradient[..., None])[..., 0]
    log_change = move.clamp(-MAX_LOG_VARIANCE_CHANGE, MAX_LOG_VARIANCE_CHANGE) * share
    groups = fits.log_process.shape[1]
    noise_change = log_change @ noise_members(model)[1]
    # Rounding to a resolution is noise with a deviation of resolution / sqrt(12).
    resolution = torch.tensor(model.rows.step, dtype=torch.float64)
    lowest_noise = (resolution.square() / 12 + MIN_MEASUREMENT_VARIANCE).log()
    return replace(
        fits,
        theta=theta,
        state=fits.state + (at.smoothed * moves[:, None, None, None]).sum(-1),
        log_process=(fits.log_process + log_change[:, :groups]).clamp(MIN_LOG_PROCESS, MAX_LOG_PROCESS),
        log_noise=torch.maximum(fits.log_noise + noise_change, lowest_noise),
    )


def _replaced(into: Batched, indices: Tensor, values: Batched, chosen: Tensor) -> Batched:
    """`into` with its members at `indices` replaced by the `chosen` members of `values`."""
    return into.map(lambda old, new: old.index_put((indices,), new[chosen]), values)

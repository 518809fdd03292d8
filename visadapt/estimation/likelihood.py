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

import torch
from torch import Tensor

from visadapt.batch import Batch
from visadapt.estimation.candidate import CandidateModel, linearise
from visadapt.estimation.colour import Colour, whitened
from visadapt.estimation.kalman import (
    Filtered,
    Linear,
    adjoints,
    forward,
    log_likelihood,
    noise_scores,
    respond,
    weights,
)
from visadapt.estimation.segments import initial_states

LEAST_PROCESS_NOISE = 1e-6
"""Standard deviation of a process noise of every state, in its unit, beside that of the loads: practically none."""

LEAST_DRIVE, LEAST_DRIVE_PERIOD = 1e-4, 0.02
"""Least standard deviation of the process noise of the driven velocities over a period, m/s and rad/s, and the period,
in s, below which it is less in proportion: as a load it is then the same on every clock."""

MAX_LOG_PROCESS = math.log(3.0**2)
"""Upper bound of the log process noise variance of the driven velocities, (m/s)^2 and (rad/s)^2."""


def min_log_process(period: float) -> float:
    """Lower bound of the log process noise variance of the driven velocities on a clock with this period in s."""
    return 2 * math.log(LEAST_DRIVE * min(1.0, period / LEAST_DRIVE_PERIOD))


MIN_READING_PER_STATE = 0.01
"""Derivative of a reading by its own state at or below which the reading counts as telling nothing of that state, as
when a frozen sensor repeats its last value."""


@dataclass(frozen=True)
class FitState(Batch):
    """Estimates for C sets of effects."""

    theta: Tensor  # (C, K) parameters, padded with 0 where a set has fewer than K
    state: Tensor  # (C, W, T, n) states along which the models are linearised
    log_process: Tensor  # (C, G) log process noise variances of the driven velocities, by group
    log_noise: Tensor  # (C, m) log variances of the measurements
    likelihood: Tensor  # (C,) log likelihood
    information: Tensor  # (C, K, K) Fisher information of the parameters

    def on(self, windows: Tensor) -> FitState:
        """The same, with the states of these windows, by index."""
        return replace(self, state=self.state[:, windows])


def linear_problem(models: Sequence[CandidateModel], fits: FitState) -> Linear:
    """The systems of all C models linearised along the states of `fits`, C W in all, model by model.

    Column 0 of the inputs is the data: defects of the states against the model, and measurement residuals. The others
    are derivatives by the K parameters. States of the linear system are corrections to those of `fits`.
    """
    rows = models[0].rows
    origin = initial_states(rows, models[0].system)[:, 0]
    variance = torch.tensor(models[0].profile.initial_variance, dtype=torch.float64)
    inside = rows.inside[:, 1:, None, None]
    windows, length, n = fits.state.shape[1:]
    columns = 1 + fits.theta.shape[1]
    identity = torch.eye(n, dtype=torch.float64)
    transition, sensing, initial_variance = [], [], []
    drive = torch.zeros(len(models), windows, length - 1, n, columns, dtype=torch.float64)
    reading = torch.zeros(len(models), windows, length, len(rows.channels), columns, dtype=torch.float64)
    start = torch.zeros(len(models), windows, n, columns, dtype=torch.float64)
    for c, model in enumerate(models):
        count = len(model.table)
        lin = linearise(model, fits.theta[c, :count], fits.state[c])
        measured, used = model.shown(fits.theta[c, :count])
        if model.profile.relinearise_every > 1:
            model.slopes = lin.transition, lin.sensing
        transition.append(torch.where(inside > 0, lin.transition, identity))
        sensing.append(lin.sensing * used[..., None])
        per_state = _reading_per_state(lin.sensing[:, 0], models[0])
        initial_variance.append(variance / per_state.square())
        drive[c, ..., 0] = lin.next_state - fits.state[c, :, 1:]
        drive[c, ..., 1 : 1 + count] = lin.by_parameter
        reading[c, ..., 0] = (measured - lin.measured) * used
        reading[c, ..., 1 : 1 + count] = -lin.sensing_by_parameter * used[..., None]
        start[c, ..., 0] = origin / per_state - fits.state[c, :, 0]
    return Linear(
        torch.cat(transition),
        (drive * inside).flatten(0, 1),
        torch.cat(sensing),
        reading.flatten(0, 1),
        start.flatten(0, 1),
        torch.cat(initial_variance),
    )


def _reading_per_state(sensing: Tensor, model: CandidateModel) -> Tensor:
    """(W, n) change of a state's reading per unit of the state, for derivatives `sensing` (W, m, n) of the readings; of
    a velocity that is not measured, that of its position.

    The prior of a window's first state holds in units of its reading: in the state's own units it would favour a
    sensor scale below 1.
    """
    out = torch.ones_like(sensing[:, 0])
    for k, channel in enumerate(model.rows.channels):
        out[:, channel] = sensing[:, k, channel]
    for velocity, position in model.profile.position_of.items():
        if velocity not in model.rows.channels:
            out[:, velocity] = out[:, position]
    return torch.where(out.abs() > MIN_READING_PER_STATE, out, 1.0)


def variances(model: CandidateModel, fits: FitState, problem: Linear) -> tuple[Tensor, Tensor]:
    """Process noise covariances (C W, T - 1, n, n) and measurement variances (C W, m) for the filter of `problem`."""
    loads, noise = _noises(model, fits, problem)
    return loads.covariance(), noise


@dataclass(frozen=True)
class LoadNoise(Batch):
    """The process noise of N systems: loads held for a period, each in the velocity that it gives to its coordinate."""

    directions: Tensor  # (N, T - 1, n, L) change of the states per unit of each load
    variance: Tensor  # (N, L)

    def covariance(self) -> Tensor:
        """(N, T - 1, n, n) of the states, of which each has LEAST_PROCESS_NOISE of its own."""
        least = torch.full_like(self.directions[..., 0], LEAST_PROCESS_NOISE**2)
        return (self.directions * self.variance[:, None, None]) @ self.directions.mT + torch.diag_embed(least)

    def smoothed(self, adjoint: Tensor) -> Tensor:
        """Smoothed loads (N, T - 1, L, M), with the other sign, from the smoother's adjoints (N, T, n, M)."""
        return self.variance[:, None, :, None] * (self.directions.mT @ adjoint[:, 1:])


def _noises(model: CandidateModel, fits: FitState, problem: Linear) -> tuple[LoadNoise, Tensor]:
    """Process noise of the C W systems of `problem`, and measurement variances (C W, m).

    Process noise is in units of the readings, since its lower bound would otherwise favour a sensor scale below 1.
    """
    windows = model.rows.shape[0]
    per_reading = problem.initial_variance / problem.initial_variance.new_tensor(model.profile.initial_variance)
    directions = model.noise_directions.repeat(len(fits.theta), 1, 1, 1)
    group = [k for k, columns in enumerate(model.profile.driven) for _ in columns]
    variance, noise = fits.log_process[:, group].exp(), fits.log_noise.exp()
    loads = LoadNoise(directions * per_reading.sqrt()[:, None, :, None], variance.repeat_interleave(windows, 0))
    return loads, noise.repeat_interleave(windows, 0)


def noise_members(model: CandidateModel) -> tuple[Tensor, Tensor]:
    """Which noises share a free variance: (G + S, L) for the loads and (G + S, m) for the channels, 1 where the noise
    has the variance of that row.

    There is one variance for each of G groups of driven velocities, and one for each of S kinds of sensors.
    """
    channels = model.rows.channels
    driven = [[float(k in group) for k in model.profile.driven_columns] for group in model.profile.driven]
    sensors = [[float(c in kind) for c in channels] for kind in model.profile.sensors]
    measured = [row for row in sensors if any(row)]
    whole = torch.block_diag(torch.tensor(driven), torch.tensor(measured)).double()
    loads = len(model.profile.driven_columns)
    return whole[:, :loads], whole[:, loads:]


@dataclass(frozen=True)
class Derivatives(Batch):
    """Likelihood of C fits, with its derivatives: of each of W windows, or summed over windows, without W."""

    likelihood: Tensor  # (C, W)
    information: Tensor  # (C, W, K, K)
    gradient: Tensor  # (C, W, K) of the log likelihood by the parameters
    noise_information: Tensor
    """(C, W, G + S, G + S) Fisher information of the log variances of process noise groups and kinds of sensors"""
    noise_gradient: Tensor  # (C, W, G + S) of the log likelihood by these
    smoothed: Tensor  # (C, W, T, n, 1 + K) smoothed correction of the states, and its derivative by each parameter

    def summed(self, window_used: Tensor) -> Derivatives:
        """Sums over windows with weights (C, W); a single fit may have C rows of weights, and then gives C sums."""

        def total(each: Tensor) -> Tensor:
            return (each * window_used.reshape(*window_used.shape, *[1] * (each.dim() - 2))).sum(1)

        return Derivatives(
            total(self.likelihood),
            total(self.information),
            total(self.gradient),
            total(self.noise_information),
            total(self.noise_gradient),
            self.smoothed.expand(len(window_used), *self.smoothed.shape[1:]),
        )


ROWS_AT_ONCE = 16384  # Rows that are filtered together, so that memory is bounded


def differentiate(models: Sequence[CandidateModel], fits: FitState) -> Derivatives:
    """Likelihood, gradient and Fisher information of every window at `fits`."""
    count, windows = fits.state.shape[:2]
    problem = linear_problem(models, fits)
    loads, noise = _noises(models[0], fits, problem)
    rows = models[0].rows
    # The same draws for every fit.
    drawn = torch.randn(rows.used.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    drawn = drawn.repeat(count, 1, 1)
    each = zip(models, fits.theta, strict=True)
    used = torch.cat([model.shown(theta[: len(model.table)])[1] for model, theta in each])
    # Late readings that show no state of the windows count as much as an average one of their sensor in the second half
    # of the windows, where the prior of the first state does not matter any more: sets of effects are compared by the
    # likelihood of the same readings.
    later = used * (torch.arange(used.shape[1]) >= used.shape[1] // 2)[:, None]
    lost = rows.used.sum((0, 1)) - used.unflatten(0, (count, windows)).sum((1, 2))
    share = lost / later.unflatten(0, (count, windows)).sum((1, 2)).clamp_min(1)
    counted = used + later * share.repeat_interleave(windows, 0)[:, None]
    members = noise_members(models[0])
    at_once = max(1, ROWS_AT_ONCE // fits.state.shape[2])
    parts = []
    for first in range(0, count * windows, at_once):
        at = slice(first, first + at_once)
        systems = problem[at], loads[at], noise[at], used[at], counted[at], drawn[at]
        parts.append(_of_systems(*systems, members, rows.colour))
    return Derivatives(*(torch.cat(each).unflatten(0, (count, windows)) for each in zip(*parts, strict=True)))


def _of_systems(
    problem: Linear,
    loads: LoadNoise,
    noise: Tensor,
    used: Tensor,
    counted: Tensor,
    drawn: Tensor,
    members: tuple[Tensor, Tensor],
    colour: Colour | None,
) -> tuple[Tensor, ...]:
    """The fields of `Derivatives` for N linear systems.

    Args:
        used: (N, T, m) 1 where there is a reading; `counted` is its weight in the likelihood.
        drawn: (N, T, m) standard normal.
        colour: of the innovations, which states the noise: its derivatives are then 0. None: they are white.
    """
    here = forward(problem, loads.covariance(), noise)
    errors = whitened(here.white, colour)
    error, columns = errors.flatten(1, 2).tensor_split([1], -1)
    likelihood = log_likelihood(replace(here, white=errors), counted)
    if colour is None:
        adjoint, information, score = _by_noise(here, loads, noise, used, drawn, members)
    else:
        likelihood = likelihood + colour.log_density(counted.mean(2))
        adjoint = adjoints(here, here.white)
        score = likelihood.new_zeros(len(likelihood), len(members[0]))
        information = torch.diag_embed(score)
    smoothed = here.predicted - here.covariance @ adjoint
    return likelihood, columns.mT @ columns, -(columns.mT @ error)[..., 0], information, score, smoothed


def _by_noise(
    here: Filtered,
    loads: LoadNoise,
    noise: Tensor,
    used: Tensor,
    drawn: Tensor,
    members: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """The adjoints (N, T, n, 1 + K), and the Fisher information (N, G + S, G + S) of the log variances with the
    derivatives (N, G + S) of the log likelihood by them."""
    # Average information of the log variances (Gilmour, Thompson and Cullis 1995, Biometrics 51(4)): that of inputs
    # equal to the smoothed noises of one group. It is the mean of two: from the recorded data and from data drawn from
    # the model. Far from the optimum the recorded data are unlike the model and alone would give too long steps.
    white = torch.cat((here.white, (drawn * used)[..., None]), -1)
    adjoint = adjoints(here, white)
    both = [0, -1]
    of_both = adjoint[..., both]
    weight = weights(here, white[..., both], of_both)
    driven, measured = members
    by_process, by_noise = noise_scores(here, of_both[..., 0], weight[..., 0], loads.directions, loads.variance, noise)
    score = by_process.sum(1) @ driven.T + (by_noise * used).sum(1) @ measured.T
    # What inputs add to the states is subtracted from the readings.
    by_group = loads.smoothed(of_both).mT[..., None] * driven.T
    drive = (loads.directions[:, :, None] @ by_group).movedim(2, 3)
    reading = (noise[:, None, :, None] * weight)[..., None] * measured.T[:, None]
    working = respond(here, drive.flatten(-2), reading.flatten(-2)).flatten(1, 2)
    working = working.unflatten(-1, (2, len(driven))).flatten(1, 2)
    return adjoint[..., :-1], 0.25 * working.mT @ working, score

"""Kalman filter and smoother of linear systems in a batch, each with several columns of inputs.

    x_{t+1} = A_t x_t + c_t + w_t,   w_t ~ N(0, Q_t)            x_0 ~ N(0, diag(p))
    r_t     = H_t x_t + v_t,         v_t ~ N(0, diag(s))

Kalman (1960, J. Basic Eng. 82(1)) forwards, with a Cholesky factor of the innovations' covariance, so that a channel's
innovation and variance are those given the channels before it; backwards the adjoint form of Bryson and Frazier (1963),
which inverts no covariance and so also holds without process noise. c and r have M columns: the first is the data, the
others are derivatives of it (sensitivities), which pass through the same gains.

The gains do not depend on c and r. So only the covariances are computed row after row in full. With L the factor of
the innovations' covariance and e = L^-1 (r - H x), all means and adjoints then follow from one product per row:

    x_{t+1} = F_t x_t + c_t + J_t L^-1 r_t      F = A - J L^-1 H,  J = A P H' L^-T
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.batch import Batch


@dataclass(frozen=True)
class Linear(Batch):
    """N systems over T rows with n states and m channels."""

    transition: Tensor  # (N, T - 1, n, n) A
    drive: Tensor  # (N, T - 1, n, M) c
    sensing: Tensor  # (N, T, m, n) H; zero where nothing was measured
    reading: Tensor  # (N, T, m, M) r; zero where nothing was measured
    start: Tensor  # (N, n, M) the mean of x_0
    initial_variance: Tensor  # (N, n) p

    def data(self) -> Linear:
        """The same systems with the first column, the data, alone."""
        return replace(self, drive=self.drive[..., :1], reading=self.reading[..., :1], start=self.start[..., :1])


@dataclass(frozen=True)
class Filtered:
    """The result of the forward pass."""

    covariance: Tensor  # (N, T, n, n) P of x_t given rows before t
    whitening: Tensor  # (N, T, m, m) L^-1
    sensing: Tensor  # (N, T, m, n) L^-1 H
    injection: Tensor  # (N, T - 1, n, m) J
    closed_loop: Tensor  # (N, T - 1, n, n) F
    predicted: Tensor  # (N, T, n, M) x_t given rows before t
    white: Tensor
    """(N, T, m, M) e: innovation of each channel, given all earlier rows and the earlier channels of its row, over its
    standard deviation"""

    @property
    def deviation(self) -> Tensor:
        """(N, T, m) standard deviations of the innovations."""
        return 1 / self.whitening.diagonal(dim1=-2, dim2=-1)


def forward(problem: Linear, process: Tensor, noise: Tensor) -> Filtered:
    """Filter with process covariances Q (N, T - 1, n, n) and measurement variances s (N, m)."""
    covariance = torch.diag_embed(problem.initial_variance)
    disturbed = torch.diag_embed(noise)
    transitions, sensings, disturbances = (each.unbind(1) for each in (problem.transition, problem.sensing, process))
    covariances, roots, crosses, failures = [], [], [], []
    for t, sensing in enumerate(sensings):
        if t:
            a = transitions[t - 1]
            covariance = torch.baddbmm(disturbances[t - 1], torch.bmm(a, covariance), a.mT)
            # No reading damps rounding errors that are not symmetric: in an unstable system they would grow.
            covariance = (covariance + covariance.mT) / 2
        seen = torch.bmm(sensing, covariance)
        root, failed = torch.linalg.cholesky_ex(torch.baddbmm(disturbed, seen, sensing.mT))
        cross = torch.linalg.solve_triangular(root, seen, upper=False)
        covariances.append(covariance)
        roots.append(root)
        crosses.append(cross)
        failures.append(failed)
        covariance = torch.baddbmm(covariance, cross.mT, cross, alpha=-1)
    # After too large a step of a fit the covariance may be indefinite: the likelihood is NaN, the step rejected.
    root = torch.where(torch.stack(failures, 1)[..., None, None] > 0, math.nan, torch.stack(roots, 1))
    identity = torch.eye(noise.shape[1], dtype=noise.dtype, device=noise.device).expand_as(root)
    right = torch.cat((identity, problem.sensing), -1)
    whitening, sensing = torch.linalg.solve_triangular(root, right, upper=False).split(
        (noise.shape[1], covariance.shape[1]), -1
    )
    injection = problem.transition @ torch.stack(crosses, 1)[:, :-1].mT
    closed_loop = problem.transition - injection @ sensing[:, :-1]
    reading = whitening @ problem.reading
    predicted, white = _means(sensing, injection, closed_loop, problem.drive, reading, problem.start)
    return Filtered(torch.stack(covariances, 1), whitening, sensing, injection, closed_loop, predicted, white)


def respond(filtered: Filtered, drive: Tensor, reading: Tensor) -> Tensor:
    """Change of the white innovations (N, T, m, M) with inputs `drive` (N, T - 1, n, M) and `reading` (N, T, m, M),
    either of which may have one column for all, under the gains of the filter run that gave `filtered`."""
    gains = filtered.sensing, filtered.injection, filtered.closed_loop
    start = drive.new_zeros(*drive[:, 0, :, 0].shape, max(drive.shape[-1], reading.shape[-1]))
    return _means(*gains, drive, filtered.whitening @ reading, start)[1]


def _means(
    sensing: Tensor, injection: Tensor, closed_loop: Tensor, drive: Tensor, reading: Tensor, start: Tensor
) -> tuple[Tensor, Tensor]:
    """Predicted states and white innovations under known gains; `sensing` and `reading` are whitened."""
    inputs = (drive + injection @ reading[:, :-1]).unbind(1)
    means = [start]
    for loop, each in zip(closed_loop.unbind(1), inputs, strict=True):
        means.append(torch.baddbmm(each, loop, means[-1]))
    predicted = torch.stack(means, 1)
    return predicted, reading - sensing @ predicted


def backward(filtered: Filtered) -> tuple[Tensor, Tensor]:
    """Smoothed states (N, T, n, M), and adjoints (N, T, n, M): -Q_(t-1) times the adjoint of row t is the smoothed
    process noise w_(t-1), of the step that leads to row t."""
    adjoint = adjoints(filtered, filtered.white)
    return filtered.predicted - filtered.covariance @ adjoint, adjoint


def adjoints(filtered: Filtered, white: Tensor) -> Tensor:
    """Adjoints (N, T, n, M) of readings with these white innovations (N, T, m, M)."""
    inputs = (-filtered.sensing.mT @ white).unbind(1)
    out = [inputs[-1]]
    for loop, each in zip(reversed(filtered.closed_loop.unbind(1)), reversed(inputs[:-1]), strict=True):
        out.append(torch.baddbmm(each, loop.mT, out[-1]))
    return torch.stack(out[::-1], 1)


def weights(filtered: Filtered, white: Tensor, adjoint: Tensor) -> Tensor:
    """Smoothed measurement noises v (N, T, m, M) over their variances, given the white innovations' `adjoints`."""
    left = white.clone()
    left[:, :-1] += filtered.injection.mT @ adjoint[:, 1:]
    return filtered.whitening.mT @ left


def noise_scores(
    filtered: Filtered, adjoint: Tensor, weight: Tensor, directions: Tensor, process: Tensor, noise: Tensor
) -> tuple[Tensor, Tensor]:
    """Derivatives of the log likelihood by the logs of the noises' variances.

    A variance is too small where the square of a smoothed noise exceeds what is expected of it under that variance
    (Koopman and Shephard 1992, Biometrika 79(4)).

    Args:
        filtered: a filter run with the variances `process` (N, L) of uncorrelated process noises, which enter the
            states by `directions` (N, T - 1, n, L), and `noise` (N, m) of the measurements.
        adjoint, weight: (N, T, n) and (N, T, m) of the data.

    Returns:
        The derivatives by each process noise before each row but the first, (N, T - 1, L), and by each measurement
        noise, (N, T, m), which are -1/2 where nothing was measured.
    """
    own = (filtered.sensing.mT @ filtered.sensing).unbind(1)
    covariances = [own[-1]]  # of the adjoints
    for loop, each in zip(reversed(filtered.closed_loop.unbind(1)), reversed(own[1:-1]), strict=False):
        covariances.append(torch.baddbmm(each, torch.bmm(loop.mT, covariances[-1]), loop))
    covariance = torch.stack(covariances[::-1], 1)
    by_process = (directions * adjoint[:, 1:, :, None]).sum(-2).square()
    by_process = by_process - (directions * (covariance @ directions)).sum(-2)
    # The variance of the weights: of the row's own innovation, and of the rows after.
    injected = filtered.injection @ filtered.whitening[:, :-1]
    variance = filtered.whitening.square().sum(-2)
    variance[:, :-1] += (injected * (covariance @ injected)).sum(-2)
    by_noise = weight.square() - variance
    return 0.5 * process[:, None] * by_process, 0.5 * noise[:, None] * by_noise


def log_likelihood(filtered: Filtered, used: Tensor) -> Tensor:
    """(N,) of the first column; `used` (N, T, m) is 0 where nothing was measured, else the reading's weight."""
    terms = filtered.white[..., 0].square() + 2 * filtered.deviation.log() + math.log(2 * math.pi)
    return -0.5 * (terms * used).sum((1, 2))

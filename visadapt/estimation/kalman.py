"""Kalman filter and smoother of linear systems in a batch, each with several columns of inputs.

    x_{t+1} = A_t x_t + c_t + w_t,   w_t ~ N(0, Q)              x_0 ~ N(0, diag(p))
    r_t     = H_t x_t + v_t,         v_t ~ N(0, diag(s))

Kalman (1960, J. Basic Eng. 82(1)) forwards, with a Cholesky factor of the innovations' covariance, so that a channel's
innovation and variance are those given the channels before it; backwards the adjoint form of Bryson and Frazier (1963),
which inverts no covariance and so also holds without process noise. c and r have M columns: the first is the data, the
others are derivatives of it (sensitivities), which pass through the same gains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Linear:
    """N systems over T rows with n states and m channels."""

    transition: Tensor  # (N, T - 1, n, n) A
    drive: Tensor  # (N, T - 1, n, M) c
    sensing: Tensor  # (N, T, m, n) H; zero where nothing was measured
    reading: Tensor  # (N, T, m, M) r; zero where nothing was measured
    start: Tensor  # (N, n, M) the mean of x_0
    spread: Tensor  # (n,) p

    def data(self) -> Linear:
        """The same systems with the first column, the data, alone."""
        return replace(self, drive=self.drive[..., :1], reading=self.reading[..., :1], start=self.start[..., :1])

    def repeat(self, count: int) -> Linear:
        """`count` copies of the N systems."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "spread"}
        return replace(self, **{name: x.repeat(count, *(1,) * (x.dim() - 1)) for name, x in tensors.items()})


@dataclass(frozen=True)
class Filtered:
    """The result of the forward pass."""

    predicted: list[Tensor]  # T of (N, n, M): x_t given rows before t
    covariance: list[Tensor]  # T of (N, n, n): its covariance
    root: list[Tensor]  # T of (N, m, m): lower factors of the innovations' covariances
    cross: list[Tensor]  # T of (N, m, n): change of the states per unit of a whitened innovation
    innovation: Tensor  # (N, T, m, M) of each channel, given the rows before and the channels before it
    variance: Tensor  # (N, T, m) variances of the innovations

    @property
    def white(self) -> Tensor:
        """(N, T, m, M) innovations over their standard deviations."""
        return self.innovation / self.variance.sqrt()[..., None]


def forward(problem: Linear, process: Tensor, noise: Tensor) -> Filtered:
    """Filter with process covariances Q (N, n, n) and measurement variances s (N, m)."""
    rows = problem.reading.shape[1]
    mean = problem.start
    covariance = torch.diag_embed(problem.spread.expand(len(mean), -1))
    n = covariance.shape[-1]
    disturbed = torch.diag_embed(noise)
    predicted, covariances, roots, crosses, innovations, variances = [], [], [], [], [], []
    for t in range(rows):
        if t:
            a = problem.transition[:, t - 1]
            mean = torch.baddbmm(problem.drive[:, t - 1], a, mean)
            covariance = torch.baddbmm(process, torch.bmm(a, covariance), a.mT)
            # No reading damps rounding errors that are not symmetric: in an unstable system they would grow.
            covariance = (covariance + covariance.mT) / 2
        predicted.append(mean)
        covariances.append(covariance)
        sensing = problem.sensing[:, t]
        seen = torch.bmm(sensing, covariance)
        root, failed = torch.linalg.cholesky_ex(torch.baddbmm(disturbed, seen, sensing.mT))
        # After too large a step of a fit the covariance may be indefinite: the likelihood is NaN, the step rejected.
        root = torch.where(failed[:, None, None] > 0, math.nan, root)
        error = torch.baddbmm(problem.reading[:, t], sensing, mean, alpha=-1)
        cross, white = torch.linalg.solve_triangular(root, torch.cat((seen, error), -1), upper=False).split(
            (n, error.shape[-1]), -1
        )
        mean = torch.baddbmm(mean, cross.mT, white)
        covariance = torch.baddbmm(covariance, cross.mT, cross, alpha=-1)
        deviation = root.diagonal(dim1=1, dim2=2)
        roots.append(root)
        crosses.append(cross)
        innovations.append(white * deviation[..., None])
        variances.append(deviation.square())
    return Filtered(predicted, covariances, roots, crosses, torch.stack(innovations, 1), torch.stack(variances, 1))


def respond(problem: Linear, filtered: Filtered, drive: Tensor, reading: Tensor) -> Tensor:
    """Change of the innovations (N, T, m, M) with inputs `drive` (N, T - 1, n, M) and `reading` (N, T, m, M), under the
    gains of the filter run that gave `filtered`."""
    mean = torch.zeros_like(drive[:, 0])
    out = []
    for t in range(reading.shape[1]):
        if t:
            mean = torch.baddbmm(drive[:, t - 1], problem.transition[:, t - 1], mean)
        error = torch.baddbmm(reading[:, t], problem.sensing[:, t], mean, alpha=-1)
        white = torch.linalg.solve_triangular(filtered.root[t], error, upper=False)
        mean = torch.baddbmm(mean, filtered.cross[t].mT, white)
        out.append(white * filtered.root[t].diagonal(dim1=1, dim2=2)[..., None])
    return torch.stack(out, 1)


def backward(problem: Linear, filtered: Filtered) -> tuple[Tensor, Tensor]:
    """Smoothed states (N, T, n, M), and adjoints (N, T, n, M): minus Q times them is the smoothed w before row t."""
    white = filtered.white
    adjoint = torch.zeros_like(problem.start)
    states, adjoints = [], []
    for t in reversed(range(white.shape[1])):
        along = torch.baddbmm(white[:, t], filtered.cross[t], adjoint)
        weight = torch.linalg.solve_triangular(filtered.root[t].mT, along, upper=True)
        adjoint = torch.baddbmm(adjoint, problem.sensing[:, t].mT, weight, alpha=-1)
        states.append(filtered.predicted[t] - torch.bmm(filtered.covariance[t], adjoint))
        adjoints.append(adjoint)
        if t:
            adjoint = torch.bmm(problem.transition[:, t - 1].mT, adjoint)
    return torch.stack(states[::-1], 1), torch.stack(adjoints[::-1], 1)


def log_likelihood(filtered: Filtered, used: Tensor) -> Tensor:
    """(N,) of the first column; `used` (N, T, m) is 1 where something was measured."""
    square = filtered.innovation[..., 0].square() / filtered.variance
    terms = square + filtered.variance.log() + math.log(2 * math.pi)
    return -0.5 * (terms * used).sum((1, 2))

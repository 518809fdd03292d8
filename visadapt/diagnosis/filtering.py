"""Likelihood and smoothed states of a linear system that is driven by columns of inputs, many systems at once.

    x_{t+1} = A_t x_t + c_t + w_t,   w_t ~ N(0, diag(q))        x_0 ~ N(0, diag(p))
    r_t     = H_t x_t + v_t,         v_t ~ N(0, diag(s))

Kalman (1960, J. Basic Eng. 82(1)) forwards, one channel after the other; backwards the adjoint form of Bryson and
Frazier (1963), which inverts nothing, so that it also holds where there is no process noise. c and r have M columns:
the first is the data, the others are sensitivities, which pass through the same gains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Linear:
    """N systems over T rows with n states and m channels."""

    transition: Tensor
    """(N, T - 1, n, n) A"""
    drive: Tensor
    """(N, T - 1, n, M) c"""
    sensing: Tensor
    """(N, T, m, n) H; zero where nothing was measured"""
    reading: Tensor
    """(N, T, m, M) r; zero where nothing was measured"""
    start: Tensor
    """(N, n, M) the mean of x_0"""
    spread: Tensor
    """(n,) p"""

    def data(self) -> Linear:
        """Without the sensitivities."""
        return replace(self, drive=self.drive[..., :1], reading=self.reading[..., :1], start=self.start[..., :1])


@dataclass(frozen=True)
class Filtered:
    """The forward pass: everything the backward pass needs, and the whitened innovations."""

    predicted: list[Tensor]
    """T of (N, n, M): x_t given rows before t"""
    covariance: list[Tensor]
    """T of (N, n, n): its covariance"""
    gain: list[list[Tensor]]
    """T x m of (N, n)"""
    innovation: Tensor
    """(N, T, m, M)"""
    variance: Tensor
    """(N, T, m) of the innovations"""

    @property
    def white(self) -> Tensor:
        """(N, T, m, M) innovations over their standard deviations."""
        return self.innovation / self.variance.sqrt()[..., None]


def forward(problem: Linear, process: Tensor, noise: Tensor) -> Filtered:
    """Filter with process variances q (N, n) and measurement variances s (N, m)."""
    rows, channels = problem.reading.shape[1:3]
    mean = problem.start
    covariance = torch.diag_embed(problem.spread.expand(len(mean), -1))
    added = torch.diag_embed(process)
    predicted, covariances, gains, innovations, variances = [], [], [], [], []
    for t in range(rows):
        if t:
            a = problem.transition[:, t - 1]
            mean = torch.baddbmm(problem.drive[:, t - 1], a, mean)
            covariance = torch.baddbmm(added, torch.bmm(a, covariance), a.mT)
        predicted.append(mean)
        covariances.append(covariance)
        here = []
        for k in range(channels):
            row = problem.sensing[:, t, k]
            seen = torch.bmm(covariance, row[..., None])[..., 0]
            variance = (row * seen).sum(-1) + noise[:, k]
            gain = seen / variance[:, None]
            innovation = problem.reading[:, t, k] - torch.bmm(row[:, None], mean)[:, 0]
            mean = mean + gain[..., None] * innovation[:, None]
            covariance = covariance - gain[..., None] * seen[:, None]
            here.append(gain)
            innovations.append(innovation)
            variances.append(variance)
        gains.append(here)
    shape = (len(mean), rows, channels)
    return Filtered(
        predicted,
        covariances,
        gains,
        torch.stack(innovations, 1).reshape(*shape, -1),
        torch.stack(variances, 1).reshape(shape),
    )


def respond(problem: Linear, filtered: Filtered, drive: Tensor, reading: Tensor) -> Tensor:
    """Innovations (W, T, m, M) of inputs that pass through the gains of a filter that has run."""
    mean = torch.zeros_like(drive[:, 0])
    out = []
    for t in range(reading.shape[1]):
        if t:
            mean = torch.baddbmm(drive[:, t - 1], problem.transition[:, t - 1], mean)
        for k, gain in enumerate(filtered.gain[t]):
            innovation = reading[:, t, k] - torch.bmm(problem.sensing[:, t, k, None], mean)[:, 0]
            mean = mean + gain[..., None] * innovation[:, None]
            out.append(innovation)
    return torch.stack(out, 1).reshape(reading.shape)


def backward(problem: Linear, filtered: Filtered) -> tuple[Tensor, Tensor]:
    """Smoothed states (N, T, n, M), and adjoints (N, T, n, M): minus q times them is the smoothed w before row t."""
    rows, channels = problem.reading.shape[1:3]
    adjoint = torch.zeros_like(problem.start)
    states, adjoints = [], []
    for t in reversed(range(rows)):
        for k in reversed(range(channels)):
            row = problem.sensing[:, t, k]
            along = (filtered.gain[t][k][..., None] * adjoint).sum(1, keepdim=True)
            weight = along + (filtered.innovation[:, t, k] / filtered.variance[:, t, k, None])[:, None]
            adjoint = adjoint - row[..., None] * weight
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

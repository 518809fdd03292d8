"""Fixed-interval smoothing of a linear system with Gaussian noise whose intensities are fitted to the data.

    z_{t+1} = A_t z_t + b_t + w_t,     w_t ~ N(0, sum_d q_d^2 Q_d)      z_0 ~ N(0, P)
    y_t     = z_t[observed] + v_t,     v_t ~ N(0, c^2 R_t)

Kalman (1960, J. Basic Eng. 82(1)) forwards; Rauch, Tung and Striebel (1965, AIAA Journal 3(8)) backwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

CENTRE, WIDTH = -1.0, 1.5
"""Prior of log10 q: normal."""

NOISE_CENTRE, NOISE_WIDTH = 0.5, 0.5
"""Prior of log10 c: errors of pixels are not white, so the fit of a frame is too sure of itself."""

ROUNDS = 12
"""At most so many times, all neighbours of the best noise so far, a step up or down in every parameter, are tried."""

FINEST = 0.15
"""The search ends when steps of so many deviations of the prior lead nowhere."""


@dataclass(frozen=True)
class Problem:
    """One episode of T rows, N entries of z; all in float64."""

    transition: Tensor
    """(T - 1, N, N) A"""
    offset: Tensor
    """(T - 1, N) b"""
    observed: list[int]
    """M entries of z that are measured"""
    value: Tensor
    """(T, M) y"""
    noise: Tensor
    """(T, M, M) R"""
    used: Tensor
    """(T,) rows whose measurement counts"""
    drift: Tensor
    """(D, N, N) Q"""
    start: Tensor
    """(N, N) P"""


@dataclass(frozen=True)
class Noise:
    """Intensities q (D,) and c (), the factor on the deviation of the measurements; or K candidates of both."""

    drift: Tensor
    measurement: Tensor


@dataclass(frozen=True)
class Path:
    """Mean (T, N) and covariance (T, N, N) of z given all measurements."""

    mean: Tensor
    covariance: Tensor


def likeliest(problems: Sequence[Problem], guess: Noise | None = None) -> Noise:
    """The noise of the largest posterior density over all problems, by a pattern search (Hooke and Jeeves 1961)."""
    width = len(problems[0].drift)
    middle = torch.tensor([CENTRE] * width + [NOISE_CENTRE], dtype=torch.float64)
    spread = torch.tensor([WIDTH] * width + [NOISE_WIDTH], dtype=torch.float64)
    pattern = torch.cartesian_prod(*[torch.tensor([0.0, -1.0, 1.0], dtype=torch.float64)] * (width + 1))
    best = middle if guess is None else torch.cat((guess.drift, guess.measurement[None])).log10()
    step = 0.8 if guess is None else 2 * FINEST
    for _ in range(ROUNDS):
        # No further than 3 deviations: beyond, a noise is as good as none, and rounding decides.
        candidates = middle + ((best - middle) / spread + step * pattern).clamp(-3, 3) * spread
        score = -0.5 * ((candidates - middle) / spread).square().sum(1)
        noise = Noise(10 ** candidates[:, :-1], 10 ** candidates[:, -1])
        for problem in problems:
            score = score + _filter(problem, noise)[0]
        winner = int(score.nan_to_num(nan=-math.inf).argmax())
        best = candidates[winner]
        if winner == 0:
            step /= 2
        if step < FINEST:
            break
    return Noise(10 ** best[:-1], 10 ** best[-1])


def smooth(problem: Problem, noise: Noise) -> Path:
    """The most probable path and its covariance."""
    _, means, covariances = _filter(problem, Noise(noise.drift[None], noise.measurement[None]), keep=True)
    mean, covariance = [means[-1][0]], [covariances[-1][0]]
    drift, identity = _drift(problem, noise), torch.eye(len(problem.start), dtype=torch.float64)
    for t in range(len(problem.transition) - 1, -1, -1):
        step, here = problem.transition[t], covariances[t][0]
        ahead = step @ here @ step.T + drift
        # A pseudo-inverse of a scaled matrix: where a load does not drift, and is known, `ahead` is all but singular.
        scale = ahead.diagonal().clamp(min=1e-300).sqrt()
        inverse = torch.linalg.pinv(ahead / scale / scale[:, None], hermitian=True, rtol=1e-12) / scale / scale[:, None]
        gain = here @ step.T @ inverse
        mean.append(means[t][0] + gain @ (mean[-1] - step @ means[t][0] - problem.offset[t]))
        # Equal to here + gain (covariance - ahead) gain', but a sum of squares: rounding leaves it a covariance.
        kept = identity - gain @ step
        covariance.append(kept @ here @ kept.T + gain @ (covariance[-1] + drift) @ gain.T)
    return Path(torch.stack(mean[::-1]), torch.stack(covariance[::-1]))


def _drift(problem: Problem, noise: Noise) -> Tensor:
    """Covariance (..., N, N) of w_t."""
    return torch.einsum("...d,dij->...ij", noise.drift.square(), problem.drift)


def _filter(problem: Problem, noise: Noise, keep: bool = False) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    """Log-likelihood (K,) of K candidates, and if asked for the filtered means (K, N) and covariances, row by row."""
    count, n = len(noise.drift), len(problem.start)
    mean = problem.start.new_zeros(count, n, 1)
    covariance = problem.start.expand(count, n, n)
    drift = _drift(problem, noise)
    variance = noise.measurement.square()[:, None, None]
    likelihood = problem.start.new_zeros(count)
    identity = torch.eye(n, dtype=mean.dtype)
    picks = identity[problem.observed]
    means, covariances = [], []
    for t in range(len(problem.value)):
        if t:
            step = problem.transition[t - 1]
            mean = step @ mean + problem.offset[t - 1][:, None]
            covariance = step @ covariance @ step.T + drift
        if bool(problem.used[t]):
            # Joseph's form (Bucy and Joseph 1968), which stays a covariance whatever rounding does: an unstable system
            # that was out of sight for long is measured 1e10 times better than predicted.
            spread = variance * problem.noise[t]
            total = covariance[:, problem.observed][:, :, problem.observed] + spread
            total = total + torch.diag_embed(1e-13 * total.diagonal(dim1=1, dim2=2))
            factor = torch.linalg.cholesky_ex(total).L
            gain = torch.cholesky_solve(covariance[:, problem.observed], factor).transpose(1, 2)
            surprise = problem.value[t][:, None] - mean[:, problem.observed]
            error = torch.linalg.solve_triangular(factor, surprise, upper=False)
            kept = identity - gain @ picks
            mean = mean + gain @ surprise
            covariance = kept @ covariance @ kept.transpose(1, 2) + gain @ spread @ gain.transpose(1, 2)
            likelihood = (
                likelihood
                - 0.5 * error.square().sum((1, 2))
                - factor.diagonal(dim1=1, dim2=2).log().sum(1)
                - 0.5 * len(problem.observed) * math.log(2 * math.pi)
            )
        if keep:
            means.append(mean[..., 0])
            covariances.append(covariance)
    return likelihood, means, covariances

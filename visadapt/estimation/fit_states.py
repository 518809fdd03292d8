"""Fit states made from others: the start of a fit, a set with one more effect, several sets in one batch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.effects import Effect
from visadapt.estimation.candidate import COARSE, FINE
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments, initial_states, noise_of_readings, unmeasured
from visadapt.systems import System

Effects = tuple[type[Effect], ...]

QUICK, CAREFUL, FINAL = (12, COARSE), (20, FINE), (7, FINE)
"""Iterations and integration accuracy of a fit. QUICK: during the search. CAREFUL: results that are reported. FINAL:
refit to all rows, starting from a CAREFUL fit to some of them."""


GUESSED_NOISE = 0.01  # Standard deviation of readings, in their unit, with which the source's fit starts


def initial_fit(system: System, rows: Segments) -> FitState:
    """The start of the source's own fit (no effects): states from the measurements, guessed noise."""
    state = initial_states(rows, system)[None]
    noise = torch.full((len(rows.channels),), GUESSED_NOISE**2, dtype=torch.float64)
    if unmeasured(rows, system):
        # What is unknown follows readings that are believed too much.
        noise = torch.maximum(noise, noise_of_readings(rows))
    return FitState(
        torch.zeros(1, 0, dtype=torch.float64),
        state,
        torch.full((1, len(profile_of(system).driven)), math.log(0.2**2), dtype=torch.float64),
        noise.log()[None],
        torch.full((1,), -math.inf, dtype=torch.float64),
        torch.zeros(1, 0, 0, dtype=torch.float64),
    )


START_LOG_NOISE = math.log(0.003**2)
"""Least log variance of a measurement, in its unit squared, with which a fit with one more effect starts. Without the
effect, a fit may have taken readings of positions as free of noise, which those of velocities do not contradict: the
likelihood has a second maximum there."""


def with_effect(base: FitState, values: Sequence[float]) -> FitState:
    """A start for the set of `base` with one more effect, which has these parameter values."""
    theta = torch.cat((base.theta, torch.tensor([list(values)], dtype=torch.float64)), 1)
    return replace(base, theta=theta, log_noise=base.log_noise.clamp(min=START_LOG_NOISE))


def neutral(effect: type[Effect]) -> tuple[float, ...]:
    """Parameter values without any effect; for a parameter that has no such value, the middle of its range."""
    return tuple(p.neutral if p.neutral is not None else 0.5 * (p.low + p.high) for p in effect.table)


def stacked(fits: Sequence[FitState]) -> FitState:
    """Fits of one set each as one batch, with unknown likelihood and information."""
    widest = max(f.theta.shape[1] for f in fits)
    theta = torch.zeros(len(fits), widest, dtype=torch.float64)
    for k, each in enumerate(fits):
        theta[k, : each.theta.shape[1]] = each.theta[0]
    rest = [torch.cat([getattr(f, name) for f in fits]) for name in ("state", "log_process", "log_noise")]
    unknown = torch.full((len(fits),), -math.inf, dtype=torch.float64)
    return FitState(theta, rest[0], rest[1], rest[2], unknown, torch.zeros(len(fits), widest, widest).double())


def single_fit(fits: FitState, index: int, count: int) -> FitState:
    """The fit of one set of a batch, without the padding of its `count` parameters."""
    one = fits[torch.tensor([index])]
    return replace(one, theta=one.theta[:, :count], information=one.information[:, :count, :count])


def widths(effects: Effects) -> Tensor:
    """(K,) widths of the ranges in which the parameters of a set are searched."""
    return torch.tensor([p.high - p.low for e in effects for p in e.table], dtype=torch.float64)


def posterior(effects: Effects, fits: FitState) -> tuple[Tensor, Tensor]:
    """Prior precision (K,) of a set's parameters, uniform in their ranges, and posterior precision (K, K)."""
    precision = 12 / widths(effects).square()
    return precision, fits.information[0] + torch.diag(precision)

"""Fit states made from others: where a fit starts, one effect more, several sets in one batch, and what it found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.effects import Effect
from visadapt.estimation.candidate import COARSE, FINE
from visadapt.estimation.likelihood import FitState, rough
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

Effects = tuple[type[Effect], ...]

QUICK, CAREFUL = (8, COARSE), (20, FINE)
"""Iterations and effort of a fit that only has to show promise, and of one whose figures are reported."""


def first_fits(system: System, rows: Segments) -> FitState:
    """A start for the source as it stands."""
    state = rough(rows, system)[None]
    return FitState(
        torch.zeros(1, 0, dtype=torch.float64),
        state,
        torch.full((1, len(profile_of(system).driven)), math.log(0.2**2), dtype=torch.float64),
        torch.full((1, len(rows.channels)), math.log(0.01**2), dtype=torch.float64),
        torch.full((1,), -math.inf, dtype=torch.float64),
        torch.zeros(1, 0, 0, dtype=torch.float64),
    )


def extended(base: FitState, values: Sequence[float]) -> FitState:
    """The fit of one set as a start for that set with one effect more, which has these parameters."""
    theta = torch.cat((base.theta, torch.tensor([list(values)], dtype=torch.float64)), 1)
    return replace(base, theta=theta)


def neutral(effect: type[Effect]) -> tuple[float, ...]:
    """Parameters with which an effect does nothing; in the middle of its range, where none of a parameter's does."""
    return tuple(p.neutral if p.neutral is not None else 0.5 * (p.low + p.high) for p in effect.table)


def joined(fits: Sequence[FitState]) -> FitState:
    """Fits of one set each as fits of many."""
    widest = max(f.theta.shape[1] for f in fits)
    theta = torch.zeros(len(fits), widest, dtype=torch.float64)
    for k, each in enumerate(fits):
        theta[k, : each.theta.shape[1]] = each.theta[0]
    rest = [torch.cat([getattr(f, name) for f in fits]) for name in ("state", "log_process", "log_noise")]
    unknown = torch.full((len(fits),), -math.inf, dtype=torch.float64)
    return FitState(theta, rest[0], rest[1], rest[2], unknown, torch.zeros(len(fits), widest, widest).double())


def only(fits: FitState, number: int, count: int) -> FitState:
    """Of fits of many sets, that of one, which has `count` parameters."""
    own = fits.of(torch.tensor([number]))
    return replace(own, theta=own.theta[:, :count], information=own.information[:, :count, :count])


def widths(effects: Effects) -> Tensor:
    """(K,) of the ranges in which the parameters of a set are searched."""
    return torch.tensor([p.high - p.low for e in effects for p in e.table], dtype=torch.float64)


def posterior(effects: Effects, fits: FitState) -> tuple[Tensor, Tensor]:
    """Precision of a set's parameters: (K,) before the data, that of their ranges, and (K, K) with them."""
    precision = 12 / widths(effects).square()
    return precision, fits.information[0] + torch.diag(precision)

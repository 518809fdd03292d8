"""Estimates of states without a sensor, such as the heading of a vehicle of which positions alone were recorded.

A fit improves states that are nearly right; of a state without a reading nothing says where it is. So the source is
filtered through each window from several values of these states (extended Kalman filters in a batch), and the filter
that foresees the readings best gives the estimate from which fits start. Filters that believe the source much tell
forwards from backwards; those that believe it little follow a machine that differs from it. So several are tried.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.estimation.candidate import COARSE, CandidateModel
from visadapt.estimation.fitting import LEAST_NOISE
from visadapt.estimation.linearise import linearise_step
from visadapt.estimation.segments import Segments, initial_states, noise_of_readings, unmeasured
from visadapt.systems import System

STARTS = 32  # Values of the states without a reading from which a window is filtered: 0, and others within their ranges

DOUBTS = ((3e-4, 3e-4), (3e-3, 1e-3), (3e-2, 1e-2))
"""How little the source is believed: standard deviations, in each row, of the process noise of the velocities, and of a
state without a reading beside what the source says, as shares of the largest sizes in their ranges."""

WINDOWS_AT_ONCE = 24  # Windows that are filtered together, so that memory is bounded

READING_NOISE = 2.0  # Variance of the readings' noise in these filters, over that which `noise_of_readings` estimates


def with_unmeasured(rows: Segments, system: System) -> Segments:
    """The rows with estimates of the states that were not measured, if there are any."""
    columns = unmeasured(rows, system)
    if not columns:
        return rows
    least = torch.tensor([LEAST_NOISE * system.states[k].scale for k in rows.channels], dtype=torch.float64)
    noise = torch.maximum(READING_NOISE * noise_of_readings(rows), least.square())
    parts = [rows.select(windows) for windows in torch.arange(rows.shape[0]).split(WINDOWS_AT_ONCE)]
    estimated = torch.cat([_estimated(part, system, columns, noise) for part in parts])
    return replace(rows, estimated=estimated) if bool(estimated.isfinite().all()) else rows


def _estimated(rows: Segments, system: System, columns: list[int], noise: Tensor) -> Tensor:
    """(W, T, n) the states along the filter of each window that foresees its readings, with `noise` (C,), best."""
    starts, model = _starts(system, columns), CandidateModel(system, (), rows, COARSE)
    foreseen, states = _filtered(model, columns, starts, noise)
    # Of several values that agree with the readings, as a heading and a turn more, that near the first.
    variance = starts.new_tensor(model.profile.initial_variance)[columns]
    far = 0.5 * ((starts - starts[0]).square() / variance).sum(1, keepdim=True)
    best = (foreseen - far.repeat(len(DOUBTS), 1)).nan_to_num(nan=-math.inf).argmax(0)
    return states[best, torch.arange(len(best))]


def _starts(system: System, columns: list[int]) -> Tensor:
    """(S, U) values of U states, spread over their ranges. The first are 0, or in the middle of a range without 0."""
    low, high = torch.tensor([(system.states[k].low, system.states[k].high) for k in columns], dtype=torch.float64).T
    share = torch.quasirandom.SobolEngine(len(columns), scramble=True, seed=0).draw(STARTS).double()
    starts = low + share * (high - low)
    starts[0] = torch.where((low <= 0) & (high >= 0), 0.0, 0.5 * (low + high))
    return starts


def _filtered(model: CandidateModel, columns: list[int], starts: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Log likelihoods (F, W), up to a constant, and filtered states (F, W, T, n) of the source in every window, by
    filters of each of DOUBTS from each of S values of the states in `columns`: F = len(DOUBTS) S. `noise` (C,) are the
    variances of the readings."""
    rows, count, (windows, length) = model.rows, len(DOUBTS) * len(starts), model.rows.shape
    none = starts.new_zeros(0)  # parameters: the source has no effects
    world, acting = model.stepping(none, model.in_windows(model.acting(none[None]))[0])
    state = initial_states(rows, model.system)[:, 0].repeat(count, 1, 1)
    state[..., columns] = starts.repeat(len(DOUBTS), 1)[:, None]
    state = state.flatten(0, 1)
    initial, disturbance = _variances(model, columns, len(starts))
    covariance = torch.diag(initial).repeat(count * windows, 1, 1)

    def every(values: Tensor) -> Tensor:
        """Values (W, T, ...) row by row, for each filter."""
        return values.repeat(count, *[1] * (values.dim() - 1)).transpose(0, 1)

    acting, time, duration = (every(each) for each in (acting, rows.time, rows.duration))
    measured, used, inside = every(rows.measured), every(rows.used), every(rows.inside) > 0
    channels, variance = list(rows.channels), torch.diag(noise)
    foreseen, states = state.new_zeros(len(state)), []
    for t in range(length):
        if t:
            step = linearise_step(world, none, time[t - 1], state, acting[t - 1], duration=duration[t - 1])
            moved = (step.by_state @ covariance @ step.by_state.mT).unflatten(0, (len(DOUBTS), -1, windows))
            moved = (moved + disturbance[:, None, :, t - 1]).flatten(0, 2)
            state = torch.where(inside[t, :, None], step.value, state)
            covariance = torch.where(inside[t, :, None, None], moved, covariance)
        seen = used[t, :, :, None] * covariance[:, channels]
        root, _ = torch.linalg.cholesky_ex(used[t, :, None] * seen[..., channels] + variance)
        error = (used[t] * (measured[t] - state[:, channels]))[..., None]
        white = torch.linalg.solve_triangular(root, error, upper=False)
        cross = torch.linalg.solve_triangular(root, seen, upper=False)
        foreseen = foreseen - 0.5 * white.square().sum((1, 2)) - root.diagonal(dim1=1, dim2=2).log().sum(1)
        state = state + (cross.mT @ white)[..., 0]
        covariance = covariance - cross.mT @ cross
        covariance = 0.5 * (covariance + covariance.mT)  # rounding errors that are not symmetric would grow
        states.append(state)
    return foreseen.unflatten(0, (count, windows)), torch.stack(states, 1).unflatten(0, (count, windows))


def _variances(model: CandidateModel, columns: list[int], count: int) -> tuple[Tensor, Tensor]:
    """Variances (n,) of the first states, for `count` values of the states in `columns`, and covariances
    (len(DOUBTS), W, T - 1, n, n) of the process noise."""
    sizes = torch.tensor([variable.largest for variable in model.system.states], dtype=torch.float64)
    initial = sizes.new_tensor(model.profile.initial_variance)
    initial[columns] = (sizes[columns] / count ** (1 / len(columns))).square()
    driven, disturbances = model.noise_directions * sizes[model.profile.driven_columns], []
    for doubt, wander in DOUBTS:
        wandering = torch.zeros_like(sizes)
        wandering[columns] = (wander * sizes[columns]).square()
        disturbances.append(doubt**2 * driven @ driven.mT + torch.diag(wandering))
    return initial, torch.stack(disturbances)

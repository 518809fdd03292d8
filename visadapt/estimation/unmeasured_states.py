"""Estimates of states without a sensor, such as the heading of a vehicle of which positions alone were recorded.

A fit improves states that are nearly right; of a state without a reading nothing says where it is. So the source is
filtered through each window from several values of these states (extended Kalman filters in a batch), and the filter
that foresees the readings best gives the estimate from which fits start.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.estimation.candidate import COARSE, CandidateModel
from visadapt.estimation.fit_states import initial_fit
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.linearise import linearise_step
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments, unmeasured
from visadapt.systems import System

STARTS = 32  # Values of the states without a reading from which a window is filtered: 0, and others within their ranges

WANDER = 0.01
"""Standard deviation, as a share of a state's largest size, by which a state without a reading may change from row to
row beside what the source says: a filter that starts with a wrong value finds the right one sooner."""


def with_unmeasured(rows: Segments, system: System) -> Segments:
    """The rows with estimates of the states that were not measured, if there are any."""
    columns = unmeasured(rows, system)
    if not columns:
        return rows
    starts = _starts(system, columns)
    foreseen, states = _filtered(rows, system, columns, starts)
    variance = torch.tensor(profile_of(system).initial_variance, dtype=torch.float64)[columns]
    # The smallest values that agree with the readings: a turn more of a heading does as well.
    score = foreseen - 0.5 * (starts.square() / variance).sum(1, keepdim=True)
    best = score.nan_to_num(nan=-math.inf).argmax(0)
    estimated = states[best, torch.arange(len(best))]
    return replace(rows, estimated=estimated) if bool(estimated.isfinite().all()) else rows


def _starts(system: System, columns: list[int]) -> Tensor:
    """(S, U) values of U states, spread over their ranges, 0 first."""
    ends = torch.tensor([(system.states[k].low, system.states[k].high) for k in columns], dtype=torch.float64)
    share = torch.quasirandom.SobolEngine(len(columns), scramble=True, seed=0).draw(STARTS).double()
    starts = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
    starts[0] = 0.0
    return starts


def _filtered(rows: Segments, system: System, columns: list[int], starts: Tensor) -> tuple[Tensor, Tensor]:
    """Log likelihoods (S, W), up to a constant, and filtered states (S, W, T, n) of the source in every window, from S
    values of the states in `columns`."""
    count, (windows, length) = len(starts), rows.shape
    model, first = CandidateModel(system, (), rows, COARSE), initial_fit(system, rows)
    none = starts.new_zeros(0)  # parameters: the source has no effects
    world, acting = model.stepping(none, model.in_windows(model.acting(none[None]))[0])
    initial, disturbance = _variances(model, first, columns, count)
    state, covariance = first.state[0, :, 0].repeat(count, 1, 1), torch.diag(initial).repeat(count * windows, 1, 1)
    state[..., columns] = starts[:, None]
    state = state.flatten(0, 1)

    def every(values: Tensor) -> Tensor:
        """Values (W, T, ...) row by row, for each start."""
        return values.repeat(count, *[1] * (values.dim() - 1)).transpose(0, 1)

    acting, time, duration, disturbance = (every(each) for each in (acting, rows.time, rows.duration, disturbance))
    measured, used, inside = every(rows.measured), every(rows.used), every(rows.inside) > 0
    noise, channels = torch.diag(first.log_noise[0].exp()), list(rows.channels)
    foreseen, states = state.new_zeros(len(state)), []
    for t in range(length):
        if t:
            step = linearise_step(world, none, time[t - 1], state, acting[t - 1], duration=duration[t - 1])
            moved = step.by_state @ covariance @ step.by_state.mT + disturbance[t - 1]
            state = torch.where(inside[t, :, None], step.value, state)
            covariance = torch.where(inside[t, :, None, None], moved, covariance)
        seen = used[t, :, :, None] * covariance[:, channels]
        root, _ = torch.linalg.cholesky_ex(used[t, :, None] * seen[..., channels] + noise)
        error = (used[t] * (measured[t] - state[:, channels]))[..., None]
        white = torch.linalg.solve_triangular(root, error, upper=False)
        cross = torch.linalg.solve_triangular(root, seen, upper=False)
        foreseen = foreseen - 0.5 * white.square().sum((1, 2)) - root.diagonal(dim1=1, dim2=2).log().sum(1)
        state = state + (cross.mT @ white)[..., 0]
        covariance = covariance - cross.mT @ cross
        covariance = 0.5 * (covariance + covariance.mT)  # rounding errors that are not symmetric would grow
        states.append(state)
    return foreseen.unflatten(0, (count, windows)), torch.stack(states, 1).unflatten(0, (count, windows))


def _variances(model: CandidateModel, first: FitState, columns: list[int], count: int) -> tuple[Tensor, Tensor]:
    """Variances (n,) of the first states, and covariances (W, T - 1, n, n) of the process noise, for filters that start
    with `count` values of the states in `columns`."""
    sizes = torch.tensor([variable.largest for variable in model.system.states], dtype=torch.float64)
    initial, wander = sizes.new_tensor(model.profile.initial_variance), torch.zeros_like(sizes)
    initial[columns] = (sizes[columns] / count ** (1 / len(columns))).square()
    wander[columns] = (WANDER * sizes[columns]).square()
    group = [k for k, driven in enumerate(model.profile.driven) for _ in driven]
    loads = model.noise_directions
    return initial, (loads * first.log_process[0, group].exp()) @ loads.mT + torch.diag(wander)

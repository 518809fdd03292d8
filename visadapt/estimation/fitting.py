"""Fits of several sets of effects in one batch, by damped Gauss-Newton steps on the likelihood of `likelihood.py`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.likelihood import (
    MAX_LOG_PROCESS,
    Derivatives,
    FitState,
    differentiate,
    min_log_process,
    noise_members,
)

MIN_ITERATION_GAIN = 0.05  # Log likelihood; a fit stops after two iterations in a row that gain, or lose, less

LEAST_NOISE = 2e-5
"""Least standard deviation of a measurement, as a share of its state's scale: below it, as in simulated recordings
without noise, errors of the integration would be taken for physics."""

FIRST_DAMPING = 1e-3  # Damping of the first step, as a share of the information

MAX_DAMPING = 100.0  # Damping at which a fit stops, since its steps have become too short to gain anything

OUT_OF_REACH = 100.0
STEPS_TO_COME = 4
"""A fit stops when its expected final log likelihood (the present one, plus the gain of its last successful step times
the iterations left, STEPS_TO_COME at most) is more than OUT_OF_REACH below its rival's."""

MAX_LOG_VARIANCE_CHANGE = 1.5  # Largest change of a log variance in one iteration
FALLING = 0.9  # Share of it by which a noise falls, from which on how far it will fall is unknown


def fit(
    models: Sequence[CandidateModel],
    start: FitState,
    iterations: int,
    process_noise: bool = True,
    rival: float = -math.inf,
) -> FitState:
    """The best fits of C models of the same rows in at most `iterations` damped Gauss-Newton steps from `start`.

    Args:
        process_noise: without it, process noise stays at its lower bound. Where the rows have a `colour`, all noise
            is as that states.
        rival: log likelihood of another fit; fits that cannot come near it stop early.
    """
    colour = models[0].rows.colour
    if colour is not None:
        process_noise = True
        noise = colour.log_process.expand_as(start.log_process), colour.log_noise.expand_as(start.log_noise)
        start = replace(start, log_process=noise[0], log_noise=noise[1])
    elif not process_noise:
        start = replace(start, log_process=torch.full_like(start.log_process, min_log_process(models[0].rows.period)))
    bounds = _bounds(models, start)
    all_windows = torch.ones(start.state.shape[:2], dtype=torch.float64)
    damping = torch.full((len(models),), FIRST_DAMPING, dtype=torch.float64)
    stalled = torch.zeros(len(models), dtype=torch.long)
    gained = torch.full_like(damping, math.inf)  # by the last step that gained something
    falling = torch.zeros(len(models), dtype=torch.bool)  # whether a noise falls as fast as it may: more is to come
    active = torch.arange(len(models))
    here = best = start
    at: Derivatives | None = None
    period = models[0].profile.relinearise_every
    for iteration in range(iterations):
        if (iteration + 1) % period == 0:
            for model in models:
                model.slopes = None
        now = differentiate([models[k] for k in active.tolist()], here[active]).summed(all_windows[active])
        tried = replace(here[active], likelihood=now.likelihood, information=now.information)
        if at is None:
            best, at = tried, now
        else:
            gain = tried.likelihood - best.likelihood[active]
            better = gain > 0
            damping[active] = torch.where(better, damping[active] / 4, (8 * damping[active]).clamp(min=0.1))
            stalled[active] = torch.where(gain.abs() < MIN_ITERATION_GAIN, stalled[active] + 1, 0)
            best = best.replaced(active[better], tried[better])
            at = at.replaced(active[better], now[better])
            gained[active] = torch.where(better, gain, gained[active])
            to_come = min(STEPS_TO_COME, iterations - 1 - iteration)
            in_reach = falling | (best.likelihood + to_come * gained > rival - OUT_OF_REACH)
            # Fits that have converged leave the batch.
            active = active[(stalled[active] < 2) & (damping[active] < MAX_DAMPING) & in_reach[active]]
            if not len(active):
                break
        here = _step(best, at, damping, bounds, models[0])
        falling = (best.log_noise - here.log_noise).amax(1) > FALLING * MAX_LOG_VARIANCE_CHANGE / (1 + damping)
        if not process_noise:
            here = replace(here, log_process=start.log_process)
    return best


def _bounds(models: Sequence[CandidateModel], fits: FitState) -> tuple[Tensor, Tensor]:
    """Lowest and highest parameters (C, K); those of padding are 0."""
    low, high = torch.zeros_like(fits.theta), torch.zeros_like(fits.theta)
    for c, model in enumerate(models):
        low[c, : len(model.table)], high[c, : len(model.table)] = model.low, model.high
    return low, high


MAX_REFIT_CHANGE = 2.0
"""Largest change of a parameter without some windows, in its standard deviations: where only these inform about it,
the step would have no bounds."""


def refitted(model: CandidateModel, fits: FitState, window_used: Tensor) -> FitState:
    """One fit (C = 1) to all windows, refitted C times by one Gauss-Newton step: for each row of `window_used` (C, W),
    to the windows where that row is 1.

    Leaving windows out moves the optimum only a little, so one step comes close to it, and all C refits together cost
    one step (Beirami, Razaviyayn, Shahrampour and Tarokh 2017, On optimal generalizability, NeurIPS). The states, about
    which the model is linearised next, stay those of the fit to all windows: moved linearly, they might cross an
    instant at which a joint with dry friction stops, where its motion is not linear.
    """
    copied = torch.zeros(len(window_used), dtype=torch.long)
    whole = differentiate([model], fits)
    at, copies = whole.summed(window_used), fits[copied]
    low, high = (end[copied] for end in _bounds([model], fits))
    widths = (high - low).clamp(min=1e-300)
    information = whole.summed(torch.ones_like(window_used)).information + torch.diag_embed((2 / widths).square())
    spread = torch.linalg.inv_ex(information).inverse.diagonal(dim1=1, dim2=2).sqrt()
    most = MAX_REFIT_CHANGE * spread.nan_to_num(math.inf)  # of a set that cannot be simulated, nothing is known
    bounds = torch.maximum(low, copies.theta - most), torch.minimum(high, copies.theta + most)
    damping = torch.full((len(copied),), FIRST_DAMPING, dtype=torch.float64)
    return replace(_step(copies, at, damping, bounds, model), state=copies.state, likelihood=at.likelihood)


def _step(
    fits: FitState, at: Derivatives, damping: Tensor, bounds: tuple[Tensor, Tensor], model: CandidateModel
) -> FitState:
    """The damped Gauss-Newton step from `fits`, with parameters within the bounds (C, K)."""
    low, high = bounds
    # A prior weak enough to matter only where the data hold no information; the 1.0 is for padding, which stays 0.
    prior = torch.where(high > low, (2 / (high - low)).square(), 1.0)
    diagonal = torch.diagonal(at.information, dim1=1, dim2=2)
    damped = at.information + torch.diag_embed(prior + damping[:, None] * diagonal)
    theta = (fits.theta + _solution(damped, at.gradient)).clamp(low, high)
    # `smoothed` is the correction of the states, and its derivative by each parameter.
    weights = torch.cat((theta.new_ones(len(theta), 1), theta - fits.theta), 1)
    noise_information = at.noise_information + 0.3 * torch.eye(at.noise_gradient.shape[1], dtype=theta.dtype)
    log_change = _solution(noise_information, at.noise_gradient)
    share = 1 / (1 + damping)[:, None]
    log_change = log_change.clamp(-MAX_LOG_VARIANCE_CHANGE, MAX_LOG_VARIANCE_CHANGE) * share
    groups = fits.log_process.shape[1]
    noise_change = log_change @ noise_members(model)[1]
    # Rounding to a resolution is noise with a deviation of resolution / sqrt(12).
    resolution = torch.tensor(model.rows.resolution, dtype=torch.float64)
    least = torch.tensor([LEAST_NOISE * model.system.states[k].scale for k in model.rows.channels]).double()
    lowest_process = min_log_process(model.rows.period)
    lowest_noise = (resolution.square() / 12 + least.square()).log()
    return replace(
        fits,
        theta=theta,
        state=fits.state + (at.smoothed * weights[:, None, None, None]).sum(-1),
        log_process=(fits.log_process + log_change[:, :groups]).clamp(lowest_process, MAX_LOG_PROCESS),
        log_noise=torch.maximum(fits.log_noise + noise_change, lowest_noise),
    )


def _solution(matrix: Tensor, right: Tensor) -> Tensor:
    """The solutions (C, K) of C linear systems (C, K, K) with right sides (C, K).

    Where derivatives are not finite it is 0: there is no step, and the fit of that set ends; those of the others go on.
    """
    return torch.linalg.solve_ex(matrix, right[..., None]).result[..., 0].nan_to_num(0, 0, 0)

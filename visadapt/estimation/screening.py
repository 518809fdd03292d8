"""Which effects are worth adding to a fitted set, by the linear response of its innovations to each of them.

When a small effect is added, the filter's innovations change by the effect's one-step disturbances passed through the
same gains. So a whole grid of parameter values is scored by one pass of the filter's means, without refitting. If the
effect is proportional to its strengths, their best sizes at each point of the grid follow in closed form; otherwise
Gauss-Newton steps with the same response find them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.effects import Effect, Role
from visadapt.estimation.episode_phases import has_episode_phases, with_common_phase
from visadapt.estimation.frequencies import comes_and_goes, likeliest
from visadapt.estimation.grids import (
    FREQUENCY_POINTS,
    SMALL_SHARE,
    clamped_to_range,
    column_of,
    grid,
    is_proportional,
    size,
    spans,
    starts,
    strengths,
    values_of,
)
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.estimation.sensitivity import Sensitivity
from visadapt.processes import shared_out
from visadapt.systems import System

EPISODES_SCREENED = 3
"""An effect with a phase for each episode is screened on the EPISODES_SCREENED longest episodes, one at a time."""

STEPPED_POINTS = 2
"""A Gauss-Newton step is tried from the STEPPED_POINTS best points of a grid, and from as many of those whose strengths
are within SMALL_SHARE of neutral: from a point far from neutral, the linear response may promise too much."""

NEARLY = 0.9
"""Share of the largest gain from which a smaller effect is proposed instead of the one with the largest gain. The gains
are those of a linear response, by which a dead motor (large backlash) may seem as good as a little backlash."""

MAX_STEPS = 6
MIN_STEP_GAIN = 0.1
"""Number of Gauss-Newton steps at most, and log likelihood gained by a step below which no other is made."""


@dataclass(frozen=True)
class Candidate:
    """An effect that may be added to a fitted set, and the parameter values to start from."""

    effect: type[Effect]
    values: tuple[float, ...]
    gain: float  # log likelihood that it adds, by the linear response


def screen(
    system: System,
    effects: Sequence[type[Effect]],
    fits: FitState,
    rows: Segments,
    candidates: Sequence[type[Effect]],
    jobs: int = 1,
) -> list[Candidate]:
    """The best parameter values of every effect of `candidates` that raises the likelihood, the largest gain first.

    They are added to a set of `effects` with its fit (C = 1); `jobs` processes share the work.
    """
    covered = spans(system, rows, fits.state[0])
    by_stride: dict[int, Sensitivity] = {}

    def sensitivity(stride: int) -> Sensitivity:
        if stride not in by_stride:
            by_stride[stride] = Sensitivity.on_every(stride, system, effects, fits, rows)
        return by_stride[stride]

    def best(effect: type[Effect]) -> Candidate | None:
        if has_episode_phases(effect):
            return _with_episode_phases(sensitivity(1), effect)
        proportional, columns, most = is_proportional(effect), strengths(effect), profile_of(system).screening_rows
        if proportional and comes_and_goes(effect):
            few = sensitivity(_window_stride(most, rows, 2 * FREQUENCY_POINTS))
            points = grid(effect, covered, likeliest(sensitivity(1), few, effect))
        else:
            points = grid(effect, covered) if proportional else starts(effect, covered)
        if not len(points):
            return None  # no region lies within readings that never change
        stride = _window_stride(most, rows, len(points) * (1 + len(columns)))
        some = sensitivity(stride)
        if not proportional:
            promising = _promising(some, effect, points, columns)
            if len(columns) == 1:
                return _best_of_points(sensitivity(1), effect, promising)
            return _descend(sensitivity(1), effect, promising[0])
        found = _best_on_grid(effect, points, columns, some.innovations.error, some.by_unit(effect, points, columns))
        return None if found is None else replace(found, gain=stride * found.gain)

    found = shared_out(lambda indices: [best(candidates[k]) for k in indices], len(candidates), jobs)
    return sorted((one for one in found if one is not None), key=lambda one: -one.gain)


def _with_episode_phases(sensitivity: Sensitivity, effect: type[Effect]) -> Candidate | None:
    """The candidate that the screening of one long episode alone gives, with the phases that suit the others best."""
    plain, rows, fits = with_common_phase(effect), sensitivity.rows, sensitivity.fits
    sizes = torch.zeros(len(rows.command)).index_add(0, rows.episode, rows.inside.sum(1).float())
    found = []
    longest = sizes.argsort(descending=True, stable=True)[: min(EPISODES_SCREENED, int((sizes > 0).sum()))]
    for episode in longest.tolist():
        windows = (rows.episode == episode).nonzero()[:, 0]
        alone = screen(sensitivity.system, sensitivity.effects, fits.on(windows), rows.select(windows), [plain])
        found += [_best_phases(sensitivity, effect, one.values) for one in alone]
    return max(found, key=lambda one: one.gain, default=None)


def _best_phases(sensitivity: Sensitivity, effect: type[Effect], values: Sequence[float]) -> Candidate:
    """An effect with a phase for each episode: of parameters (P,) with one phase, the phase that suits each best."""
    plain, rows = with_common_phase(effect), sensitivity.rows
    column = column_of(plain, Role.PHASE)
    phases = values_of(plain.table[column])
    points = torch.tensor(list(values), dtype=torch.float64).repeat(len(phases), 1)
    points[:, column] = phases
    change, _ = sensitivity.around(plain, points, [])
    error = sensitivity.innovations.error[:, None]
    gains = 0.5 * (error.square() - (error + change).square())  # (N, phases), window by window
    by_window = gains.unflatten(0, (len(rows.episode), -1)).sum(1)
    by_episode = by_window.new_zeros(len(rows.command), len(phases)).index_add(0, rows.episode, by_window)
    best, chosen = by_episode.max(1)
    points[0, column] = phases[chosen[0]]
    return Candidate(effect, (*points[0].tolist(), *phases[chosen[1:]].tolist()), float(best.sum()))


def _window_stride(most: float, rows: Segments, points: int) -> int:
    """The stride k, a power of two: the least for which the rows of every k-th window, times `points`, are at most
    `most`; less where fewer than 8 windows would remain."""
    wanted = points * float(rows.inside.sum()) / most
    # A power of two, so that effects share their sensitivities.
    return 2 ** max(0, min(math.ceil(math.log2(max(1.0, wanted))), int(math.log2(max(1, rows.shape[0] // 8)))))


def _promising(sensitivity: Sensitivity, effect: type[Effect], points: Tensor, columns: list[int]) -> Tensor:
    """Points (K, P) that one Gauss-Newton step of `columns` reaches: from the points (G, P) that are best after it,
    from the best small ones, and from the one that is best before it; last, that one without a step."""
    change, slopes = sensitivity.around(effect, points, columns)
    left, slopes = sensitivity.innovations.error[:, None] + change, slopes.movedim(1, 0)
    normal = slopes.mT @ slopes
    ridge = 1e-3 * torch.diagonal(normal, dim1=1, dim2=2) + 1e-30
    pull = -(slopes.mT @ left.T[..., None])[..., 0]
    # Where an effect is so strong that numbers are not finite, there is no step.
    steps = torch.linalg.solve_ex(normal + torch.diag_embed(ridge), pull[..., None]).result[..., 0].nan_to_num(0, 0, 0)
    after = _finite((left + torch.einsum("gnk,gk->ng", slopes, steps)).square().sum(0))
    stepped = points.clone()
    stepped[:, columns] += steps
    best = _finite(left.square().sum(0)).argmin()
    order = after.argsort(stable=True)
    small = order[size(effect, points[order]) <= SMALL_SHARE]
    chosen = torch.cat((order[:STEPPED_POINTS], small[:STEPPED_POINTS], best[None]))
    return clamped_to_range(effect, torch.cat((stepped[chosen], points[best][None])))


def _best_of_points(sensitivity: Sensitivity, effect: type[Effect], points: Tensor) -> Candidate | None:
    """The candidate with the largest gain of points (G, P), or of much smaller ones that gain nearly as much: large
    ones the linear response may misjudge. None without a gain."""
    change, _ = sensitivity.around(effect, points, [])
    error = sensitivity.innovations.error[:, None]
    gains = 0.5 * (error.square().sum(0) - _finite((error + change).square().sum(0)))
    if not gains.max() > 0:
        return None
    sizes = size(effect, points)
    smallest = sizes[gains >= NEARLY * gains.max()].min()
    best = int(torch.where(sizes <= 2 * smallest, gains, -math.inf).argmax())
    return Candidate(effect, tuple(points[best].tolist()), float(gains[best]))


def _finite(squares: Tensor) -> Tensor:
    """Sums of squares, infinite where they are not numbers."""
    return squares.nan_to_num(math.inf, math.inf)


def _descend(sensitivity: Sensitivity, effect: type[Effect], point: Tensor) -> Candidate | None:
    """The candidate that damped Gauss-Newton steps (Levenberg 1944) reach from a point (P,); None without a gain."""
    error = sensitivity.innovations.error
    every = list(range(len(effect.table)))
    damping, best, found, left = 1e-2, -math.inf, point, error
    slopes = torch.zeros(len(left), len(every), dtype=left.dtype)
    for _ in range(MAX_STEPS):
        change, derivatives = sensitivity.around(effect, point[None], every)
        now = error + change[:, 0]
        gain = float(0.5 * (error.square().sum() - now.square().sum()))
        if not (math.isfinite(gain) or best > -math.inf):
            return None  # nothing to go on from
        if gain > best:
            damping, settled = damping / 5, gain - best < MIN_STEP_GAIN
            best, found, slopes, left = gain, point, derivatives[:, 0], now
            if settled:
                break
        else:
            damping *= 10
        normal = slopes.T @ slopes
        normal = normal + torch.diag(damping * normal.diagonal() + 1e-12 * normal.diagonal().max() + 1e-30)
        point = clamped_to_range(effect, found - torch.linalg.solve(normal, slopes.T @ left))
    return Candidate(effect, tuple(found.tolist()), best) if best > 0 else None


def _best_on_grid(
    effect: type[Effect], shapes: Tensor, linear: list[int], error: Tensor, response: Tensor
) -> Candidate | None:
    """The point of a grid (G, P) that reduces the squares of `error` (N,) most, with the best sizes of the parameters
    `linear`; `response` (N, G, L) is the change per unit of these. None where no point reduces them.
    """
    response = response.movedim(1, 0)
    normal = response.mT @ response
    ridge = 1e-9 * torch.diagonal(normal, dim1=1, dim2=2).mean(1) + 1e-30
    normal = normal + ridge[:, None, None] * torch.eye(len(linear), dtype=error.dtype)
    pull = -(response.mT @ error)
    sizes = torch.linalg.solve(normal, pull[..., None])[..., 0]
    for j, column in enumerate(linear):
        parameter = effect.table[column]
        neutral = float(parameter.neutral or 0.0)
        sizes[:, j] = sizes[:, j].clamp(parameter.low - neutral, parameter.high - neutral)
    gains = (pull * sizes).sum(-1) - 0.5 * torch.einsum("gi,gij,gj->g", sizes, normal, sizes)
    best = int(gains.argmax())
    if gains[best] <= 0:
        return None
    values = shapes[best].clone()
    values[linear] += sizes[best]
    return Candidate(effect, tuple(values.tolist()), float(gains[best]))

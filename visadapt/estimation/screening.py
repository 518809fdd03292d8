"""Which effects are worth adding to a fitted set, by the linear response of its innovations to each of them.

When a small effect is added, the filter's innovations change by the effect's one-step disturbances passed through the
same gains. So a whole grid of parameter values is scored by one pass of the filter's means, without refitting. If the
effect is proportional to its strengths, their best sizes at each point of the grid follow in closed form; otherwise
Gauss-Newton steps with the same response find them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.effects import Effect, Parameter, Role
from visadapt.estimation.episode_phases import has_episode_phases, in_step
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.estimation.sensitivity import Sensitivity
from visadapt.processes import shared_out
from visadapt.systems import System

SMALL_POINTS, LARGE_POINTS = 5, 9
"""Values on either side of neutral, for a strength that the effect is not proportional to: the first number spaced
logarithmically up to a tenth of the range, the second evenly beyond."""

EDGE_POINTS, FREQUENCY_POINTS, PHASE_POINTS, SHAPE_POINTS = 13, 24, 8, 5
"""Values of a region's start or end, of a frequency, of a phase, and of any other shape parameter."""

START_STRENGTH = 0.05
"""Share of its range, from neutral, at which each of several strengths starts that Gauss-Newton steps find."""

Spans = Mapping[str, tuple[float, float]]
"""By unit, the interval that the recording covers of the variable along which regions of that unit lie."""


def is_proportional(effect: type[Effect]) -> bool:
    """Whether the effect has strengths, and is proportional to all of them."""
    strengths = [p for p in effect.table if p.neutral is not None]
    return bool(strengths) and all(p.linear for p in strengths)


def grid(effect: type[Effect], spans: Spans) -> tuple[Tensor, list[int]]:
    """Parameter values (G, P) of an effect that is proportional to its strengths, and the columns of these."""
    axes = [_edges(p, spans, EDGE_POINTS) if p.is_edge else _values(p) for p in effect.table]
    points = torch.cartesian_prod(*axes).reshape(-1, len(effect.table))
    if (region := effect.region()) is not None:
        start, end = (effect.table.index(edge) for edge in region)
        points = points[points[:, start] < points[:, end]]
    return points, [k for k, p in enumerate(effect.table) if p.neutral is not None]


def starts(effect: type[Effect], spans: Spans) -> tuple[Tensor, list[int]]:
    """Points (G, P) from which Gauss-Newton steps start, and the columns of the effect's strengths.

    One strength has a grid, since its derivative may vanish far from the best value, as where no command reaches a
    limit. Several start slightly off neutral: at neutral the derivatives vanish where it takes several of them to act.
    """
    strengths = [k for k, p in enumerate(effect.table) if p.neutral is not None]
    axes = []
    for parameter in effect.table:
        if parameter.neutral is not None and len(strengths) > 1:
            end = parameter.high if parameter.high > parameter.neutral else parameter.low
            axes.append(
                torch.tensor([parameter.neutral + START_STRENGTH * (end - parameter.neutral)], dtype=torch.float64)
            )
        elif parameter.is_edge:
            axes.append(_edges(parameter, spans, SHAPE_POINTS))
        else:
            values = _values(parameter)
            coarse = parameter.neutral is None and parameter.role is not Role.FREQUENCY
            axes.append(values[:: max(1, len(values) // 2)] if coarse else values)
    return torch.cartesian_prod(*axes).reshape(-1, len(effect.table)), strengths


def _edges(parameter: Parameter, spans: Spans, count: int) -> Tensor:
    return torch.linspace(*spans.get(parameter.unit, (parameter.low, parameter.high)), count, dtype=torch.float64)


def _values(parameter: Parameter) -> Tensor:
    low, high, neutral = parameter.low, parameter.high, parameter.neutral
    if parameter.linear and neutral is not None:
        return torch.tensor([neutral], dtype=torch.float64)
    if parameter.role is Role.FREQUENCY:
        ends = torch.tensor([low, high]).log10().tolist()
        return torch.logspace(ends[0], ends[1], FREQUENCY_POINTS, dtype=torch.float64)
    if parameter.role is Role.PHASE:
        return torch.linspace(low, high, PHASE_POINTS + 1, dtype=torch.float64)[:-1]
    if neutral is None:
        return torch.linspace(low, high, SHAPE_POINTS + 2, dtype=torch.float64)[1:-1]
    shares = torch.cat(
        (torch.logspace(-2.7, math.log10(SMALL_SHARE), SMALL_POINTS), torch.linspace(0.15, 1, LARGE_POINTS))
    ).double()
    return torch.cat([neutral + shares * (end - neutral) for end in (low, high) if end != neutral])


def spans(system: System, rows: Segments, state: Tensor) -> dict[str, tuple[float, float]]:
    """By unit, the smallest and largest value, along states (W, T, n), of the variable along which regions lie."""
    inside = rows.inside > 0

    def span(values: Tensor) -> tuple[float, float]:
        return float(values[inside].min()), float(values[inside].max())

    variables = {"time": rows.time} | {v.name: state[..., k] for k, v in enumerate(system.states)}
    return {unit: span(variables[name]) for unit, name in profile_of(system).region_variables.items()}


EPISODES_SCREENED = 3
"""Episodes, the longest first, from each of which alone an effect is screened that has a phase for each episode."""

STEPPED_POINTS = 2
"""Points of a grid, and small ones among them, that are tried where a Gauss-Newton step leads from them: a step from
afar may promise too much."""

SMALL_SHARE = 0.1  # Share of its range, from neutral, up to which a strength is small

NEARLY = 0.9
"""Share of the largest gain from which on a smaller effect is proposed: the response is linear, so that a motor that
does nothing may seem as good as a little backlash."""

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
        points, columns = grid(effect, covered) if is_proportional(effect) else starts(effect, covered)
        stride = _window_stride(profile_of(system).screening_rows, rows, len(points) * (1 + len(columns)))
        some = sensitivity(stride)
        if not is_proportional(effect):
            promising = _promising(some, effect, points, columns)
            if len(columns) == 1:
                return _best_of(sensitivity(1), effect, promising)
            return _descend(sensitivity(1), effect, promising[0])
        found = _best(effect, points, columns, some.innovations.error, some.by_unit(effect, points, columns))
        return None if found is None else replace(found, gain=stride * found.gain)

    found = shared_out(lambda indices: [best(candidates[k]) for k in indices], len(candidates), jobs)
    return sorted((one for one in found if one is not None), key=lambda one: -one.gain)


def _with_episode_phases(sensitivity: Sensitivity, effect: type[Effect]) -> Candidate | None:
    """The candidate that the screening of one long episode alone gives, with the phases that suit the others best."""
    plain, rows, fits = in_step(effect), sensitivity.rows, sensitivity.fits
    sizes = torch.zeros(len(rows.command)).index_add(0, rows.episode, rows.inside.sum(1).float())
    found = []
    longest = sizes.argsort(descending=True, stable=True)[: min(EPISODES_SCREENED, int((sizes > 0).sum()))]
    for episode in longest.tolist():
        own = (rows.episode == episode).nonzero()[:, 0]
        alone = screen(sensitivity.system, sensitivity.effects, fits.on(own), rows.select(own), [plain])
        found += [_best_phases(sensitivity, effect, one.values) for one in alone]
    return max(found, key=lambda one: one.gain, default=None)


def _best_phases(sensitivity: Sensitivity, effect: type[Effect], values: Sequence[float]) -> Candidate:
    """An effect with a phase for each episode: of parameters (P,) with one phase, the phase that suits each best."""
    plain, rows = in_step(effect), sensitivity.rows
    column = next(k for k, p in enumerate(plain.table) if p.role is Role.PHASE)
    phases = _values(plain.table[column])
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
    """Smallest k for which every k-th window has at most `most` rows times points; it leaves at least 8 windows."""
    wanted = points * float(rows.inside.sum()) / most
    # A power of two, so that effects share their sensitivities.
    return 2 ** max(0, min(math.ceil(math.log2(max(1.0, wanted))), int(math.log2(max(1, rows.shape[0] // 8)))))


def _promising(sensitivity: Sensitivity, effect: type[Effect], points: Tensor, strengths: list[int]) -> Tensor:
    """Points to which one Gauss-Newton step of the strengths leads from those of points (G, P) that promise most, the
    best first, also from the best of the small ones; then that of `points` which is best without a step."""
    change, slopes = sensitivity.around(effect, points, strengths)
    left, slopes = sensitivity.innovations.error[:, None] + change, slopes.movedim(1, 0)
    normal = slopes.mT @ slopes
    ridge = 1e-3 * torch.diagonal(normal, dim1=1, dim2=2) + 1e-30
    pull = -(slopes.mT @ left.T[..., None])[..., 0]
    steps = torch.linalg.solve(normal + torch.diag_embed(ridge), pull[..., None])[..., 0]
    after = (left + torch.einsum("gnk,gk->ng", slopes, steps)).square().sum(0)
    stepped = points.clone()
    stepped[:, strengths] += steps
    best = left.square().sum(0).argmin()
    order = after.argsort(stable=True)
    small = order[_size(effect, points[order]) <= SMALL_SHARE]
    chosen = torch.cat((order[:STEPPED_POINTS], small[:STEPPED_POINTS], best[None]))
    return _inside(effect, torch.cat((stepped[chosen], points[best][None])))


def _best_of(sensitivity: Sensitivity, effect: type[Effect], points: Tensor) -> Candidate | None:
    """The candidate with the largest gain of points (G, P), or of much smaller ones that gain nearly as much: large
    ones the linear response may misjudge. None without a gain."""
    change, _ = sensitivity.around(effect, points, [])
    error = sensitivity.innovations.error[:, None]
    gains = 0.5 * (error.square() - (error + change).square()).sum(0)
    if not gains.max() > 0:
        return None
    size = _size(effect, points)
    smallest = size[gains >= NEARLY * gains.max()].min()
    best = int(torch.where(size <= 2 * smallest, gains, -math.inf).argmax())
    return Candidate(effect, tuple(points[best].tolist()), float(gains[best]))


def _size(effect: type[Effect], points: Tensor) -> Tensor:
    """(G,) how far the strengths of points (G, P) are from neutral, as a share of their range; the largest of them."""
    away = [
        (points[:, k] - parameter.neutral).abs() / (parameter.high - parameter.low)
        for k, parameter in enumerate(effect.table)
        if parameter.neutral is not None
    ]
    return torch.stack([*away, torch.zeros(len(points), dtype=points.dtype)]).amax(0)


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
        if gain > best:
            damping, settled = damping / 5, gain - best < MIN_STEP_GAIN
            best, found, slopes, left = gain, point, derivatives[:, 0], now
            if settled:
                break
        else:
            damping *= 10
        normal = slopes.T @ slopes
        normal = normal + torch.diag(damping * normal.diagonal() + 1e-12 * normal.diagonal().max() + 1e-30)
        point = _inside(effect, found - torch.linalg.solve(normal, slopes.T @ left))
    return Candidate(effect, tuple(found.tolist()), best) if best > 0 else None


def _inside(effect: type[Effect], point: Tensor) -> Tensor:
    low, high = (torch.tensor([getattr(p, end) for p in effect.table], dtype=point.dtype) for end in ("low", "high"))
    return point.clamp(low, high)


def _best(effect: type[Effect], shapes: Tensor, linear: list[int], error: Tensor, response: Tensor) -> Candidate | None:
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

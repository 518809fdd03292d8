"""Which effects are worth fitting beside a fitted set: a linear answer for a grid of shapes and sizes of each.

Where a small effect is added, the innovations of the filter change by what its one-step disturbances become when
passed through the same gains. So a whole grid is scored by one pass of the filter's means, without refitting.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.diagnosis.data import Rows
from visadapt.diagnosis.fitting import Fits
from visadapt.diagnosis.innovations import Innovations
from visadapt.diagnosis.models import GLANCE, Family
from visadapt.diagnosis.subjects import subject_of
from visadapt.effects import Effect
from visadapt.effects.base import Parameter
from visadapt.systems import System

STRENGTHS = 9
"""Values tried, to either side, of a strength to which an effect is not proportional: so many up to a tenth of its
range, each a factor more, and as many beyond."""

EDGES = 13
FREQUENCIES = 24
PHASES = 8
SHAPES = 5
"""Values tried of a start or an end, a frequency, a phase, and any other shape."""

PROBE = 0.02
"""Share of its range at which an effect that is proportional to a parameter is probed."""

NUDGE = 0.05
"""Share of its range at which a strength begins that is sought by steps."""

CLOSE = 1e-4
"""Share of its range by which a parameter is changed to see what it does beside a point."""

STEPS = 6
SETTLED = 0.1
"""Steps at most, and log likelihood that is not worth another."""


@dataclass(frozen=True)
class Lead:
    """A promising start for an effect beside a fitted set."""

    effect: type[Effect]
    values: tuple[float, ...]
    gain: float
    """log likelihood that it promises"""


def screen(
    system: System, effects: Sequence[type[Effect]], fits: Fits, rows: Rows, candidates: Sequence[type[Effect]]
) -> list[Lead]:
    """The best lead of every candidate beside the one fitted set in `fits`, best first."""
    seen_at = spans(system, rows, fits.state[0])
    views: dict[int, View] = {}
    leads = []
    for effect in candidates:
        climbs = is_climbed(effect)
        shapes, linear = starts(effect, seen_at) if climbs else grid(effect, seen_at)
        every = _every(subject_of(system).tried_rows, rows, len(shapes) * (1 + len(linear)))
        for k in {1, every} if climbs else {every}:
            if k not in views:
                views[k] = View.of(system, effects, fits, rows, k)
        view = views[every]
        answer = view.answer(effect, shapes, linear, climbs)
        if climbs:
            lead = _climbed(views[1], effect, _nearest(effect, shapes, linear, view.seen.error, answer))
        else:
            lead = _best(effect, shapes, linear, view.seen.error, answer)
            lead = None if lead is None else replace(lead, gain=every * lead.gain)
        if lead is not None:
            leads.append(lead)
    return sorted(leads, key=lambda lead: -lead.gain)


def _every(most: float, rows: Rows, points: int) -> int:
    """Of how many windows one is looked at where an effect is tried at so many points."""
    wanted = points * float(rows.inside.sum()) / most
    # Powers of two, so that effects share what is looked at.
    return 2 ** max(0, min(math.ceil(math.log2(max(1.0, wanted))), int(math.log2(max(1, rows.shape[0] // 8)))))


@dataclass(frozen=True)
class View:
    """A fitted set on some of the windows, and what effects would change of its innovations there."""

    system: System
    effects: Sequence[type[Effect]]
    fits: Fits
    rows: Rows
    seen: Innovations

    @classmethod
    def of(cls, system: System, effects: Sequence[type[Effect]], fits: Fits, rows: Rows, every: int) -> View:
        """On every so manieth window."""
        if every > 1:
            windows = torch.arange(0, rows.shape[0], every)
            rows, fits = rows.of(windows), replace(fits, state=fits.state[:, windows])
        return cls(system, effects, fits, rows, Innovations(Family(system, effects, rows), fits))

    def answer(self, effect: type[Effect], points: Tensor, linear: list[int], climbs: bool = False) -> Tensor:
        """How the innovations change (N, G, columns) at points (G, P): with a unit of each linear parameter.

        Where the effect `climbs`, the first column is the change by the point itself, and a unit's change is that
        from there on.
        """
        columns = _columns(self.system, [*self.effects, effect], self.fits, self.rows, points, linear, climbs)
        answer = self.seen.answer(*columns)
        return answer.reshape(len(answer), len(points), -1)


def is_climbed(effect: type[Effect]) -> bool:
    """Whether an effect has too many strengths for a grid, and is not proportional to them."""
    return sum(p.neutral is not None and not p.linear for p in effect.table) > 1


def starts(effect: type[Effect], spans: dict[str, tuple[float, float]]) -> tuple[Tensor, list[int]]:
    """Points (G, P) from which an effect's parameters are sought by steps, and the columns of its strengths.

    Strengths begin a little beside what makes the effect vanish, since it may take several to make it act.
    """
    strengths = [k for k, p in enumerate(effect.table) if p.neutral is not None]
    axes = []
    for parameter in effect.table:
        if parameter.neutral is not None:
            end = parameter.high if parameter.high > parameter.neutral else parameter.low
            axes.append(torch.tensor([parameter.neutral + NUDGE * (end - parameter.neutral)], dtype=torch.float64))
        elif parameter.name in ("start", "end"):
            axes.append(torch.linspace(*spans[parameter.unit], SHAPES, dtype=torch.float64))
        else:
            values = _values(parameter)
            axes.append(values if parameter.unit == "Hz" else values[:: max(1, len(values) // 2)])
    return torch.cartesian_prod(*axes).reshape(-1, len(effect.table)), strengths


def _nearest(effect: type[Effect], points: Tensor, strengths: list[int], error: Tensor, answer: Tensor) -> Tensor:
    """The point (P,) from which one step of the strengths promises most, after that step."""
    offset, slopes = answer[..., 0], answer[..., 1:].movedim(1, 0)
    left = error[:, None] + offset
    normal = slopes.mT @ slopes
    ridge = 1e-3 * torch.diagonal(normal, dim1=1, dim2=2) + 1e-30
    pull = -(slopes.mT @ left.T[..., None])[..., 0]
    steps = torch.linalg.solve(normal + torch.diag_embed(ridge), pull[..., None])[..., 0]
    after = (left + torch.einsum("gnk,gk->ng", slopes, steps)).square().sum(0)
    best = int(after.argmin())
    out = points[best].clone()
    out[strengths] += steps[best]
    return _inside(effect, out)


def _climbed(view: View, effect: type[Effect], point: Tensor) -> Lead | None:
    """The lead that Gauss-Newton's method with damping (Levenberg 1944) reaches from a point (P,)."""
    every = list(range(len(effect.table)))
    damping, best, found, slopes, left = 1e-2, -math.inf, point, None, view.seen.error
    for _ in range(STEPS):
        answer = view.answer(effect, point[None], every, True)[:, 0]
        now = view.seen.error + answer[:, 0]
        gain = float(0.5 * (view.seen.error.square().sum() - now.square().sum()))
        if gain > best:
            damping, settled = damping / 5, gain - best < SETTLED
            best, found, slopes, left = gain, point, answer[:, 1:], now
            if settled:
                break
        else:
            damping *= 10
        assert slopes is not None  # the first gain is beyond none
        normal = slopes.T @ slopes
        normal = normal + torch.diag(damping * normal.diagonal() + 1e-12 * normal.diagonal().max() + 1e-30)
        point = _inside(effect, found - torch.linalg.solve(normal, slopes.T @ left))
    return Lead(effect, tuple(found.tolist()), best) if best > 0 else None


def _inside(effect: type[Effect], point: Tensor) -> Tensor:
    low, high = (torch.tensor([getattr(p, end) for p in effect.table], dtype=point.dtype) for end in ("low", "high"))
    return point.clamp(low, high)


def grid(effect: type[Effect], spans: dict[str, tuple[float, float]]) -> tuple[Tensor, list[int]]:
    """Parameters (G, P) to try, and the columns to which the effect is proportional.

    `spans` gives by unit where the data are: regions are looked for there.
    """
    names = [parameter.name for parameter in effect.table]
    linear = [k for k, p in enumerate(effect.table) if p.linear and p.neutral is not None]
    axes = []
    for parameter in effect.table:
        if parameter.name in ("start", "end"):
            axes.append(torch.linspace(*spans[parameter.unit], EDGES, dtype=torch.float64))
        else:
            axes.append(_values(parameter))
    points = torch.cartesian_prod(*axes).reshape(-1, len(names))
    if {"start", "end"} <= set(names):
        points = points[points[:, names.index("start")] < points[:, names.index("end")]]
    return points, linear


def _values(parameter: Parameter) -> Tensor:
    low, high, neutral = parameter.low, parameter.high, parameter.neutral
    if parameter.linear and neutral is not None:
        return torch.tensor([neutral], dtype=torch.float64)
    if parameter.unit == "Hz":
        ends = torch.tensor([low, high]).log10().tolist()
        return torch.logspace(ends[0], ends[1], FREQUENCIES, dtype=torch.float64)
    if parameter.name == "phase":
        return torch.linspace(low, high, PHASES + 1, dtype=torch.float64)[:-1]
    if neutral is None:
        return torch.linspace(low, high, SHAPES + 2, dtype=torch.float64)[1:-1]
    shares = torch.cat((torch.logspace(-2.7, -1, STRENGTHS), torch.linspace(0.15, 1, STRENGTHS))).double()
    return torch.cat([neutral + shares * (end - neutral) for end in (low, high) if end != neutral])


def spans(system: System, rows: Rows, state: Tensor) -> dict[str, tuple[float, float]]:
    """By unit, the least and the greatest of the variable along which regions lie, in states (W, T, n)."""
    inside = rows.inside > 0

    def span(values: Tensor) -> tuple[float, float]:
        return float(values[inside].min()), float(values[inside].max())

    variables = {"time": rows.time} | {v.name: state[..., k] for k, v in enumerate(system.states)}
    return {unit: span(variables[name]) for unit, name in subject_of(system).places.items()}


def _columns(
    system: System,
    effects: list[type[Effect]],
    fits: Fits,
    rows: Rows,
    shapes: Tensor,
    linear: list[int],
    beside: bool,
) -> tuple[Tensor, Tensor]:
    """What every point of a grid adds to drive (W, T - 1, n, M) and reading (W, T, m, M), M = points x columns.

    The columns are those of a unit of each linear parameter from where the effect vanishes; or, `beside` the point,
    of the point itself, and then of a unit of each from there.
    """
    family = Family(system, effects, rows, GLANCE)
    own = shapes.shape[1]
    columns = len(linear) + beside or 1
    tried = shapes[:, None].repeat(1, columns, 1)
    unit = torch.ones(columns, dtype=torch.float64)
    for j, column in enumerate(linear if beside else [], 1):
        # Inwards, so that no parameter leaves its range.
        parameter = effects[-1].table[column]
        unit[j] = CLOSE * (parameter.high - parameter.low)
        tried[:, j, column] += torch.where(shapes[:, column] + unit[j] > parameter.high, -unit[j], unit[j])
    for j, column in enumerate([] if beside else linear):
        parameter = effects[-1].table[column]
        nothing = float(parameter.neutral or 0.0)
        end = parameter.high if parameter.high > nothing else parameter.low
        unit[j] = PROBE * (end - nothing)
        tried[:, j, column] = nothing + unit[j]
    tried = tried.reshape(-1, own)
    neutral = torch.tensor([0.0 if p.neutral is None else p.neutral for p in effects[-1].table], dtype=torch.float64)
    tried = torch.cat((neutral[None], tried))
    theta = torch.cat((fits.theta[0].expand(len(tried), -1), tried), 1)
    # The base's own value of a shape has no meaning; only what switches the effect off counts.
    for j, parameter in enumerate(effects[-1].table):
        if parameter.neutral is None:
            theta[0, j - own] = tried[1, j]
    windows, length = rows.shape
    commands = family.commands(theta)[:, :, :-1].flatten(0, 2)
    count, n = len(theta), fits.state.shape[-1]

    def spread(x: Tensor) -> Tensor:
        return x[None].expand(count, *x.shape).reshape(-1, *x.shape[2:])

    def each(used: int) -> Tensor:
        return theta[:, None].expand(-1, windows * used, -1).flatten(0, 1)

    state = fits.state[0]
    after = family.step(each(length - 1), commands, spread(rows.time[:, :-1]), spread(state[:, :-1]))
    seen = family.measure(each(length), spread(state))
    after = after.reshape(count, windows, length - 1, n)
    seen = seen.reshape(count, windows, length, -1)

    def change(values: Tensor) -> Tensor:
        by_point = (values[1:] - values[:1]).unflatten(0, (len(shapes), columns))
        if not beside:
            return (by_point.flatten(0, 1)).movedim(0, -1) / unit.repeat(len(shapes))
        own = by_point[:, :1]
        steps = (tried[1:].unflatten(0, (len(shapes), columns)) - shapes[:, None]).sum(-1)[:, 1:]
        slopes = (by_point[:, 1:] - own) / steps.reshape(*steps.shape, *[1] * (by_point.dim() - 2))
        return torch.cat((own, slopes), 1).flatten(0, 1).movedim(0, -1)

    return change(after) * rows.inside[:, 1:, None, None], -change(seen) * rows.used[..., None]


def _best(effect: type[Effect], shapes: Tensor, linear: list[int], error: Tensor, answer: Tensor) -> Lead | None:
    """The point of a grid that takes most from `error` (N,), given the answers (N, G, columns)."""
    if not linear:
        gains = 0.5 * (error.square().sum() - (error[:, None] + answer[..., 0]).square().sum(0))
        best = int(gains.argmax())
        return Lead(effect, tuple(shapes[best].tolist()), float(gains[best])) if gains[best] > 0 else None
    answer = answer.movedim(1, 0)
    normal = answer.mT @ answer
    ridge = 1e-9 * torch.diagonal(normal, dim1=1, dim2=2).mean(1) + 1e-30
    normal = normal + ridge[:, None, None] * torch.eye(len(linear), dtype=error.dtype)
    pull = -(answer.mT @ error)
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
    return Lead(effect, tuple(values.tolist()), float(gains[best]))

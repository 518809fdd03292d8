"""Which effects are worth fitting beside a fitted set: a linear answer for a grid of shapes and sizes of each.

Where a small effect is added, the innovations of the filter change by what its one-step disturbances become when
passed through the same gains. So a whole grid is scored by one pass of the filter's means, without refitting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    seen = Innovations(Family(system, effects, rows), fits)
    seen_at = spans(system, rows, fits.state[0])
    leads = []
    for effect in candidates:
        shapes, linear = grid(effect, seen_at)
        answer = seen.answer(*_columns(system, [*effects, effect], fits, rows, shapes, linear))
        lead = _best(effect, shapes, linear, seen.error, answer.reshape(len(answer), len(shapes), -1))
        if lead is not None:
            leads.append(lead)
    return sorted(leads, key=lambda lead: -lead.gain)


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
    system: System, effects: list[type[Effect]], fits: Fits, rows: Rows, shapes: Tensor, linear: list[int]
) -> tuple[Tensor, Tensor]:
    """What every point of a grid adds to drive (W, T - 1, n, M) and reading (W, T, m, M), M = points x columns."""
    family = Family(system, effects, rows, GLANCE)
    own = shapes.shape[1]
    tried = shapes[:, None].repeat(1, max(1, len(linear)), 1)
    unit = torch.ones(max(1, len(linear)), dtype=torch.float64)
    for j, column in enumerate(linear):
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
    scale = unit.repeat(len(shapes)) if linear else torch.ones(len(tried) - 1, dtype=torch.float64)
    drive = (after[1:] - after[:1]).movedim(0, -1) / scale * rows.inside[:, 1:, None, None]
    reading = -(seen[1:] - seen[:1]).movedim(0, -1) / scale * rows.used[..., None]
    return drive, reading


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

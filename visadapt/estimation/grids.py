"""Parameter values at which effects are tried: where a strength, a shape, a phase or the edge of a region may lie."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.effects import Effect, Parameter, Role
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

SMALL_POINTS, LARGE_POINTS = 5, 9
"""Values on either side of neutral, for a strength that the effect is not proportional to: the first number spaced
logarithmically up to SMALL_SHARE of the range, the second evenly beyond."""

SMALL_SHARE = 0.1  # Share of its range, from neutral, up to which a strength is small

EDGE_POINTS, FREQUENCY_POINTS, PHASE_POINTS, SHAPE_POINTS = 13, 24, 8, 5
"""Values of a region's start or end, of a frequency, of a phase, and of any other shape parameter."""

START_STRENGTH = 0.05
"""Share of the way from neutral to the end of its range at which each of several strengths starts."""

Spans = Mapping[str, tuple[float, float]]
"""By unit, the interval that the recording covers of the variable along which regions of that unit lie; and, by
Role.COMMAND, that of the sizes of commands."""


def strengths(effect: type[Effect]) -> list[int]:
    """Columns of the effect's strengths."""
    return [k for k, parameter in enumerate(effect.table) if parameter.is_strength]


def column_of(effect: type[Effect], role: Role) -> int:
    """Column of the effect's first parameter with this role."""
    return next(k for k, parameter in enumerate(effect.table) if parameter.role is role)


def is_proportional(effect: type[Effect]) -> bool:
    """Whether the effect has strengths, and is proportional to all of them."""
    columns = strengths(effect)
    return bool(columns) and all(effect.table[k].linear for k in columns)


def neutral_point(effect: type[Effect]) -> Tensor:
    """(P,) the neutral values of the effect's parameters; 0 for those that have none."""
    return torch.tensor([0.0 if p.neutral is None else p.neutral for p in effect.table], dtype=torch.float64)


def grid(effect: type[Effect], spans: Spans, frequencies: Tensor | None = None) -> Tensor:
    """Parameter values (G, P) of an effect that is proportional to its strengths, which are neutral; with `frequencies`
    those are the frequencies."""

    def axis(parameter: Parameter) -> Tensor:
        if frequencies is not None and parameter.role is Role.FREQUENCY:
            return frequencies
        return _edges(parameter, spans, EDGE_POINTS) if parameter.is_edge else values_of(parameter)

    axes = [axis(parameter) for parameter in effect.table]
    points = torch.cartesian_prod(*axes).reshape(-1, len(effect.table))
    if (region := effect.region()) is not None:
        start, end = (effect.table.index(edge) for edge in region)
        points = points[points[:, start] < points[:, end]]
    return points


def starts(effect: type[Effect], spans: Spans) -> Tensor:
    """Points (G, P) from which Gauss-Newton steps of the effect's strengths start.

    A single strength is tried on a grid, since the derivative by it may be zero far from the best value: a saturation
    limit that no command reaches changes nothing. Several strengths start slightly off neutral, since the derivatives
    at neutral are zero if the effect acts only when more than one of them is off neutral.
    """
    several = len(strengths(effect)) > 1
    axes = []
    for parameter in effect.table:
        if parameter.neutral is not None and several:
            end = parameter.high if parameter.high > parameter.neutral else parameter.low
            axes.append(
                torch.tensor([parameter.neutral + START_STRENGTH * (end - parameter.neutral)], dtype=torch.float64)
            )
        elif parameter.is_edge:
            axes.append(_edges(parameter, spans, SHAPE_POINTS))
        else:
            values = values_of(_up_to_largest_command(parameter, spans))
            coarse = parameter.neutral is None and parameter.role is not Role.FREQUENCY
            axes.append(values[:: max(1, len(values) // 2)] if coarse else values)
    return torch.cartesian_prod(*axes).reshape(-1, len(effect.table))


def _edges(parameter: Parameter, spans: Spans, count: int) -> Tensor:
    return torch.linspace(*spans.get(parameter.unit, (parameter.low, parameter.high)), count, dtype=torch.float64)


def _up_to_largest_command(parameter: Parameter, spans: Spans) -> Parameter:
    """The parameter; if a size of the command, with a range that ends at the largest one recorded."""
    largest = spans.get(Role.COMMAND, (0.0, math.inf))[1]
    if parameter.role is not Role.COMMAND or not parameter.low < largest < parameter.high:
        return parameter
    neutral = largest if parameter.neutral == parameter.high else parameter.neutral
    return replace(parameter, high=largest, neutral=neutral)


def values_of(parameter: Parameter) -> Tensor:
    """(G,) values of a parameter that is no edge of a region; neutral alone, where the effect is proportional to it."""
    low, high, neutral = parameter.low, parameter.high, parameter.neutral
    if parameter.linear and neutral is not None:
        return torch.tensor([neutral], dtype=torch.float64)
    if parameter.role is Role.FREQUENCY:
        ends = torch.tensor([low, high]).log10().tolist()
        return torch.logspace(ends[0], ends[1], FREQUENCY_POINTS, dtype=torch.float64)
    if parameter.role is Role.WAVES:
        return torch.arange(math.ceil(low), math.floor(high) + 1, dtype=torch.float64)
    if parameter.role is Role.PHASE:
        return torch.linspace(low, high, PHASE_POINTS + 1, dtype=torch.float64)[:-1]
    if neutral is None:
        return torch.linspace(low, high, SHAPE_POINTS + 2, dtype=torch.float64)[1:-1]
    small = torch.logspace(-2.7, math.log10(SMALL_SHARE), SMALL_POINTS, dtype=torch.float64)
    shares = torch.cat((small, torch.linspace(0.15, 1, LARGE_POINTS, dtype=torch.float64)))
    return torch.cat([neutral + shares * (end - neutral) for end in (low, high) if end != neutral])


def spans(system: System, rows: Segments, state: Tensor) -> dict[str, tuple[float, float]]:
    """By unit, the smallest and largest value, along states (W, T, n), of the variable along which regions lie; and the
    largest size of a command."""
    inside = rows.inside > 0

    def span(values: Tensor) -> tuple[float, float]:
        return float(values[inside].min()), float(values[inside].max())

    variables = {"time": rows.time} | {v.name: state[..., k] for k, v in enumerate(system.states)}
    found = {unit: span(variables[name]) for unit, name in profile_of(system).region_variables.items()}
    return found | {Role.COMMAND: (0.0, float(rows.command.abs().max()))}


def size(effect: type[Effect], points: Tensor) -> Tensor:
    """(G,) how far the strengths of points (G, P) are from neutral, as a share of their range; the largest of them."""
    away = [
        (points[:, k] - parameter.neutral).abs() / (parameter.high - parameter.low)
        for k, parameter in enumerate(effect.table)
        if parameter.neutral is not None
    ]
    return torch.stack([*away, torch.zeros(len(points), dtype=points.dtype)]).amax(0)


def clamped_to_range(effect: type[Effect], points: Tensor) -> Tensor:
    """Points (..., P) with every parameter limited to its range."""
    low, high = (torch.tensor([getattr(p, end) for p in effect.table], dtype=points.dtype) for end in ("low", "high"))
    return points.clamp(low, high)

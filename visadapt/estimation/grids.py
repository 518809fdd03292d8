"""The parameter values at which the screening tries an effect."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from visadapt.effects import Effect, Parameter, Role
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

STRENGTH_POINTS = 9
"""Values on either side of neutral, for a strength that the effect is not proportional to: this many spaced
logarithmically up to a tenth of the range, and as many evenly beyond."""

EDGE_POINTS, FREQUENCY_POINTS, PHASE_POINTS, SHAPE_POINTS = 13, 24, 8, 5
"""Values of a region's start or end, of a frequency, of a phase, and of any other shape parameter."""

START_STRENGTH = 0.05
"""Share of its range, from neutral, at which a strength starts that is found by Gauss-Newton steps."""

Spans = Mapping[str, tuple[float, float]]
"""By unit, the interval that the recording covers of the variable along which regions of that unit lie."""


def grid(effect: type[Effect], spans: Spans) -> tuple[Tensor, list[int]]:
    """Parameter values (G, P) to try, and the columns of parameters that the effect is proportional to."""
    linear = [k for k, p in enumerate(effect.table) if p.linear and p.neutral is not None]
    axes = []
    for parameter in effect.table:
        if parameter.is_edge:
            axes.append(_edges(parameter, spans, EDGE_POINTS))
        else:
            axes.append(_values(parameter))
    points = torch.cartesian_prod(*axes).reshape(-1, len(effect.table))
    if (region := effect.region()) is not None:
        start, end = (effect.table.index(edge) for edge in region)
        points = points[points[:, start] < points[:, end]]
    return points, linear


def needs_descent(effect: type[Effect]) -> bool:
    """Whether a grid would be too large: the effect is not proportional to several of its strengths."""
    return sum(p.neutral is not None and not p.linear for p in effect.table) > 1


def starts(effect: type[Effect], spans: Spans) -> tuple[Tensor, list[int]]:
    """Points (G, P) from which Gauss-Newton steps start, and the columns of the effect's strengths.

    Strengths start slightly off neutral: at neutral the derivative vanishes where it takes several of them to act.
    """
    strengths = [k for k, p in enumerate(effect.table) if p.neutral is not None]
    axes = []
    for parameter in effect.table:
        if parameter.neutral is not None:
            end = parameter.high if parameter.high > parameter.neutral else parameter.low
            axes.append(
                torch.tensor([parameter.neutral + START_STRENGTH * (end - parameter.neutral)], dtype=torch.float64)
            )
        elif parameter.is_edge:
            axes.append(_edges(parameter, spans, SHAPE_POINTS))
        else:
            values = _values(parameter)
            axes.append(values if parameter.role is Role.FREQUENCY else values[:: max(1, len(values) // 2)])
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
    shares = torch.cat((torch.logspace(-2.7, -1, STRENGTH_POINTS), torch.linspace(0.15, 1, STRENGTH_POINTS))).double()
    return torch.cat([neutral + shares * (end - neutral) for end in (low, high) if end != neutral])


def spans(system: System, rows: Segments, state: Tensor) -> dict[str, tuple[float, float]]:
    """By unit, the smallest and largest value, along states (W, T, n), of the variable along which regions lie."""
    inside = rows.inside > 0

    def span(values: Tensor) -> tuple[float, float]:
        return float(values[inside].min()), float(values[inside].max())

    variables = {"time": rows.time} | {v.name: state[..., k] for k, v in enumerate(system.states)}
    return {unit: span(variables[name]) for unit, name in profile_of(system).region_variables.items()}

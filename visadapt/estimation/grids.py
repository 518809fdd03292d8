"""At which of its parameters' values an effect is tried where it is not known yet."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from visadapt.effects import Effect, Parameter, Role
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

STRENGTHS = 9
"""Values tried, to either side, of a strength to which an effect is not proportional: so many up to a tenth of its
range, each a factor more, and as many beyond."""

EDGES = 13
FREQUENCIES = 24
PHASES = 8
SHAPES = 5
"""Values tried of a start or an end, a frequency, a phase, and any other shape."""

NUDGE = 0.05
"""Share of its range at which a strength begins that is sought by steps."""

Spans = Mapping[str, tuple[float, float]]
"""By unit, where the data are: regions are looked for there."""


def grid(effect: type[Effect], spans: Spans) -> tuple[Tensor, list[int]]:
    """Parameters (G, P) to try, and the columns to which the effect is proportional."""
    linear = [k for k, p in enumerate(effect.table) if p.linear and p.neutral is not None]
    axes = []
    for parameter in effect.table:
        if parameter.is_edge:
            axes.append(_edges(parameter, spans, EDGES))
        else:
            axes.append(_values(parameter))
    points = torch.cartesian_prod(*axes).reshape(-1, len(effect.table))
    if (region := effect.region()) is not None:
        start, end = (effect.table.index(edge) for edge in region)
        points = points[points[:, start] < points[:, end]]
    return points, linear


def is_climbed(effect: type[Effect]) -> bool:
    """Whether an effect has too many strengths for a grid, and is not proportional to them."""
    return sum(p.neutral is not None and not p.linear for p in effect.table) > 1


def starts(effect: type[Effect], spans: Spans) -> tuple[Tensor, list[int]]:
    """Points (G, P) from which an effect's parameters are sought by steps, and the columns of its strengths.

    Strengths begin a little beside what makes the effect vanish, since it may take several to make it act.
    """
    strengths = [k for k, p in enumerate(effect.table) if p.neutral is not None]
    axes = []
    for parameter in effect.table:
        if parameter.neutral is not None:
            end = parameter.high if parameter.high > parameter.neutral else parameter.low
            axes.append(torch.tensor([parameter.neutral + NUDGE * (end - parameter.neutral)], dtype=torch.float64))
        elif parameter.is_edge:
            axes.append(_edges(parameter, spans, SHAPES))
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
        return torch.logspace(ends[0], ends[1], FREQUENCIES, dtype=torch.float64)
    if parameter.role is Role.PHASE:
        return torch.linspace(low, high, PHASES + 1, dtype=torch.float64)[:-1]
    if neutral is None:
        return torch.linspace(low, high, SHAPES + 2, dtype=torch.float64)[1:-1]
    shares = torch.cat((torch.logspace(-2.7, -1, STRENGTHS), torch.linspace(0.15, 1, STRENGTHS))).double()
    return torch.cat([neutral + shares * (end - neutral) for end in (low, high) if end != neutral])


def spans(system: System, rows: Segments, state: Tensor) -> dict[str, tuple[float, float]]:
    """By unit, the least and the greatest of the variable along which regions lie, in states (W, T, n)."""
    inside = rows.inside > 0

    def span(values: Tensor) -> tuple[float, float]:
        return float(values[inside].min()), float(values[inside].max())

    variables = {"time": rows.time} | {v.name: state[..., k] for k, v in enumerate(system.states)}
    return {unit: span(variables[name]) for unit, name in profile_of(system).places.items()}

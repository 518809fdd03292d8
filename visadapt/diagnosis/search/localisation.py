"""Where the gap lies: the regions of states, command and time in which the disturbance stands out."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from visadapt.diagnosis.result import Region
from visadapt.diagnosis.search.disturbance import Disturbance
from visadapt.diagnosis.search.unexplained import PREVIOUS_PREFIX

BINS = 12
"""Quantile bins of a variable; regions start and end at their edges."""

SHIFTS = 400
"""Random shifts in time of the disturbance against the variables, from which a p-value is counted."""

MAX_P_VALUE = 0.01
"""p-value up to which a region is reported; a variable's p-value cannot be below 1 / (1 + SHIFTS), so the limit rises
with the number of variables."""

REGION_SHARE = 0.6
"""A region holds at most this share of the rows, and more than this share of the disturbance's power."""


def regions(found: Disturbance, seed: int) -> list[Region]:
    """Intervals of a variable in which the disturbance's power is concentrated, lowest p-value first.

    Every interval between two quantiles of every variable is tried. The p-value compares the interval of greatest
    excess power with the greatest among all intervals after random shifts in time, which corrects for their number;
    it is multiplied by the number of variables (Bonferroni).
    """
    here = found.valid.flatten() > 0
    power = found.power.flatten()[here]
    generator = torch.Generator().manual_seed(seed)
    shifts = torch.randint(1, len(power), (SHIFTS,), generator=generator)
    shifted = torch.stack([power, *(power.roll(int(k)) for k in shifts)])
    out = []
    for name, values in found.variables.items():
        edges, bins = binned(values.flatten()[here])
        if len(edges) < 4 or name.startswith(PREVIOUS_PREFIX):
            continue
        count = torch.zeros(len(edges) - 1, dtype=power.dtype).index_add_(0, bins, torch.ones_like(power))
        total = torch.zeros(len(shifted), len(edges) - 1, dtype=power.dtype).index_add_(1, bins, shifted)
        first, last = torch.triu_indices(len(edges), len(edges), 1)
        count, total = _between(count, first, last), _between(total, first, last)
        share = count / len(power)
        excess = (total - count) / (count * (1 - share)).sqrt().clamp(min=1e-9)
        excess = torch.where((share <= REGION_SHARE) & (count >= 5), excess, -math.inf)
        strongest = excess.max(1).values
        best = int(excess[0].argmax())
        p_value = (1 + int((strongest[1:] >= strongest[0]).sum())) / (1 + SHIFTS)
        p_value = min(1.0, p_value * len(found.variables))
        contained = float(total[0, best] / len(power))
        if p_value <= max(MAX_P_VALUE, len(found.variables) / (1 + SHIFTS)) and contained > REGION_SHARE:
            out.append(Region(name, float(edges[first[best]]), float(edges[last[best]]), contained, p_value))
    return sorted(out, key=lambda region: (region.p_value, -region.share))


def share(found: Disturbance, variable: str, start: float, end: float) -> float:
    """Share of the disturbance's power between two values of a variable."""
    values = found.variables[variable]
    power = found.power
    return float((power * (values >= start) * (values <= end)).sum() / power.sum().clamp(min=1e-300))


def binned(values: Tensor) -> tuple[Tensor, Tensor]:
    """Edges of BINS quantile bins of values (N,), fewer where values repeat, and the bin (N,) of each value."""
    edges = torch.quantile(values, torch.linspace(0, 1, BINS + 1, dtype=values.dtype)).unique()
    return edges, torch.bucketize(values, edges[1:-1])


def _between(values: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """Sums of values (..., bins) from edges `first` (K,) to edges `last` (K,)."""
    sums = torch.cat((torch.zeros_like(values[..., :1]), values.cumsum(-1)), -1)
    return sums[..., last] - sums[..., first]

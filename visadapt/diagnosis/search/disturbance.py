"""The loads that act in addition to what a set of effects explains, and where they stand out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.diagnosis.result import Region
from visadapt.diagnosis.search.unexplained import PREVIOUS_PREFIX, loads_of, variables_of
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.kalman import backward, forward
from visadapt.estimation.likelihood import FitState, linear_problem, variances


@dataclass(frozen=True)
class Disturbance:
    """Smoothed disturbance estimate over W windows of T rows."""

    load: Tensor  # (W, T - 1, loads) in N or N m, constant over the period after a row
    valid: Tensor  # (W, T - 1) 1 within the windows, 0 in their padding
    variables: Mapping[str, Tensor]  # (W, T - 1) states, commands, time and episode by name

    @property
    def power(self) -> Tensor:
        """(W, T - 1) mean square of the loads, each divided by its own mean square over the valid rows."""
        square = self.load.square() * self.valid[..., None]
        mean = square.sum((0, 1)) / self.valid.sum()
        return (square / mean.clamp(min=1e-300)).mean(-1)


def disturbance(model: CandidateModel, fits: FitState, log_process: Tensor) -> Disturbance:
    """The loads with which a fitted set follows the recording, given log process noise variances (1, G)."""
    fits = replace(fits, log_process=log_process)
    driven = model.profile.driven_columns
    rows = model.rows
    problem = linear_problem([model], fits)
    process, noise = variances(model, fits, problem)
    _, adjoint = backward(forward(problem, process, noise))
    added = -(process @ adjoint[:, 1:, :, :1])[..., driven, 0]
    by_load = loads_of(model, fits)[:, :, driven]
    # A coordinate that sticks does not respond to a load, nor does the padding: the pseudo-inverse gives 0 there.
    valid = rows.inside[:, 1:]
    load = (torch.linalg.pinv(by_load, rtol=1e-6) @ added[..., None])[..., 0] * valid[..., None]
    variables = {name: values[:, :-1] for name, values in variables_of(model, fits.state[0]).items()}
    variables["episode"] = rows.episode[:, None].double().expand_as(valid)
    return Disturbance(load, valid, variables)


BINS = 12  # Quantile bins of a variable; regions start and end at their edges

SHIFTS = 400  # Random shifts in time of the disturbance against the variables, from which a p-value is counted

MAX_P_VALUE = 0.01
"""p-value up to which a region is reported; a variable's p-value cannot be below 1 / (1 + SHIFTS), so the limit rises
with the number of variables."""

REGION_SHARE = 0.6
"""A region holds at most this share of the rows, and more than this share of the disturbance's power."""


def regions_of(found: Disturbance, seed: int) -> list[Region]:
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
    binnings = {
        name: binned(values.flatten()[here])
        for name, values in found.variables.items()
        if not name.startswith(PREVIOUS_PREFIX)
    }
    tested = {name: (edges, bins) for name, (edges, bins) in binnings.items() if len(edges) >= 4}
    out = []
    for name, (edges, bins) in tested.items():
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
        p_value = min(1.0, p_value * len(tested))
        contained = float(total[0, best] / len(power))
        if p_value <= max(MAX_P_VALUE, len(tested) / (1 + SHIFTS)) and contained > REGION_SHARE:
            within = found.variables[name].flatten()[here][(bins >= first[best]) & (bins < last[best])]
            out.append(Region(name, float(within.min()), float(within.max()), contained, p_value))
    return sorted(out, key=lambda region: (region.p_value, -region.share))


def share_between(found: Disturbance, variable: str, start: float, end: float) -> float:
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

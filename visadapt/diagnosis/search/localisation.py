"""Where the gap lies: the force that the source leaves unexplained, over states, command and time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from visadapt.diagnosis.result import Profile, Region, Spectrum
from visadapt.diagnosis.search.unexplained import PREVIOUS, loads_of, variables_of
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.kalman import backward, forward
from visadapt.estimation.likelihood import FitState, linear_problem, variances

BINS = 12
"""Bins of a variable, with as many rows each."""

SHIFTS = 400
"""Random shifts in time of the residual against the variables, from which a p-value is counted."""

CERTAIN = 0.01
LOCAL = 0.6
"""A region is reported below this p-value, if it holds at most this share of the rows and more than as much of the
residual's power."""


@dataclass(frozen=True)
class Disturbance:
    """What acts on the system beside what a set of effects explains, smoothed."""

    load: Tensor
    """(W, T - 1, loads)"""
    there: Tensor
    """(W, T - 1) 1 where there is one"""
    variables: Mapping[str, Tensor]
    """(W, T - 1) by name"""

    @property
    def power(self) -> Tensor:
        """(W, T - 1) of force and torque, which weigh alike; 1 in the mean over the rows that are there."""
        square = self.load.square() * self.there[..., None]
        mean = square.sum((0, 1)) / self.there.sum()
        return (square / mean.clamp(min=1e-300)).mean(-1)


def disturbance(model: CandidateModel, fits: FitState, log_process: Tensor) -> Disturbance:
    """The loads that bring the set of `fits` to follow the recording, with process noise (1, 2) allowed to them."""
    fits = replace(fits, log_process=log_process)
    driven = model.profile.columns
    rows = model.rows
    problem = linear_problem([model], fits)
    process, noise = variances(model, fits.log_process, fits.log_noise)
    _, adjoint = backward(problem, forward(problem, process, noise))
    added = -(adjoint[..., 0] @ process)[:, 1:, driven]
    by_load = loads_of(model, fits)[:, :, driven]
    # Each velocity answers to a load of its own; beyond a window's end they answer to nothing.
    there = rows.inside[:, 1:]
    by_load = torch.where(there[..., None, None] > 0, by_load, torch.eye(len(driven), dtype=by_load.dtype))
    load = torch.linalg.solve(by_load, added[..., None])[..., 0] * there[..., None]
    variables = {name: place[:, :-1] for name, place in variables_of(model, fits.state[0]).items()}
    variables["episode"] = rows.episode[:, None].double().expand_as(there)
    return Disturbance(load, there, variables)


def regions(found: Disturbance, seed: int) -> list[Region]:
    """Stretches of a variable that hold more of the disturbance's power than their share of the rows, surest first.

    Every stretch between any two of BINS quantiles of every variable is looked at. The p-value is that of the most
    striking one, against the most striking ones where the same residual is shifted in time by chance, so it counts
    all the looking.
    """
    here = found.there.flatten() > 0
    power = found.power.flatten()[here]
    generator = torch.Generator().manual_seed(seed)
    shifts = torch.randint(1, len(power), (SHIFTS,), generator=generator)
    shifted = torch.stack([power, *(power.roll(int(k)) for k in shifts)])
    out = []
    for name, values in found.variables.items():
        place = values.flatten()[here]
        edges, bins = _binned(place)
        if len(edges) < 4 or name.startswith(PREVIOUS):
            continue
        count = torch.zeros(len(edges) - 1, dtype=power.dtype).index_add_(0, bins, torch.ones_like(power))
        total = torch.zeros(len(shifted), len(edges) - 1, dtype=power.dtype).index_add_(1, bins, shifted)
        first, last = torch.triu_indices(len(edges), len(edges), 1)
        count, total = _between(count, first, last), _between(total, first, last)
        share = count / len(power)
        excess = (total - count) / (count * (1 - share)).sqrt().clamp(min=1e-9)
        excess = torch.where((share <= LOCAL) & (count >= 5), excess, -math.inf)
        strongest = excess.max(1).values
        best = int(excess[0].argmax())
        p_value = (1 + int((strongest[1:] >= strongest[0]).sum())) / (1 + SHIFTS)
        # One p-value for each variable, of which there are several.
        p_value = min(1.0, p_value * len(found.variables))
        held = float(total[0, best] / len(power))
        if p_value <= max(CERTAIN, len(found.variables) / (1 + SHIFTS)) and held > LOCAL:
            out.append(Region(name, float(edges[first[best]]), float(edges[last[best]]), held, p_value))
    return sorted(out, key=lambda region: (region.p_value, -region.share))


def share(found: Disturbance, variable: str, start: float, end: float) -> float:
    """Share of the disturbance's power between two values of a variable."""
    place = found.variables[variable]
    power = found.power
    return float((power * (place >= start) * (place <= end)).sum() / power.sum().clamp(min=1e-300))


def _binned(place: Tensor) -> tuple[Tensor, Tensor]:
    """Edges of BINS quantiles of values (N,), fewer where values repeat, and the bin of each."""
    edges = torch.quantile(place, torch.linspace(0, 1, BINS + 1, dtype=place.dtype)).unique()
    return edges, torch.bucketize(place, edges[1:-1])


def _between(values: Tensor, first: Tensor, last: Tensor) -> Tensor:
    sums = torch.cat((torch.zeros_like(values[..., :1]), values.cumsum(-1)), -1)
    return sums[..., last] - sums[..., first]


def profile(name: str, unit: str, quantity: str, before: Disturbance, after: Disturbance) -> Profile:
    """The mean of the first residual load over one variable, with and without the causes."""
    here = before.there.flatten() > 0
    place = before.variables[name].flatten()[here]
    edges, bins = _binned(place)
    count = len(edges) - 1
    means = []
    for found in (before, after):
        size = found.load[..., 0].flatten()[here]
        own = [size[bins == k] for k in range(count)]
        means.append(np.array([float(s.mean()) if len(s) else math.nan for s in own]))
        means.append(np.array([float(s.std() / math.sqrt(len(s))) if len(s) > 1 else math.nan for s in own]))
    centres = np.array([float(place[bins == k].mean()) if bool((bins == k).any()) else math.nan for k in range(count)])
    return Profile(name, unit, quantity, "N", centres, *means)


def spectrum(quantity: str, before: Disturbance, after: Disturbance, period: float) -> Spectrum:
    """Mean power spectral density of the first residual load over the windows (Welch 1967, one Hann window each)."""
    densities = []
    for found in (before, after):
        size = found.load[..., 0]
        window = torch.hann_window(size.shape[1], dtype=size.dtype)
        power = torch.fft.rfft(size * window, dim=1).abs().square().mean(0)
        densities.append((2 * period * power / window.square().sum()).numpy())
    frequency = np.fft.rfftfreq(before.load.shape[1], period)
    return Spectrum(quantity, "N2/Hz", frequency, *densities)

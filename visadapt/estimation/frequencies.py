"""Frequencies at which a periodic effect would best explain the innovations of a fitted set.

Within T seconds, two frequencies can be told apart if they differ by about 1 / T. A grid coarse enough to be tried
point by point would miss the best frequency between two of its points. So all frequencies are scored at once.

Let g_t be the first-order decrease of half the sum of squared innovations per unit of the effect's strength, if it acts
in the period after row t alone; one backward pass of the filter gives all g_t. With a strength
A cos(2 pi f t + phase) of the best A and phase, the linear response lowers half the sum of squares by

    |sum_t g_t exp(-2 pi i f t)|^2 / (2 E(f))

E(f) is the sum of squares of the innovations' change under A = 1. It is smooth in f, so it is computed at a few
frequencies and interpolated. The sum over t is one fast Fourier transform, of g_t added up in equal bins of time.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from visadapt.effects import ActuationEffect, DynamicsEffect, Effect, Role
from visadapt.estimation.grids import column_of, neutral_point, strengths, values_of
from visadapt.estimation.sensitivity import Sensitivity

BIN = 0.02
"""Share of the period of the highest frequency that a bin of time lasts."""
PADDING = 8
"""Points of the transform in 1 / T, at least."""
PEAKS = 4
"""Number of frequencies that are returned at most."""


def comes_and_goes(effect: type[Effect]) -> bool:
    """Whether the effect's first strength is multiplied by the cosine of a frequency and a phase."""
    roles = {parameter.role for parameter in effect.table}
    acts = issubclass(effect, (ActuationEffect, DynamicsEffect))
    return acts and {Role.FREQUENCY, Role.PHASE} <= roles and effect.table[strengths(effect)[0]].linear


def likeliest(whole: Sensitivity, some: Sensitivity, effect: type[Effect]) -> Tensor:
    """Frequencies (K,) in Hz to try: at most PEAKS at which the effect explains most, after those of the coarse grid
    that are below 2 / T and so too low to be told apart. The coarse grid itself, if T is too short for any score.

    Args:
        whole: on all windows, from which g_t is computed.
        some: on fewer windows, from which E is computed: too small by one factor for all f, so the best f are the same.
    """
    column, strength = column_of(effect, Role.FREQUENCY), strengths(effect)[0]
    low, high = effect.table[column].low, effect.table[column].high
    coarse = values_of(effect.table[column])
    pull = whole.pull(effect, neutral_point(effect), strength)
    time = (whole.rows.time[:, :-1] + whole.rows.time[:, 1:]) / 2
    inside = whole.rows.inside[:, 1:] > 0
    first, last = float(time[inside].min()), float(time[inside].max())
    if last <= first:
        return coarse
    count = max(1, math.ceil((last - first) * high / BIN))
    width = max(last - first, 1e-9) / count
    bins = ((time[inside] - first) / width).long().clamp(max=count - 1)
    binned = torch.zeros(count, dtype=torch.float64).index_add(0, bins, pull[inside])
    points = 2 ** math.ceil(math.log2(PADDING * count))  # the length of which a transform is fastest
    frequency = torch.fft.rfftfreq(points, width, dtype=torch.float64)
    power = torch.fft.rfft(binned, points).abs().square()
    within = (frequency >= max(low, 1 / (last - first))) & (frequency <= high)
    too_low = coarse[coarse < 2 / (last - first)]
    if int(within.sum()) < 3:
        return coarse
    frequency, power = frequency[within], power[within]
    energy = np.interp(frequency.log(), coarse.log(), _energy(some, effect, coarse))
    gain = power / (2 * torch.from_numpy(energy))
    rises = gain.diff() > 0
    peak = torch.cat((rises.new_ones(1), rises)) & ~torch.cat((rises, rises.new_zeros(1)))
    best = gain.masked_fill(~peak, -math.inf).topk(min(PEAKS, int(peak.sum()))).indices
    return torch.cat((too_low, frequency[best]))


def _energy(some: Sensitivity, effect: type[Effect], frequencies: Tensor) -> Tensor:
    """(F,) E at frequencies (F,): the mean of that of a cosine and of a sine."""
    column, phase = column_of(effect, Role.FREQUENCY), column_of(effect, Role.PHASE)
    points = neutral_point(effect).repeat(2 * len(frequencies), 1)
    points[:, column] = frequencies.repeat(2)
    points[len(frequencies) :, phase] = math.pi / 2
    response = some.by_unit(effect, points, strengths(effect)[:1])[..., 0]
    return response.square().sum(0).view(2, -1).mean(0)

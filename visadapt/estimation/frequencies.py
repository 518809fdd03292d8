"""At which frequencies an effect that comes and goes would explain the innovations of a fitted set best.

In T seconds a frequency is told from others that are 1 / T away, so a grid that is coarse enough to be tried point by
point passes between them. Here all frequencies are scored at once. With g_t what a unit of the effect's strength in row
t alone lowers half the squared innovations by, which one pass of the filter backwards gives, a strength
cos(2 pi f t + phase) of the best size and phase lowers half the squares by

    |sum_t g_t exp(-2 pi i f t)|^2 / (2 E(f))

in the linear response. E(f) is the sum of the squares that a unit of it makes, which is smooth in f and needs few
frequencies. The sums are one fast Fourier transform, of rows sorted into equal bins of time.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from visadapt.effects import ActuationEffect, DynamicsEffect, Effect, Role
from visadapt.estimation.grids import neutral_point, strengths, values_of
from visadapt.estimation.sensitivity import Sensitivity

BIN = 0.02
"""Share of the period of the highest frequency that a bin of time lasts."""
PADDING = 8
"""Points of the transform in 1 / T."""
PEAKS = 4
"""Number of frequencies that are returned at most."""


def comes_and_goes(effect: type[Effect]) -> bool:
    """Whether the effect's first strength is multiplied by the cosine of a frequency and a phase."""
    roles = {parameter.role for parameter in effect.table}
    acts = issubclass(effect, (ActuationEffect, DynamicsEffect))
    return acts and {Role.FREQUENCY, Role.PHASE} <= roles and effect.table[strengths(effect)[0]].linear


def likeliest(whole: Sensitivity, some: Sensitivity, effect: type[Effect]) -> Tensor:
    """Frequencies (K,) in Hz at which the effect explains most, and those that are too low to be told apart.

    Args:
        whole: of all windows, on which they are scored.
        some: of as many windows as are to be used for E, but for a factor that all frequencies share.
    """
    column, strength = _column(effect, Role.FREQUENCY), strengths(effect)[0]
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
    frequency = torch.fft.rfftfreq(PADDING * count, width, dtype=torch.float64)
    power = torch.fft.rfft(binned, PADDING * count).abs().square()
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
    column, phase = _column(effect, Role.FREQUENCY), _column(effect, Role.PHASE)
    points = neutral_point(effect).repeat(2 * len(frequencies), 1)
    points[:, column] = frequencies.repeat(2)
    points[len(frequencies) :, phase] = math.pi / 2
    response = some.by_unit(effect, points, strengths(effect)[:1])[..., 0]
    return response.square().sum(0).view(2, -1).mean(0)


def _column(effect: type[Effect], role: Role) -> int:
    return next(k for k, parameter in enumerate(effect.table) if parameter.role is role)

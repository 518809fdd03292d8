"""Values between samples."""

from __future__ import annotations

import torch
from torch import Tensor


def cubic(time: Tensor, values: Tensor, slopes: Tensor, at: Tensor) -> Tensor:
    """Values (..., K, n) at times (K,) of the cubics through values and slopes (..., T, n) at rising times (T,).

    Hermite's form; times beyond the ends are extrapolated.
    """
    row = (torch.searchsorted(time, at, right=True) - 1).clamp(0, len(time) - 2)
    step = (time[row + 1] - time[row])[:, None]
    s = (at - time[row])[:, None] / step
    before, after = values[..., row, :], values[..., row + 1, :]
    rise, fall = slopes[..., row, :] * step, slopes[..., row + 1, :] * step
    level = before * (1 + 2 * s) * (1 - s) ** 2 + after * s**2 * (3 - 2 * s)
    return level + rise * s * (1 - s) ** 2 - fall * s**2 * (1 - s)

"""What is left of frames that are explained: white noise of the pixels, and structure, which is more than noise."""

from __future__ import annotations

import torch
from torch import Tensor, nn

MAX_FRAME_RATIO = 10.0
"""Mean square residual of a frame, over the median of frames, above which it shows something else: a flash, or no
picture."""

NEIGHBOURS = 3  # px, side of the squares over which noise is averaged away


def white_noise(residual: Tensor) -> float:
    """Standard deviation of the white noise in frames (N, H, W) less what is drawn, in their unit.

    Immerkaer (1996), Fast noise variance estimation, CVIU 64(2); by the median, which is robust to edges in a few
    pixels.

    >>> import torch
    >>> noise = torch.randn(8, 40, 40, generator=torch.Generator().manual_seed(0))
    >>> round(white_noise(0.1 * noise), 2)
    0.1
    """
    mask = residual.new_tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])[None, None]
    bent = nn.functional.conv2d(residual[:, None], mask)
    return float(bent.abs().median()) / 0.6745 / 6  # the median of a normal distribution's magnitude; the mask's norm


def structure(residual: Tensor) -> Tensor:
    """(H, W) mean square over N frames of means over 3 by 3 px of the residual (N, H, W), less the part of white noise.

    Its mean over the frame is 0 where noise is all that is left.
    """
    means = nn.functional.avg_pool2d(residual[:, None], NEIGHBOURS, 1, NEIGHBOURS // 2, count_include_pad=False)[:, 0]
    # A corner has fewer neighbours.
    count = nn.functional.avg_pool2d(torch.ones_like(residual[:1, None]), NEIGHBOURS, 1, NEIGHBOURS // 2)[0, 0]
    return means.square().mean(0) - white_noise(residual) ** 2 / (NEIGHBOURS**2 * count)


def size_of(left: Tensor) -> float:
    """Root mean square of a `structure` (H, W)."""
    return float(left.mean().clamp_min(0).sqrt())


def evenly_spaced(count: int, most: int) -> Tensor:
    """Which of `count` frames to look at: at most `most`, spread evenly from the first to the last.

    >>> evenly_spaced(9, 3)
    tensor([0, 4, 8])
    """
    return torch.linspace(0, count - 1, min(most, count)).long()

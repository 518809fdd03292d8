"""The frame encoder, which policies and residuals that see frames share."""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from visadapt.history import LENGTH, History

N_FEATURES = 128  # Width of the frame encoder's features
N_KINEMATICS = 2 * LENGTH
"""Width of the encoder's readout: latest position and its LENGTH - 1 changes, of cart and pole."""


class FrameEncoder(nn.Module):
    """Four convolutions, kernel 3, stride 2, ReLU (the paper, section 3.2.3) over the last frames, then the actions.

    The frames enter as the latest one minus the background, and twice the differences of successive frames: a fixed
    invertible linear map of the pixels, without which motion is lost against the constant background.

    Args:
        background: (H, W) mean frame in [0, 1], saved with the weights.
        contrast: standard deviation of the frames about it, saved with the weights.
        n_action: width of an action.
    """

    background: Tensor
    contrast: Tensor
    mix: Tensor

    def __init__(self, background: Tensor, contrast: float, n_action: int) -> None:
        super().__init__()
        self.n_action = n_action
        self.register_buffer("background", background.clone())
        self.register_buffer("contrast", torch.as_tensor(contrast, dtype=background.dtype))
        self.register_buffer("mix", frames_to_inputs().to(background.dtype), persistent=False)
        layers = [nn.Conv2d(i, o, 3, stride=2, padding=1) for i, o in pairwise((LENGTH, 8, 16, 32, 32))]
        self.convolutions = nn.ModuleList(layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        rows, columns = (-(-size // 2 ** len(layers)) for size in background.shape)
        width = 32 * rows * columns
        self.join = nn.Sequential(nn.Linear(width + LENGTH * n_action, N_FEATURES), nn.ReLU())
        self.readout = nn.Linear(N_FEATURES, N_KINEMATICS)

    def forward(self, history: History) -> Tensor:
        """Features (B, N_FEATURES) of frames (B, LENGTH, H, W) in [0, 1] and actions (B, LENGTH, n_action)."""
        frames = history.observations
        if frames.shape[-2:] != self.background.shape:
            raise ValueError(
                f"the network was made for frames of {tuple(self.background.shape)} (height, width), "
                f"got {tuple(frames.shape[-2:])}"
            )
        seen = self._first(frames.contiguous(memory_format=torch.channels_last)).relu()
        for convolution in self.convolutions[1:]:
            seen = convolution(seen).relu()
        return self.join(torch.cat((seen.flatten(1), history.actions.flatten(1)), 1))

    def kinematics(self, history: History) -> Tensor:
        """Positions and angles in the frames, (B, N_KINEMATICS), in units of `learning.perception.Paths.scale`."""
        return self.readout(self(history))

    def _first(self, frames: Tensor) -> Tensor:
        """The first convolution: of the latest frame minus background, and twice the differences of successive frames.

        Since that map of the frames is linear, it is folded into the kernel, which saves a pass over large tensors.
        """
        first = self.convolutions[0]
        kernel = torch.einsum("ocij,cf->ofij", first.weight, self.mix / self.contrast)
        still = F.conv2d(self.background[None, None], first.weight[:, :1] / self.contrast, stride=2, padding=1)
        return F.conv2d(frames, kernel, first.bias, stride=2, padding=1) - still


def frames_to_inputs() -> Tensor:
    """(LENGTH, LENGTH) the map from frames, oldest first, to a `FrameEncoder`'s inputs, but for the background."""
    mix = torch.zeros(LENGTH, LENGTH)
    mix[0, -1] = 1.0
    for k in range(1, LENGTH):
        mix[k, k], mix[k, k - 1] = 2.0, -2.0
    return mix

"""Network bodies that policies and residuals share."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from visadapt.history import LENGTH, History

CHANNELS = (8, 16, 32, 32)
FEATURES = 128


class FrameEncoder(nn.Module):
    """Four convolutions, kernel 3, stride 2, ReLU (the paper, section 3.2.3) over the last frames; actions join after.

    The frames enter as the latest one less the background, and the differences of neighbours, magnified: a
    fixed invertible linear map of the same pixels, without which velocities are lost beside the still scene.

    Args:
        background: (H, W) mean frame in [0, 1]; it is saved with the weights, as is `contrast`, their spread.
        n_action: width of an action.
    """

    background: Tensor
    contrast: Tensor

    def __init__(self, background: Tensor, contrast: float, n_action: int) -> None:
        super().__init__()
        self.register_buffer("background", background.clone())
        self.register_buffer("contrast", torch.as_tensor(contrast, dtype=background.dtype))
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise((LENGTH, *CHANNELS)):
            layers += [nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.ReLU()]
        self.convolutions = nn.Sequential(*layers, nn.Flatten())
        with torch.no_grad():
            width = self.convolutions(torch.zeros(1, LENGTH, *background.shape)).shape[1]
        self.join = nn.Sequential(nn.Linear(width + LENGTH * n_action, FEATURES), nn.ReLU())

    def forward(self, history: History) -> Tensor:
        """Features (B, FEATURES) of frames (B, LENGTH, H, W) in [0, 1] and actions (B, LENGTH, n_action)."""
        frames = history.observations
        if frames.shape[-2:] != self.background.shape:
            raise ValueError(
                f"the network was made for frames of {tuple(self.background.shape)} (height, width), "
                f"got {tuple(frames.shape[-2:])}"
            )
        latest = frames[:, -1:] - self.background
        changes = 2 * frames.diff(dim=1)
        seen = self.convolutions(torch.cat((latest, changes), 1) / self.contrast)
        return self.join(torch.cat((seen, history.actions.flatten(1)), 1))


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers of the given widths with tanh between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.Tanh()]
    return nn.Sequential(*layers[:-1])

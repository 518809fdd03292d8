"""Learnt, differentiable renderers: cart position and pole angle to a frame in [0, 1]."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class MLPRenderer(nn.Module):
    """The paper's renderer Psi (section 3.2.3): 4 layers, [32, 128, 256] hidden nodes, tanh. It stays blurry.

    The paper does not say how the state enters or how the weights begin. Here the angle enters as sine and cosine, and
    the first layer begins with weights `WIDE` times larger than usual for x, sine and cosine: a pixel is 1/40 m, and a
    network that begins smooth in its inputs takes far longer to resolve that.
    """

    WIDE = (10.0, 5.0, 5.0)

    def __init__(self, height: int, width: int) -> None:
        super().__init__()
        self.arguments = {"height": height, "width": width}
        self.size = (height, width)
        first, self.last = nn.Linear(3, 32), nn.Linear(256, height * width)
        self.layers = nn.Sequential(
            first,
            nn.Tanh(),
            nn.Linear(32, 128),
            nn.Tanh(),
            nn.Linear(128, 256),
            nn.Tanh(),
        )
        with torch.no_grad():
            first.weight.mul_(torch.tensor(self.WIDE))
            first.bias.mul_(max(self.WIDE))

    @torch.no_grad()
    def start_from(self, frames: Tensor) -> None:
        """Begin with the mean of frames (N, H, W) uint8 as the output at which all hidden units are zero."""
        self.last.bias.copy_((frames.float().mean(0) / 255).flatten())

    def forward(self, x: Tensor, theta: Tensor) -> Tensor:
        """Frames (B, H, W) of cart positions (B,) in m and pole angles (B,) in rad."""
        out: Tensor = self.last(self.layers(torch.stack((x, theta.sin(), theta.cos()), -1)))
        return out.unflatten(-1, self.size)


class Layer(nn.Module):
    """A learnt picture, with learnt opacity, that moves rigidly with the cart and may turn with the pole.

    A point p of the frame (px) shows the picture at R(theta) (p - hinge(x)) + moved, where hinge(x) = origin + gain x
    is the learnt camera and `moved` how far the origin is from its first guess: a better origin turns the picture
    about another point but leaves it where it is at theta = 0, or every step of the camera would blur what the picture
    has learnt so far. The picture has `detail` texels per pixel; `window` is (left, right, top, bottom) in px around
    the first guess of the hinge at theta = 0.
    """

    centre: Tensor
    extent: Tensor

    def __init__(self, window: tuple[float, float, float, float], turns: bool, detail: float = 2.0) -> None:
        super().__init__()
        left, right, top, bottom = window
        columns, rows = int((right - left) * detail) + 1, int((bottom - top) * detail) + 1
        self.turns = turns
        self.register_buffer("centre", torch.tensor([(left + right) / 2, (top + bottom) / 2]))
        self.register_buffer("extent", torch.tensor([(right - left) / 2, (bottom - top) / 2]))
        self.shade = nn.Parameter(torch.zeros(1, rows, columns))
        self.opacity = nn.Parameter(torch.full((1, rows, columns), -2.0))

    def forward(self, pixels: Tensor, hinge: Tensor, theta: Tensor, moved: Tensor) -> Tensor:
        """Premultiplied shade and opacity (B, 2, H, W) at pixels (H, W, 3), each (column, row, 1).

        `hinge` (B, 2) and `moved` (2,) are in px, `theta` (B,) in rad.
        """
        sine, cosine = (theta.sin(), theta.cos()) if self.turns else (0 * theta, 0 * theta + 1)
        turn = torch.stack((torch.stack((cosine, sine), -1), torch.stack((-sine, cosine), -1)), 1)
        turn = turn / self.extent[:, None]
        shift = -(turn @ hinge[..., None])[..., 0] + (moved - self.centre) / self.extent
        # One matrix product maps every pixel of a frame to its place in the picture.
        place = pixels.flatten(0, 1) @ torch.cat((turn, shift[..., None]), -1).transpose(1, 2)
        opacity = self.opacity.sigmoid()
        picture = torch.cat((self.shade.sigmoid() * opacity, opacity))
        # Zero padding makes everything outside the window transparent.
        return F.grid_sample(
            picture.expand(len(theta), -1, -1, -1),
            place.unflatten(1, pixels.shape[:2]),
            align_corners=True,
            padding_mode="zeros",
        )

    @property
    def radius(self) -> float:
        """Largest distance in px between the hinge and a row that the layer can cover, up or down."""
        far = self.centre.abs() + self.extent
        return float(far.norm() if self.turns else far[1])


class LayeredRenderer(nn.Module):
    """Ours: a learnt background and two learnt pictures, cart and pole, moved by a learnt camera.

    What is known beforehand is only that a rigid cart slides and a rigid pole turns about a hinge on it; how they
    look, where the hinge is in the frame and how many pixels a metre is are learnt from frames.
    Frames are sharp at every state because nothing but pictures is stored.
    """

    guess: Tensor

    def __init__(
        self, height: int, width: int, column: float, row: float, scale: float, reach: float, detail: float = 2.0
    ) -> None:
        """A first guess of the camera: the hinge at x = 0 in px, px per m; `reach` is the pole's length in m."""
        super().__init__()
        self.arguments = {
            "height": height,
            "width": width,
            "column": float(column),
            "row": float(row),
            "scale": float(scale),
            "reach": float(reach),
            "detail": float(detail),
        }
        length = reach * scale * 1.1
        self.size = (height, width)
        self.register_buffer("guess", torch.tensor([float(column), float(row)]), persistent=False)
        self.background = nn.Parameter(torch.zeros(height, width))
        self.origin = nn.Parameter(torch.tensor([float(column), float(row)]))
        self.gain = nn.Parameter(torch.tensor([float(scale), 0.0]))
        self.tilt = nn.Parameter(torch.zeros(()))
        across = 0.15 * length + 2
        self.cart = Layer((-0.35 * length, 0.35 * length, -0.2 * length, 0.35 * length), False, detail)
        self.pole = Layer((-across, across, -length, 0.2 * length), True, detail)

    @torch.no_grad()
    def start_from(self, frames: Tensor) -> None:
        """Begin with the median of frames (N, H, W) uint8 as the background: what stands still."""
        self.background.copy_((frames.median(0).values / 255).clamp(0.01, 0.99).logit())

    def forward(self, x: Tensor, theta: Tensor) -> Tensor:
        """Frames (B, H, W) of cart positions (B,) in m and pole angles (B,) in rad."""
        width = self.size[1]
        columns = torch.arange(width, device=x.device, dtype=x.dtype)
        hinge = self.origin + self.gain * x[:, None]
        frame = self.background.sigmoid().expand(len(x), -1, -1)
        moved = self.origin - self.guess
        for layer in (self.cart, self.pole):
            first, last = self._rows(layer, hinge, moved)
            rows = torch.arange(first, last, device=x.device, dtype=x.dtype)
            grid = torch.meshgrid(columns, rows, indexing="xy")
            pixels = torch.stack((*grid, torch.ones_like(grid[0])), -1)
            shade, opacity = layer(pixels, hinge, theta + self.tilt, moved).unbind(1)
            band = frame[:, first:last] * (1 - opacity) + shade
            frame = torch.cat((frame[:, :first], band, frame[:, last:]), 1)
        return frame

    def _rows(self, layer: Layer, hinge: Tensor, moved: Tensor) -> tuple[int, int]:
        """First row, and the one after the last, that a layer can cover: the rest need not be computed."""
        row, radius = hinge.detach()[:, 1], layer.radius + float(moved.detach().norm())
        first = max(0, math.floor(float(row.min()) - radius))
        return first, max(first, min(self.size[0], math.ceil(float(row.max()) + radius) + 1))

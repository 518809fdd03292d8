"""Learnt, differentiable renderers: cart position and pole angle to a frame in [0, 1]."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class MLPRenderer(nn.Module):
    """The paper's renderer Psi (section 3.2.3): 4 layers, [32, 128, 256] hidden nodes, tanh. Its frames stay blurry.

    The paper does not specify the input's encoding and the initial weights. Here the angle enters as sine and cosine,
    and the first layer's initial weights for x, sine and cosine are `input_gain` times the usual ones: a pixel is
    1/40 m, and a network that is smooth in its inputs at first takes far longer to resolve that.
    """

    input_gain = (10.0, 5.0, 5.0)
    error: float | None = None
    """root mean square of its frames' error without noise, grey levels of [0, 1]; None where it was not measured"""

    def __init__(self, height: int, width: int) -> None:
        super().__init__()
        self.arguments = {"height": height, "width": width}
        self.size = (height, width)
        first, self.last = nn.Linear(3, 32), nn.Linear(256, height * width)
        self.layers = nn.Sequential(first, nn.Tanh(), nn.Linear(32, 128), nn.Tanh(), nn.Linear(128, 256), nn.Tanh())
        with torch.no_grad():
            first.weight.mul_(torch.tensor(self.input_gain))
            first.bias.mul_(max(self.input_gain))

    @torch.no_grad()
    def start_from(self, x: Tensor, frames: Tensor) -> None:
        """Initialise the last layer's bias with the mean of frames (N, H, W) uint8."""
        self.last.bias.copy_((frames.float().mean(0) / 255).flatten())

    def forward(self, x: Tensor, theta: Tensor) -> Tensor:
        """Frames (B, H, W) of cart positions (B,) in m and pole angles (B,) in rad."""
        return self.last(self.layers(torch.stack((x, theta.sin(), theta.cos()), -1))).unflatten(-1, self.size)


ALONG_TRACK = 15  # Positions of the cart, evenly spaced, from whose frames the background is taken

FIRST_FRAMES = 1000  # Most frames, spread evenly, from which a training starts

FAINT = 20 / 255
"""Difference from the background up to which a pixel shows neither cart nor pole."""

NEAREST = 0.1
"""Least distance of the plane of motion from the camera, over that at the hinge: what is farther to the side is behind
the camera."""


class Layer(nn.Module):
    """A learnt picture, with learnt opacity, that moves rigidly with the cart and may turn with the pole.

    A pixel whose place is p, as a camera square to the plane of motion would see it, shows the picture at R(theta) (p -
    hinge(x)) + moved, where hinge(x) = origin + gain x, and `moved` is the distance of the origin from its first guess.
    With `moved`, a step of the origin changes the point about which the picture turns but not its place at theta = 0;
    without it, every step of the camera would blur what the picture has learnt so far. The picture has `detail` texels
    per pixel; `window` is (left, right, top, bottom) in px around the first guess of the hinge at theta = 0.
    """

    centre: Tensor
    extent: Tensor

    def __init__(self, window: tuple[float, float, float, float], turns: bool, detail: float) -> None:
        super().__init__()
        left, right, top, bottom = window
        columns, rows = int((right - left) * detail) + 1, int((bottom - top) * detail) + 1
        self.turns = turns
        self.register_buffer("centre", torch.tensor([(left + right) / 2, (top + bottom) / 2]))
        self.register_buffer("extent", torch.tensor([(right - left) / 2, (bottom - top) / 2]))
        self.shade = nn.Parameter(torch.zeros(1, rows, columns))
        self.opacity = nn.Parameter(torch.full((1, rows, columns), -2.0))

    def forward(self, places: Tensor, hinge: Tensor, theta: Tensor, moved: Tensor) -> Tensor:
        """Shade times opacity, and opacity, (B, 2, H, W) at the places (H, W, 3) of pixels, each (column, row, 1).

        `hinge` (B, 2) and `moved` (2,) are in px, `theta` (B,) in rad.
        """
        sine, cosine = (theta.sin(), theta.cos()) if self.turns else (0 * theta, 0 * theta + 1)
        turn = torch.stack((torch.stack((cosine, sine), -1), torch.stack((-sine, cosine), -1)), 1)
        turn = turn / self.extent[:, None]
        shift = -(turn @ hinge[..., None])[..., 0] + (moved - self.centre) / self.extent
        # One matrix product maps every pixel of all frames to its place in the picture.
        place = torch.cat((turn, shift[..., None]), -1).flatten(0, 1) @ places.flatten(0, 1).T
        opacity = self.opacity.sigmoid()
        picture = torch.cat((self.shade.sigmoid() * opacity, opacity))
        # Zero padding makes everything outside the window transparent.
        return F.grid_sample(
            picture.expand(len(theta), -1, -1, -1),
            place.view(len(theta), 2, *places.shape[:2]).movedim(1, -1),
            align_corners=True,
            padding_mode="zeros",
        )

    @property
    def radius(self) -> float:
        """Largest vertical distance in px from the hinge that the layer can cover."""
        far = self.centre.abs() + self.extent
        return float(far.norm() if self.turns else far[1])


class LayeredRenderer(nn.Module):
    """Ours: a learnt background and two learnt pictures, cart and pole, moved by a learnt camera.

    The model assumes only that a rigid cart slides and a rigid pole turns about a hinge on it, in one plane; their
    appearance, the hinge's place in the frame, the pixels per metre, the side from which the camera looks at the plane
    and its lens's distortion are learnt from frames. Since pictures are moved and never interpolated between states,
    frames are sharp at every state.
    """

    guess: Tensor
    error: float | None = None
    """root mean square of its frames' error without noise, grey levels of [0, 1]; None where it was not measured"""

    def __init__(
        self, height: int, width: int, column: float, row: float, scale: float, reach: float, detail: float = 2.0
    ) -> None:
        """Frames of (height, width) px, from a first guess of the camera.

        The hinge is at (column, row) px at x = 0, and `scale` in px per m. `reach` is the pole's length in m, or a
        little more, `detail` the pictures' texels per px.
        """
        super().__init__()
        real = {"column": column, "row": row, "scale": scale, "reach": reach, "detail": detail}
        self.arguments = {"height": height, "width": width, **{name: float(value) for name, value in real.items()}}
        length = reach * scale * 1.1
        self.size = (height, width)
        self.register_buffer("guess", torch.tensor([float(column), float(row)]), persistent=False)
        self.background = nn.Parameter(torch.zeros(height, width))
        self.origin = nn.Parameter(torch.tensor([float(column), float(row)]))
        self.gain = nn.Parameter(torch.tensor([float(scale), 0.0]))
        self.tilt = nn.Parameter(torch.zeros(()))
        self.stretch, self.perspective = nn.Parameter(torch.zeros(2)), nn.Parameter(torch.zeros(2))
        self.distortion = nn.Parameter(torch.zeros(()))
        across = 0.15 * length + 2
        self.cart = Layer((-0.35 * length, 0.35 * length, -0.2 * length, 0.35 * length), False, detail)
        self.pole = Layer((-across, across, -length, 0.2 * length), True, detail)

    @property
    def farthest(self) -> float:
        """Largest |x| in m at which the hinge is in the middle of a pixel."""
        return max(self._at_sides(0.0))

    @property
    def reach(self) -> float:
        """Largest |x| in m at which the hinge is in the frame on either side of x = 0."""
        return min(self._at_sides(0.5))

    @torch.no_grad()
    def _at_sides(self, beyond: float) -> list[float]:
        """|x| in m of a hinge at the left and at the right side of the frame, `beyond` px outside of the last pixels'
        middles."""
        row = float(self.guess[1])
        sides = self.origin.new_tensor([[-beyond, row], [self.size[1] - 1 + beyond, row]])
        away = self._seen_squarely(sides)[:, 0] - self.origin[0]
        return (away / self.gain[0].abs().clamp(min=1e-9)).abs().tolist()

    @torch.no_grad()
    def start_from(self, x: Tensor, frames: Tensor) -> None:
        """Initialise the background, and the rows by which the cart is lower a metre further on, from frames (N, H, W)
        uint8 at positions x (N,) in m.

        Pictures that are learnt while the cart is drawn at wrong heights blur, and hold it to these.
        """
        few = torch.linspace(0, len(frames) - 1, min(len(frames), FIRST_FRAMES), device=frames.device).long()
        x, frames = x[few].to(self.gain), frames[few]
        along = torch.linspace(float(x.min()), float(x.max()), ALONG_TRACK).to(x)
        still = frames[(x - along[:, None]).abs().argmin(1)].median(0).values  # shows what does not move
        self.background.copy_((still / 255).clamp(0.01, 0.99).logit())
        top = int(self.guess[1].clamp(0, self.size[0] - 1))  # above it a pole that is upright moves too
        cart = ((frames[:, top:].to(x) - still[top:].to(x)).abs() - 255 * FAINT).clamp(min=0).sum(2)
        seen = cart.sum(1) > 0
        if int(seen.sum()) > 2:
            row = cart[seen] @ torch.arange(cart.shape[1]).to(x) / cart[seen].sum(1)
            away = x[seen] - x[seen].mean()
            self.gain[1] = (away @ row) / away.square().sum().clamp(min=1e-12)

    def forward(self, x: Tensor, theta: Tensor) -> Tensor:
        """Frames (B, H, W) of cart positions (B,) in m and pole angles (B,) in rad."""
        hinge = self.origin + self.gain * x[:, None]
        frame = self.background.sigmoid().expand(len(x), -1, -1)
        moved = self.origin - self.guess
        columns, rows = (torch.arange(n, device=x.device, dtype=x.dtype) for n in (self.size[1], self.size[0]))
        places = self._seen_squarely(torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1))
        places = torch.cat((places, torch.ones_like(places[..., :1])), -1)
        for layer in (self.cart, self.pole):
            first, last = self._rows(layer, hinge, moved, places[..., 1])
            shade, opacity = layer(places[first:last], hinge, theta + self.tilt, moved).unbind(1)
            band = frame[:, first:last] * (1 - opacity) + shade
            frame = torch.cat((frame[:, :first], band, frame[:, last:]), 1)
        return frame

    def _seen_squarely(self, pixels: Tensor) -> Tensor:
        """Where pixels (..., 2), each (column, row), would be in the frame of a camera without distortion that is
        square to the plane of motion, (..., 2).

        A lens moves what it shows from the middle of the frame by a share that grows with the square of the distance
        (Brown 1971). A plane seen at an angle is a homography of the plane seen squarely: 4 numbers, beside the hinge's
        place, the scale and the tilt, which are other parameters (Hartley and Zisserman 2004, section 2.4).
        """
        height, width = self.size
        middle = pixels.new_tensor([(width - 1) / 2, (height - 1) / 2])
        from_middle = pixels - middle
        bent = from_middle * (self.distortion * (2 * from_middle / width).square().sum(-1, keepdim=True))
        from_hinge = pixels - self.guess + bent
        nearer = 1 / (1 + (from_hinge * self.perspective / width).sum(-1, keepdim=True)).clamp(min=NEAREST)
        wider = (from_hinge * self.stretch).sum(-1, keepdim=True) * nearer
        # As a sum, so that a square camera's pixels stay exactly where they are.
        return pixels + bent + from_hinge * (nearer - 1) + torch.cat((wider, 0 * wider), -1)

    def _rows(self, layer: Layer, hinge: Tensor, moved: Tensor, rows: Tensor) -> tuple[int, int]:
        """The first row that a layer can cover and the one after the last; the others need not be computed. `rows` (H,
        W) are those of the pixels, seen squarely."""
        # Where a simulation has diverged (nan, infinite or huge positions), it does not matter where the cart is drawn.
        row = hinge.detach()[:, 1].nan_to_num().clamp(-1e6, 1e6)
        radius = layer.radius + float(moved.detach().norm())
        covered = (rows.detach() > row.min() - radius - 1) & (rows.detach() < row.max() + radius + 1)
        numbers = covered.any(1).nonzero()
        return (int(numbers[0]), int(numbers[-1]) + 1) if len(numbers) else (0, 0)

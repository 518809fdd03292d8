"""Effects on a camera's frames, in the order in which a frame passes them: moved, covered, blurred, then its greys.

Rotation, zoom and shift are one warp about the centre of the frame, edges repeated. Warp and blur are kornia's (Riba et
al. 2020, WACV, 3674), with the extra `camera`: both are exact where nothing is to be done.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from typing import Any, ClassVar

import torch
from torch import Tensor

from visadapt.effects.base import Effect, Parameter, Reading, Stage
from visadapt.effects.lossy import Lossy
from visadapt.systems import CartPole

__all__ = [
    "Blur",
    "Brightness",
    "CameraEffect",
    "CameraRotation",
    "CameraShift",
    "CameraZoom",
    "FrameDrop",
    "Gamma",
    "Occlusion",
]

FAINTEST = 1e-12  # Grey level up to which gamma does nothing: at 0 the slope of a power may be infinite

SHARPEST = 0.05  # px, least sigma that is computed: at this one a blur changes no grey level

BLUR_REACH = 4.0
"""Largest blur in px; its kernel reaches three times as far."""


class CameraEffect(Effect):
    """Changes what a camera shows: which scene, from where, and in which greys.

    Grey levels are in [0, 1], pixel centres lie at whole numbers, rows count downwards.

    >>> import torch, visadapt as va
    >>> world = va.World(va.CartPole(), [va.effects.Brightness(gain=0.5, offset=0.1)])
    >>> frame, _ = world.show(world.start(torch.zeros(1, 4)), lambda state: torch.ones(len(state), 4, 6))
    >>> frame.shape, round(frame[0, 0, 0].item(), 3)
    (torch.Size([1, 4, 6]), 0.6)
    """

    stage = Stage.CAMERA
    in_one_frame: ClassVar[bool] = True
    """whether a single frame shows it, so that a diagnosis looks for it in pixels; False: only motion does"""

    @classmethod
    def table_in(cls, height: int, width: int) -> tuple[Parameter, ...]:
        """The table, with the ranges searched in frames of this size in px."""
        return cls.table

    def memory(self, state: Tensor, period: float) -> Tensor:
        """The effect's memory (B, any, any) before the first frame of an episode that begins in `state`."""
        return state[:, None, :0]

    def scene(self, state: Tensor, memory: Tensor, period: float) -> Reading:
        """The state (B, n_state) that is shown in the row of `state`, and the new memory; rows are `period` s apart."""
        return state, memory

    def motion(self, like: Tensor) -> Tensor | None:
        """The affine map (3, 3) or (B, 3, 3) of (column, row, 1) in px from the frame's centre; None where
        nothing moves."""
        return None

    def apply_to(self, frame: Tensor, memory: Tensor, generator: torch.Generator | None) -> Reading:
        """The changed frame (B, H, W) of one row, after `motion`, and the new memory.

        Only random effects need the `generator`.
        """
        return frame, memory


class CameraError(ImportError):
    """The package that camera effects need is missing; the message is one line."""


def moved(frame: Tensor, motions: Sequence[Tensor]) -> Tensor:
    """The frames (B, H, W) moved by one `CameraEffect.motion` after the other, in one warp.

    Raises:
        CameraError: kornia is missing.
    """
    if not motions:
        return frame
    height, width = frame.shape[1:]
    centre = torch.eye(3).to(frame)
    centre[:2, 2] = frame.new_tensor([(width - 1) / 2, (height - 1) / 2])
    whole = centre.inverse()
    for motion in motions:
        whole = motion @ whole
    affine = (centre @ whole)[..., :2, :]
    # Frames that are moved alike are channels of one picture, for which the weights of the pixels are computed once.
    alike = affine.dim() == 2
    pictures, affine = (frame[None], affine[None]) if alike else (frame[:, None], affine.expand(len(frame), -1, -1))
    warp = _kornia("geometry.transform").warp_affine
    # Bicubic (Keys 1981), since bilinear interpolation has kinks at whole pixels, where most warps begin.
    out: Tensor = warp(pictures, affine, (height, width), "bicubic", padding_mode="border", align_corners=True)
    return out[0] if alike else out[:, 0]


def seen_by(
    camera: Sequence[CameraEffect], frame: Tensor, memory: Sequence[Tensor], generator: torch.Generator | None
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Frames (B, H, W) after all effects, in their order, limited to [0, 1], and the new memories."""
    if not camera:
        return frame, ()
    frame = moved(frame, [motion for effect in camera if (motion := effect.motion(frame)) is not None])
    remembered = []
    for effect, own in zip(camera, memory, strict=True):
        frame, own = effect.apply_to(frame, own, generator)
        remembered.append(own)
    return frame.clamp(0, 1), tuple(remembered)


class CameraRotation(CameraEffect):
    """A camera turned about its axis, or a picture turned about its centre."""

    name = "camera_rotation"
    order = 10
    systems = (CartPole,)
    equation = "(column, row) seen = R(angle) (column, row), R positive from +column towards +row"
    source = "Hartley and Zisserman (2004), Multiple View Geometry, section 2.4.2 (similarities)"
    table = (Parameter("angle", "rad", -0.35, 0.35, 0.0),)

    def motion(self, like: Tensor) -> Tensor:
        angle = self.value("angle", like)
        zero, one = torch.zeros_like(angle), torch.ones_like(angle)
        rows = (angle.cos(), -angle.sin(), zero), (angle.sin(), angle.cos(), zero), (zero, zero, one)
        return torch.stack([torch.stack(row, -1) for row in rows], -2)


class CameraZoom(CameraEffect):
    """A camera that is nearer (above 1) or farther, or with another focal length."""

    name = "camera_zoom"
    order = 20
    systems = (CartPole,)
    equation = "(column, row) seen = scale (column, row)"
    source = "Hartley and Zisserman (2004), Multiple View Geometry, section 2.4.2 (similarities)"
    table = (Parameter("scale", "1", 0.7, 1.4, 1.0),)

    def motion(self, like: Tensor) -> Tensor:
        scale = self.value("scale", like)
        return torch.diag_embed(torch.stack((scale, scale, torch.ones_like(scale)), -1))


class CameraShift(CameraEffect):
    """A camera that is moved or turned a little to the side, up or down."""

    name = "camera_shift"
    order = 30
    systems = (CartPole,)
    equation = "(column, row) seen = (column + dx, row + dy)"
    source = "Hartley and Zisserman (2004), Multiple View Geometry, section 2.4.2 (similarities)"
    table = (Parameter("dx", "px", -20.0, 20.0, 0.0), Parameter("dy", "px", -20.0, 20.0, 0.0))

    def motion(self, like: Tensor) -> Tensor:
        dx, dy = torch.broadcast_tensors(self.value("dx", like), self.value("dy", like))
        moved_by = torch.stack((dx, dy, torch.zeros_like(dx)), -1)
        return torch.eye(3).to(like) + moved_by[..., None] * like.new_tensor([0.0, 0.0, 1.0])


class Occlusion(CameraEffect):
    """A box of one grey in front of the scene; a pixel that it covers in part is a mean of both."""

    name = "occlusion"
    order = 40
    systems = (CartPole,)
    equation = "grey seen = grey for left <= column < right and top <= row < bottom"
    source = "Porter and Duff (1984), Compositing Digital Images, SIGGRAPH (over)"
    table = (
        Parameter("left", "px", 0.0, 120.0, 0.0),
        Parameter("top", "px", 0.0, 120.0, 0.0),
        Parameter("right", "px", 0.0, 120.0, 0.0),
        Parameter("bottom", "px", 0.0, 120.0, 0.0),
        Parameter("grey", "1", 0.0, 1.0, None),
    )

    @classmethod
    def table_in(cls, height: int, width: int) -> tuple[Parameter, ...]:
        sides = {"left": width, "right": width, "top": height, "bottom": height}
        return tuple(replace(p, high=float(sides[p.name])) if p.name in sides else p for p in cls.table)

    def apply_to(self, frame: Tensor, memory: Tensor, generator: torch.Generator | None) -> Reading:
        def covered(size: int, first: str, last: str) -> Tensor:
            """(B or 1, size) share of each pixel, which reaches half a px to either side of its whole number."""
            pixel = torch.arange(size).to(frame)
            start, end = (self.value(edge, frame).reshape(-1, 1) - pixel for edge in (first, last))
            return (end.clamp(0, 1) - start.clamp(0, 1)).clamp_min(0)

        height, width = frame.shape[1:]
        share = covered(height, "top", "bottom")[:, :, None] * covered(width, "left", "right")[:, None]
        return frame + share * (self.column("grey", frame) - frame), memory


class Blur(CameraEffect):
    """A lens out of focus: a Gaussian of standard deviation `sigma`, sampled at the pixels; edges repeated."""

    name = "blur"
    order = 50
    systems = (CartPole,)
    equation = "grey seen = Gaussian(sigma) * grey"
    source = "Pentland (1987), A new sense for depth of field, IEEE PAMI 9(4)"
    table = (Parameter("sigma", "px", 0.0, BLUR_REACH, 0.0),)

    def apply_to(self, frame: Tensor, memory: Tensor, generator: torch.Generator | None) -> Reading:
        sigma = self.value("sigma", frame).clamp_min(SHARPEST).reshape(-1, 1).expand(len(frame), 2)
        size = 2 * round(3 * BLUR_REACH) + 1
        blurred: Tensor = _kornia("filters").gaussian_blur2d(frame[:, None], size, sigma, border_type="replicate")
        return blurred[:, 0], memory


class Gamma(CameraEffect):
    """A camera whose grey levels are a power of those assumed."""

    name = "gamma"
    order = 60
    systems = (CartPole,)
    equation = "grey seen = grey^exponent"
    source = "Farid (2001), Blind inverse gamma correction, IEEE Transactions on Image Processing 10(10)"
    table = (Parameter("exponent", "1", 0.3, 3.0, 1.0),)
    settled_by: ClassVar[Mapping[str, str]] = {
        "brightness": (
            "film a card with several known grey levels: brightness changes them along a straight line, gamma along a "
            "curve"
        )
    }

    def apply_to(self, frame: Tensor, memory: Tensor, generator: torch.Generator | None) -> Reading:
        seen = frame > FAINTEST
        return torch.where(seen, torch.where(seen, frame, 1) ** self.column("exponent", frame), frame), memory


class Brightness(CameraEffect):
    """Another exposure or lighting: contrast and level of all grey levels."""

    name = "brightness"
    order = 70
    systems = (CartPole,)
    equation = "grey seen = gain grey + offset"
    source = "Gennert and Negahdaripour (1987), Relaxing the brightness constancy assumption, MIT AI Memo 975"
    table = (
        Parameter("gain", "1", 0.3, 2.0, 1.0, linear=True),
        Parameter("offset", "1", -0.4, 0.4, 0.0, linear=True),
    )

    def apply_to(self, frame: Tensor, memory: Tensor, generator: torch.Generator | None) -> Reading:
        return self.column("gain", frame) * frame + self.column("offset", frame), memory


class FrameDrop(Lossy, CameraEffect):
    """Lost frames: with probability `rate`, the last frame is shown again."""

    name = "frame_drop"
    order = 80
    systems = (CartPole,)
    equation = "frame_k = frame_(k-1) with probability rate"
    no_gradient = "whether a frame is lost is a random yes or no"
    in_one_frame = False

    def apply_to(self, frame: Tensor, memory: Tensor, generator: torch.Generator | None) -> Reading:
        lost = self.lost(frame, generator)
        if memory.numel():  # the first frame of an episode is never lost, as there is none before it
            frame = torch.where(lost[:, None, None], memory.unflatten(2, frame.shape[1:])[:, 0], frame)
        return frame, frame.flatten(1)[:, None]


def _kornia(module: str) -> Any:
    try:
        return import_module(f"kornia.{module}")
    except ImportError as error:
        raise CameraError("a moved or blurred camera needs kornia: pip install 'visadapt[camera]'") from error

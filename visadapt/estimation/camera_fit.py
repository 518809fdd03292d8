"""A camera's parameters from frames, together with the poses that they show: analysis by synthesis.

    minimise over phi and p_1 .. p_N   sum_t |y_t - C(Psi(p_t); phi)|^2

y_t a frame, Psi the renderer, p_t = (x, theta), C the camera's effects with their parameters phi, the same in all
frames. Levenberg and Marquardt's steps are taken in phi and all p_t at once; the p_t are eliminated frame by frame
(Schur complement; Triggs et al. 2000, Bundle adjustment, section 6.1). The covariance of phi covers noise of the pixels
and errors of the renderer itself, which no number of frames averages out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from visadapt.effects.camera import Blur, CameraEffect, seen_by
from visadapt.estimation.frame_residuals import white_noise
from visadapt.estimation.poses import DIFFERENCE, SPACING

Camera = tuple[type[CameraEffect], ...]

SMOOTHING = 1.5  # px, standard deviation

CORRELATED_PIXELS = 100
"""Pixels, 10 by 10, over which the residual beyond noise counts as one error, the same in all frames."""

STEPS = 12  # Most steps of a fit

SMALL_GAIN = 1e-4  # Share by which a step must lower the squared misfit for another one to be taken

DIFFERENCE_SHARE, LONGEST_DIFFERENCE = 0.01, 0.5
"""Half-width of the central differences of a parameter, as a share of its range, and in its unit at most."""


class SeenBy(nn.Module):
    """A renderer seen by a camera with effects: x (B,) and theta (B,) to frames (B, H, W).

    Where a camera that was moved looks beyond the renderer's frames, they are 0.
    """

    def __init__(self, renderer: nn.Module, effects: Sequence[CameraEffect]) -> None:
        super().__init__()
        self.renderer = renderer
        self.effects = list(effects)

    def forward(self, x: Tensor, theta: Tensor) -> Tensor:
        """Frames (B, H, W) of cart positions (B,) in m and pole angles (B,) in rad."""
        frame = through(self.renderer(x, theta), self.effects)
        return frame * within_frame(self.effects, frame)


def through(frame: Tensor, effects: Sequence[CameraEffect]) -> Tensor:
    """Frames (B, H, W) as a camera with effects without memory shows them."""
    ordered = sorted(effects, key=lambda effect: effect.order)
    return seen_by(ordered, frame, [frame[:, None, :0]] * len(ordered), None)[0]


def smoothed(frames: Tensor, camera: Sequence[CameraEffect]) -> Tensor:
    """Frames (B, H, W), smoothed where a camera is moved.

    A picture that is moved by a fraction of a pixel loses its sharpest edges, and a fit to sharp frames then prefers
    whole pixels, or no motion: errors of 0.1 px, or 0.2 % of zoom.
    """
    if all(effect.motion(frames) is None for effect in camera):
        return frames
    return Blur(sigma=SMOOTHING).apply_to(frames, frames, None)[0]


def within_frame(camera: Sequence[CameraEffect], like: Tensor) -> Tensor:
    """(H, W) 1 where a pixel looks at what lies inside the renderer's frames, of the size of `like`, else 0."""
    ordered = sorted(camera, key=lambda effect: effect.order)
    motions = [motion for effect in ordered if (motion := effect.motion(like)) is not None]
    height, width = like.shape[-2:]
    rows, columns = torch.meshgrid(torch.arange(height).to(like), torch.arange(width).to(like), indexing="ij")
    middle = like.new_tensor([(width - 1) / 2, (height - 1) / 2])
    there = torch.stack((columns, rows), -1) - middle
    for motion in reversed(motions):
        inverse = motion.inverse()
        there = there @ inverse[:2, :2].T + inverse[:2, 2]
    inside = ((there + middle) >= 0) & ((there + middle) <= 2 * middle)
    return inside.all(-1).to(like)


@dataclass(frozen=True)
class CameraFit:
    """Camera effects fitted to frames."""

    camera: Camera
    values: Tensor  # (P,) float64, in the order of the effects and of their tables
    pose: Tensor  # (N, 2) x in m and theta in rad of the frames
    mean_square: float  # of frame less what is drawn, grey levels of [0, 1]
    covariance: Tensor  # (P, P) of the values
    residual: Tensor  # (N, H, W), 0 where the renderer draws nothing of what is seen

    @property
    def effects(self) -> list[CameraEffect]:
        """The effects at their fitted values."""
        return made(self.camera, self.values)

    @property
    def misfit(self) -> float:
        """Root mean square of frame less what is drawn, grey levels of [0, 1]."""
        return self.mean_square**0.5


def made(camera: Camera, values: Tensor) -> list[CameraEffect]:
    """The effects with values (P,)."""
    parts = values.split([len(kind.table) for kind in camera]) if camera else ()
    return [
        kind(**dict(zip((p.name for p in kind.table), part.tolist(), strict=True)))
        for kind, part in zip(camera, parts, strict=True)
    ]


class _Comparison:
    """Frames (N, H, W) less what renderer and camera draw at poses (N, 2) with parameters (P,), and its derivatives.

    Args:
        fixed: names of the parameters that stay as they are, whose derivatives are 0.
    """

    def __init__(self, renderer: nn.Module, frames: Tensor, camera: Camera, fixed: frozenset[str]) -> None:
        self.renderer = renderer
        self.frames = frames
        self.camera = camera
        table = [parameter for kind in camera for parameter in kind.table_in(*frames.shape[1:])]
        self.low, self.high = (
            torch.tensor([getattr(p, end) for p in table], dtype=torch.float64) for end in ("low", "high")
        )
        self.free = torch.tensor([p.name not in fixed for p in table], dtype=torch.float64)
        self.step = (DIFFERENCE_SHARE * (self.high - self.low)).clamp_max(LONGEST_DIFFERENCE)

    def left(self, pose: Tensor, values: Tensor) -> Tensor:
        """What is left of the frames, also where the renderer draws nothing of what they show."""
        return self.frames - self._shown(self._scene(pose), values)

    def compared(self, pose: Tensor, values: Tensor, smooth: bool) -> tuple[Tensor, float]:
        """What is left of the frames, and its mean square where the renderer draws what they show."""
        left = self._counted(self.left(pose, values), values, smooth)
        return left, float(left.square().mean() / within_frame(made(self.camera, values), self.frames).mean())

    def slopes(self, pose: Tensor, values: Tensor, smooth: bool) -> tuple[Tensor, Tensor]:
        """Derivatives (N, 2, H W) by pose and (N, P, H W) by the parameters, as central differences."""
        by_pose = [
            self._shown(self._scene(pose + h), values) - self._shown(self._scene(pose - h), values)
            for h in DIFFERENCE * torch.eye(2).to(pose)
        ]
        scene = self._scene(pose)
        by_value = [
            self.free[k] * (self._shown(scene, values + h) - self._shown(scene, values - h)) / (2 * self.step[k])
            for k, h in enumerate(torch.diag(self.step))
        ]
        pictures = torch.stack([each.to(self.frames) for each in (*by_pose, *by_value)], 1)
        counted = self._counted(pictures.flatten(0, 1), values, smooth)
        derivatives = counted.unflatten(0, pictures.shape[:2]).flatten(2)
        return derivatives[:, :2] / (2 * DIFFERENCE), derivatives[:, 2:]

    def _scene(self, pose: Tensor) -> Tensor:
        out: Tensor = self.renderer(pose[:, 0].to(self.frames), pose[:, 1].to(self.frames))
        return out

    def _shown(self, scene: Tensor, values: Tensor) -> Tensor:
        return through(scene, made(self.camera, values))

    def _counted(self, pictures: Tensor, values: Tensor, smooth: bool) -> Tensor:
        """Pictures (N, H, W), 0 where the renderer draws nothing of what is seen."""
        effects = made(self.camera, values)
        pictures = pictures * within_frame(effects, self.frames)
        return smoothed(pictures, effects) if smooth else pictures


def fit_camera(
    renderer: nn.Module,
    frames: Tensor,
    camera: Camera,
    values: Tensor,
    pose: Tensor,
    fixed: frozenset[str],
    smooth: bool = False,
) -> CameraFit:
    """Fit camera effects to frames (N, H, W) in [0, 1], from values (P,) and poses (N, 2); `fixed` are the names of
    parameters that stay as they are; with `smooth`, to `smoothed` frames."""
    pictures = _Comparison(renderer, frames, camera, fixed)
    low, high = pictures.low, pictures.high
    values, pose = values.double().clone(), pose.double().clone()
    (error, loss), damping, parts = pictures.compared(pose, values, smooth), 1e-3, None
    for _ in range(STEPS):
        if parts is None:
            parts = _normal(*pictures.slopes(pose, values, smooth), error)
        change, moves = _solved(*parts, damping)
        tried = torch.minimum(torch.maximum(values + change, low), high)
        there = pose + moves.clamp(-SPACING, SPACING)
        error_there, loss_there = pictures.compared(there, tried, smooth)
        if loss_there < loss:
            gained = 1 - loss_there / loss
            values, pose, error, loss, damping, parts = tried, there, error_there, loss_there, damping / 10, None
            if gained < SMALL_GAIN:
                break
        else:
            damping *= 10
            if damping > 1e3:
                break
    noise = white_noise(pictures.left(pose, values))
    covariance = _covariance(*pictures.slopes(pose, values, smooth), error, noise, (high - low).square() / 12)
    if smooth:  # what is left of sharp frames is compared with that of other cameras
        error, loss = pictures.compared(pose, values, smooth=False)
    return CameraFit(camera, values, pose, loss, covariance, error)


def _normal(by_pose: Tensor, by_value: Tensor, error: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Blocks of the normal equations: poses (N, 2, 2), both (N, P, 2), values (P, P), and their right sides."""
    flat = error.flatten(1)[..., None]
    return (
        (by_pose @ by_pose.mT).double(),
        (by_value @ by_pose.mT).double(),
        (by_value @ by_value.mT).double().sum(0),
        (by_pose @ flat)[..., 0].double(),
        (by_value @ flat)[..., 0].double().sum(0),
    )


def _solved(
    poses: Tensor, both: Tensor, values: Tensor, pose_side: Tensor, value_side: Tensor, damping: float
) -> tuple[Tensor, Tensor]:
    """Steps (P,) of the values and (N, 2) of the poses, from the blocks and right sides that `_normal` gives."""
    poses = poses + torch.diag_embed(poses.diagonal(dim1=1, dim2=2) * damping + 1e-9)
    values = values + torch.diag(values.diagonal() * damping + 1e-9)
    gain = torch.linalg.solve(poses, both.mT).mT  # (N, P, 2)
    reduced = values - (gain @ both.mT).sum(0)
    change = torch.linalg.solve(reduced, value_side - (gain @ pose_side[..., None])[..., 0].sum(0))
    moves = torch.linalg.solve(poses, (pose_side - (change @ both))[..., None])[..., 0]
    return change, moves


def _covariance(by_pose: Tensor, by_value: Tensor, error: Tensor, noise: float, wide: Tensor) -> Tensor:
    """Covariance (P, P) of the parameters, with prior variances `wide` (P,): from white noise of the pixels, and from
    the rest of the residual, which is alike in many pixels and frames and so counts as few errors."""
    if not len(wide):
        return wide.new_zeros(0, 0)
    poses = (by_pose @ by_pose.mT).double()
    poses = poses + 1e-9 * torch.eye(2).to(poses)
    gain = torch.linalg.solve(poses, (by_pose @ by_value.mT).double()).mT  # (N, P, 2)
    clear = by_value - gain.to(by_pose) @ by_pose  # less what the poses take up
    white = max(noise**2, 1e-12)
    left = white_noise(error) ** 2  # of the noise, where frames are smoothed
    structured = max(0.0, float(error.square().mean()) - left) * len(error) * CORRELATED_PIXELS
    information = (clear @ clear.mT).double().sum(0)
    return torch.linalg.inv(information / (white + structured) + torch.diag(1 / wide))

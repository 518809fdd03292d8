"""Where cart and pole are in a frame: the learnt renderer is fitted to it, two unknowns a frame.

A frame y (H W pixels, grey levels in [0, 1]) is explained by p = (x, theta) that minimises |y - Psi(p)|^2, Psi the
renderer: first over a grid of poses rendered once, at half the resolution, which also widens the basin; then by
Levenberg and Marquardt's damped Gauss-Newton steps (Marquardt 1963, J. SIAM 11(2); Nocedal and Wright 2006, section
10.3), every frame with a damping of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from visadapt.systems import System

LEAN = 0.5  # rad, largest |theta| of the grid searched

SPACING = 0.05  # m and rad between the poses of the grid: about 2 px for a camera that sees 3 m in 120 px

LONGEST_REACH = 10.0  # m, largest |x| that is looked at, whatever a renderer says that it shows

DIFFERENCE = 0.0125
"""m and rad, half-width of the central differences: half a pixel, so that the kinks of interpolated pictures, which
have no use here, are smoothed over (and grid_sample has no forward-mode derivative)."""

STEPS = 6
FRESH = 3  # Steps taken, and for how many of them the Jacobian is computed anew: the last ones only polish

CHUNK = 64  # Frames rendered at a time: what fits a processor's cache

HIDDEN = 0.5  # `Poses.contrast` above which a frame does not show cart and pole where they are drawn


@dataclass(frozen=True)
class Poses:
    """What was found in T frames; tensors are on the CPU."""

    pose: Tensor  # (T, 2) float64: x in m, theta in rad
    covariance: Tensor
    """(T, 2, 2) float64, misfit^2 (J'J)^-1: what white pixel errors of the size of the misfit would do to `pose`"""
    misfit: Tensor  # (T,) root mean square of frame less rendered frame, in grey levels of [0, 1]
    contrast: Tensor
    """(T,) misfit where cart and pole are drawn, over how much these differ from the mean picture there: small where
    the frame shows them, whatever light or shadow does to the rest of it"""
    explained: Tensor  # (T,) whether the frame shows cart and pole where they are drawn


def reach_of(renderer: nn.Module, system: System) -> float:
    """m, largest |x| at which a cart is looked for: that of the system's range or, where it is farther, that at which
    the renderer says that it still shows the hinge (`farthest`)."""
    return max(system.states[system.index("x")].largest, min(LONGEST_REACH, getattr(renderer, "farthest", 0.0)))


class PoseFinder:
    """Finds poses by a renderer (nn.Module of x (B,) and theta (B,) to frames (B, H, W) in [0, 1]).

    Args:
        renderer: it is not changed.
        reach: m, largest |x| of the grid searched.
            Poses a little beyond it, and beyond LEAN, are still found.
    """

    def __init__(self, renderer: nn.Module, reach: float) -> None:
        self.renderer = renderer
        self._like = next(renderer.parameters(), torch.zeros(())).detach()
        axes = [
            torch.linspace(-limit, limit, 2 * max(1, round(limit / SPACING)) + 1, dtype=self._like.dtype)
            for limit in (reach, LEAN)
        ]
        self._grid = torch.cartesian_prod(*axes).to(self._like.device)
        rendered = [self._render(part) for part in self._grid.split(CHUNK)]
        self.size = tuple(rendered[0].shape[1:])
        """height and width of a frame"""
        self._mean = torch.stack([part.sum(0) for part in rendered]).sum(0) / len(self._grid)
        self.grey = float(self._mean.mean())
        """mean grey level, of [0, 1], of the frames over the grid"""
        self._small = torch.cat([_shrink(part) for part in rendered])
        self._square = self._small.square().sum(1)

    @torch.no_grad()
    def __call__(self, frames: Tensor) -> Poses:
        """Poses in frames (T, H, W) uint8."""
        parts = [self._find(part.to(self._like) / 255) for part in frames.split(CHUNK)]
        pose, covariance, misfit, contrast = (torch.cat(tensors).cpu() for tensors in zip(*parts, strict=True))
        # Where the picture does not depend on the pose (a cart out of sight) there is nothing to be found either.
        sound = covariance.flatten(1).isfinite().all(1)
        return Poses(pose, covariance, misfit, contrast, sound & (contrast <= HIDDEN))

    @torch.no_grad()
    def nearest(self, frames: Tensor, change: Callable[[Tensor], Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """The poses (T, 2) of the grid nearest to frames (T, H, W) in [0, 1], and their mean squared distances (T,).

        `change` is made to the rendered frames of the grid, at half the resolution.
        """
        drawn, square = self._small, self._square
        if change is not None:
            height, width = (math.ceil(side / 2) for side in self.size)
            drawn = change(drawn.unflatten(1, (height, width))).flatten(1)
            square = drawn.square().sum(1)
        small = _shrink(frames)
        # |f - t|^2 less |f|^2, which is the same for every t.
        least, index = (square - 2 * small @ drawn.T).min(1)
        return self._grid[index], (least + small.square().sum(1)) / small.shape[1]

    @torch.no_grad()
    def _render(self, pose: Tensor) -> Tensor:
        out: Tensor = self.renderer(pose[:, 0], pose[:, 1])
        return out

    def _find(self, frames: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        pose, _ = self.nearest(frames)
        error = frames - self._render(pose)
        loss = error.square().mean((1, 2))
        damping = torch.full_like(loss, 1e-2)
        for step in range(STEPS):
            if step < FRESH:
                slope = self._slope(pose)
            normal = slope @ slope.transpose(1, 2)
            scale = normal.diagonal(dim1=1, dim2=2)
            damped = normal + torch.diag_embed(scale * damping[:, None] + 1e-9)
            move = torch.linalg.solve(damped, slope @ error.flatten(1)[..., None])[..., 0]
            # No step is longer than the spacing of the grid: the nearest pose of the grid is not further.
            tried = pose + move.clamp(-SPACING, SPACING)
            error_there = frames - self._render(tried)
            loss_there = error_there.square().mean((1, 2))
            better = loss_there < loss
            pose = torch.where(better[:, None], tried, pose)
            error = torch.where(better[:, None, None], error_there, error)
            loss = torch.where(better, loss_there, loss)
            damping = torch.where(better, damping / 10, damping * 10)
        normal = (slope @ slope.transpose(1, 2)).double()
        covariance = loss.double()[:, None, None] * torch.linalg.inv_ex(normal).inverse
        drawn = (frames - error - self._mean).square()
        contrast = ((drawn * error.square()).sum((1, 2)) / drawn.square().sum((1, 2))).sqrt()
        return pose.double(), covariance, loss.sqrt(), contrast

    def _slope(self, pose: Tensor) -> Tensor:
        """Derivatives (B, 2, H W) of the rendered frames by x and by theta."""
        steps = torch.eye(2).to(pose) * DIFFERENCE
        rise = torch.stack([self._render(pose + h) - self._render(pose - h) for h in steps], 1)
        return rise.flatten(2) / (2 * DIFFERENCE)


def _shrink(frames: Tensor) -> Tensor:
    """Frames (B, H, W) at half the resolution, flattened."""
    return F.avg_pool2d(frames[:, None], 2, ceil_mode=True).flatten(1)

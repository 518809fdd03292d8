"""Which pixels of a film neither the renderer nor an effect of the camera explains."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from visadapt.diagnosis.result import Box, Pixels
from visadapt.effects import CameraEffect, CameraShift
from visadapt.effects.camera import moved
from visadapt.estimation.camera_fit import within_frame
from visadapt.estimation.frame_residuals import MAX_FRAME_RATIO, evenly_spaced, size_of, structure

MAX_LEFT_OUT = 0.1  # Share of the frames that may be left out because their residual is far larger than most

FRAMES = 96  # Frames, spread over the film, whose pixels are looked at

USUAL_ERROR = 1 / 255
"""Error of a renderer whose file states none: root mean square of the structure of its residual, where white is 1."""

FACTOR = 1.7  # Ratio of a film's structure to the usual one, above which frames are unexplained

STANDS_OUT = 4.0  # Structure of a pixel over the mean, above which it belongs to a box
MOST_BOXES, LEAST_SHARE = 5, 0.05  # Boxes at most, and the least share of a film's structure that one holds


def left_over(seen: nn.Module, camera: Sequence[CameraEffect], frames: Tensor, pose: Tensor) -> Tensor:
    """`structure` (H, W) of frames (T, H, W) uint8 less what is drawn of their poses (T, 2); 0 where nothing is drawn.

    `seen` is the renderer through `camera`. A few frames that are far worse than most, such as flashes, are left out.
    """
    rows = evenly_spaced(len(frames), FRAMES)
    rows = rows[pose[rows].isfinite().all(1)]
    x, theta = pose[rows].float().T
    drawn = seen(x, theta)
    residual = (frames[rows].float() / 255 - drawn) * within_frame(camera, drawn)
    power = residual.square().mean((1, 2))
    most = torch.maximum(MAX_FRAME_RATIO * power.median(), power.quantile(1 - MAX_LEFT_OUT))
    return structure(residual[power <= most])


def expected_size(renderer: nn.Module, camera: Sequence[CameraEffect], pose: Tensor) -> float:
    """What is left where nothing is unexplained, root mean square, where white is 1: the renderer's own errors and,
    where the camera is moved, what frames drawn at poses (N, 2) lose when they are moved half a pixel and back."""
    known = getattr(renderer, "error", None)
    error = USUAL_ERROR if known is None else float(known)
    drawn = renderer(*pose.float().T)
    if all(effect.motion(drawn) is None for effect in camera):
        return error
    half = CameraShift(dx=0.5, dy=0.5).motion(drawn)
    assert half is not None
    inside = (..., slice(1, -1), slice(1, -1))
    lost = size_of(structure((moved(moved(drawn, [half]), [half.inverse()]) - drawn)[inside]))
    return math.hypot(error, lost)


def judged(left: Tensor, expected: float) -> Pixels:
    """What is left (H, W) beside the `expected_size`, with the boxes in which it stands out."""
    whole = size_of(left)
    unexplained = whole > FACTOR * expected
    return Pixels(255 * whole, 255 * expected, unexplained, tuple(_boxes(left)) if unexplained else ())


def _boxes(left: Tensor) -> list[Box]:
    """The largest patches that stand out, with their shares."""
    power = left.clamp_min(0).double().numpy()
    marked = (power > STANDS_OUT * power.mean()).astype(np.uint8)
    _, labels, patches, _ = cv2.connectedComponentsWithStats(cv2.dilate(marked, np.ones((3, 3), np.uint8)))
    out = []
    for label, (first, top, width, height, _) in enumerate(patches.tolist()):
        share = float(power[labels == label].sum() / power.sum())
        if label and share >= LEAST_SHARE:
            out.append(Box(first, top, first + width, top + height, share))
    return sorted(out, key=lambda box: -box.share)[:MOST_BOXES]

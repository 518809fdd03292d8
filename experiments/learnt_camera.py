"""A renderer of a target's own picture, learnt from frames of states that the target is put into."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from renderers import LayeredRenderer, load_renderer, save_renderer
from renderers.training import fit
from visadapt.progress import Report, staged
from visadapt.storage.atomic_files import replacing

Show = Callable[[NDArray[np.float64]], NDArray[np.uint8]]
"""Frames (N, H, W) of a target that is put into states (N, 4), no step of which is run."""

Guess = tuple[float, float, float, float]
"""Of the camera: column and row of the hinge at x = 0 (px), a metre (px) and, generously, the pole's length (m)."""


def learnt_renderer(
    path: Path, states: Tensor, show: Show, guess: Guess, steps: int, report: Report | None
) -> LayeredRenderer:
    """Learnt from the frames of states (N, 4), or as an earlier run left it in `path`.

    Beside it a picture, `path` with the suffix .png: four frames, and below them what the renderer draws.
    """
    if path.exists():
        found = load_renderer(path)
        assert isinstance(found, LayeredRenderer)
        return found
    frames = torch.from_numpy(show(states.double().numpy()))
    torch.manual_seed(0)
    height, width = frames.shape[1:]
    renderer, (x, theta) = LayeredRenderer(height, width, *guess), (states[:, 0], states[:, 2])
    fit(renderer, x, theta, frames, steps, torch.Generator().manual_seed(0), 32, staged(report, "renderer"))
    with torch.no_grad():
        learnt = (255 * renderer(x[:4], theta[:4])).round().clamp(0, 255).byte()
    picture = np.vstack([np.hstack(list(row)) for row in (frames[:4].numpy(), learnt.numpy())])
    with replacing(path.with_suffix(".png")) as temporary:
        Image.fromarray(picture).save(temporary, "PNG")
    with replacing(path) as temporary:
        save_renderer(temporary, renderer, {"frames": len(frames), "steps": steps, "seed": 0})
    return renderer

"""Train the learnt renderers of the cart-pole on drawn frames: the layered one (ours) and the MLP (the paper's).

python -m train.renderer --help

Writes renderer.safetensors (ours; the shipped one is in visadapt/weights), renderer_mlp.safetensors and renderer.png, a
picture of drawn beside learnt frames of held-out states, to runs/renderer. Both are trained on the same frames by mean
squared error. Ours starts from a guess of the camera that is some pixels off, and finds the camera by itself.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from datasets import cartpole_frames
from renderers import Camera, DrawnCartPole, LayeredRenderer, MLPRenderer, save_renderer
from renderers.training import fit
from visadapt.progress import reporting, staged
from visadapt.storage.atomic_files import replacing
from visadapt.storage.run_folder import versions

Renderer = LayeredRenderer | MLPRenderer
Kind = Literal["layered", "mlp"]
FILES: dict[Kind, str] = {"layered": "renderer.safetensors", "mlp": "renderer_mlp.safetensors"}
GUESS = {"column": 57.0, "row": 72.5, "scale": 38.5, "reach": 1.05}
"""Where a look at the frames puts the hinge at x = 0 (px), a metre (px) and the pole's tip (m): each a little off."""
MAGNIFIED = 5
"""times that the picture magnifies differences"""


@dataclass(frozen=True)
class Settings:
    """What is trained, and how."""

    kinds: tuple[Kind, ...] = ("layered", "mlp")
    """which renderers"""
    out: Path = Path("runs/renderer")
    """folder to write to"""
    data: Path | None = None
    """frames that datasets.cartpole_frames wrote; without, they are drawn here"""
    frames: int = 8000
    """how many are drawn here"""
    seed: int = 0
    """of the frames' states, the weights and the order of the batches"""
    layered_steps: int = 1000
    """optimisation steps of ours"""
    layered_batch: int = 32
    """frames per step"""
    mlp_steps: int = 6000
    """optimisation steps of the MLP"""
    mlp_batch: int = 64
    """frames per step"""


def train(settings: Settings) -> dict[Kind, Renderer]:
    """Train the renderers and write them to `settings.out`; a picture too where both are asked for."""
    if settings.data is None:
        data = cartpole_frames.make(cartpole_frames.Settings(frames=settings.frames, seed=settings.seed))
    else:
        data = cartpole_frames.read(settings.data)
    x, theta = (torch.from_numpy(values).float() for values in (data.x, data.theta))
    frames = torch.from_numpy(data.frames)
    height, width = data.frames.shape[1:]
    trained: dict[Kind, Renderer] = {}
    with reporting() as report:
        for kind in settings.kinds:
            # Seeded for each, so that one renderer does not depend on whether the other is trained too.
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(settings.seed)
                renderer = LayeredRenderer(height, width, **GUESS) if kind == "layered" else MLPRenderer(height, width)
            steps, batch = _steps(settings, kind)
            started, progress = time.perf_counter(), staged(report, f"renderer {kind}")
            fit(renderer, x, theta, frames, steps, torch.Generator().manual_seed(settings.seed), batch, progress)
            training = {
                **dataclasses.asdict(settings),
                "data": str(settings.data or "drawn"),
                "out": str(settings.out),
                "steps": steps,
                "batch": batch,
                "seconds": round(time.perf_counter() - started, 1),
                "versions": versions(),
            }
            with replacing(settings.out / FILES[kind]) as temporary:
                save_renderer(temporary, renderer, training)
            trained[kind] = renderer
    if len(trained) == 2:
        picture(settings.out / "renderer.png", trained["layered"], trained["mlp"])
    return trained


def _steps(settings: Settings, kind: Kind) -> tuple[int, int]:
    if kind == "layered":
        return settings.layered_steps, settings.layered_batch
    return settings.mlp_steps, settings.mlp_batch


@torch.no_grad()
def picture(
    path: Path,
    layered: Renderer,
    mlp: Renderer,
    states: Sequence[tuple[float, float]] = ((0.0, 0.02), (-0.73, -0.24), (1.13, 0.41), (0.42, 2.2)),
) -> None:
    """Drawn frames of (x in m, theta in rad) beside the learnt ones, with the differences magnified."""
    x, theta = (np.array(values) for values in zip(*states, strict=True))
    drawn = DrawnCartPole(Camera())(x, theta) / 255
    inputs = torch.from_numpy(x).float(), torch.from_numpy(theta).float()
    columns: list[tuple[str, np.ndarray]] = [("drawn", drawn)]
    for name, renderer in (("layered (ours)", layered), ("MLP (the paper's)", mlp)):
        learnt = renderer(*inputs).numpy()
        columns += [(name, learnt), (f"|difference| x {MAGNIFIED}", MAGNIFIED * np.abs(learnt - drawn))]
    figure = Figure(figsize=(2.4 * len(columns), 2.0 * len(states) + 0.4), dpi=100, layout="constrained")
    axes = figure.subplots(len(states), len(columns), squeeze=False)
    for column, (title, images) in enumerate(columns):
        for row, image in enumerate(images):
            place = axes[row, column]
            place.imshow(image, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            place.set_xticks([])
            place.set_yticks([])
            if row == 0:
                place.set_title(title, fontsize=10)
            if column == 0:
                place.set_ylabel(f"{x[row]:+.2f} m, {np.degrees(theta[row]):+.0f}°", fontsize=9)
    with replacing(path) as temporary:
        FigureCanvasAgg(figure).print_figure(temporary)


def main(settings: Settings) -> None:
    """Train, and say where the files are."""
    try:
        train(settings)
    except (ValueError, OSError) as error:
        raise SystemExit(str(error)) from error
    for kind in settings.kinds:
        print(settings.out / FILES[kind])


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

"""The learnt renderers compared: image error, what an independent estimator reads from their frames, and time.

python -m benchmarks.renderers --help

Held-out states: pole within `angle` of upright, cart within the camera's reach less half a cart, so that the cart is
whole. The estimator (benchmarks/pose_estimator.py) reads the drawn frames too: its own error is the floor of the other
rows. Writes results/renderers.csv and prints it as a table.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.pose_estimator import measure
from experiments.result_tables import Row, write_rows
from renderers import DrawnCartPole, LayeredRenderer, MLPRenderer, RendererError, load_renderer
from visadapt.weights import shipped

Floats = NDArray[np.floating]
SHIPPED = shipped("renderer")


@dataclass(frozen=True)
class Settings:
    """What is compared, on what."""

    layered: Path = SHIPPED
    """ours"""
    mlp: Path = Path("assets/renderer_mlp.safetensors")
    """the paper's"""
    out: Path = Path("results/renderers.csv")
    """table to write"""
    states: int = 2000
    """held-out states"""
    seed: int = 1_000_003
    """of the held-out states; the training frames' is another"""
    angle: float = 0.3
    """rad, largest angle of the held-out poles: up to where an episode counts as survived"""
    batch: int = 32
    """frames per timed pass"""
    repeats: int = 50
    """timed passes"""
    threads: int = 1
    """of torch, while timing"""


def compare(settings: Settings) -> list[Row]:
    """All rows of the table."""
    stream = DrawnCartPole()
    rng = np.random.default_rng(settings.seed)
    far = stream.camera.reach - stream.cart_width / 2
    x = rng.uniform(-far, far, settings.states)
    theta = rng.uniform(-settings.angle, settings.angle, settings.states)
    drawn = stream(x, theta) / 255
    rows = _read("drawn", drawn, x, theta, stream)
    size = (stream.camera.height, stream.camera.width)
    for method, path in (("layered (ours)", settings.layered), ("MLP (the paper's)", settings.mlp)):
        renderer = load_renderer(path, size)
        frames = render(renderer, x, theta)
        squared = np.square(frames - drawn).mean((1, 2))
        rows.append(_row(method, "image error, MSE", "1", float(squared.mean()), len(x), std=float(squared.std())))
        rows.append(
            _row(method, "image error over the frames' variance", "1", float(squared.mean()) / _variance(drawn), len(x))
        )
        rows += _read(method, frames, x, theta, stream)
        rows += _times(method, renderer, settings)
    return rows


@torch.no_grad()
def render(renderer: LayeredRenderer | MLPRenderer, x: Floats, theta: Floats) -> NDArray[np.float32]:
    """Frames (B, H, W) as a policy would see them, of states (B,) in m and rad."""
    inputs = zip(*(torch.from_numpy(values).float().split(100) for values in (x, theta)), strict=True)
    return np.asarray(torch.cat([renderer(*part) for part in inputs]).numpy(), np.float32)


def errors(frames: Floats, x: Floats, theta: Floats, stream: DrawnCartPole) -> tuple[Floats, Floats]:
    """Position (B,) in m and angle (B,) in rad read from frames, less the truth; NaN where none can be read."""
    seen_x, seen_theta = measure(frames, stream)
    return seen_x - x, seen_theta - theta


def _read(method: str, frames: Floats, x: Floats, theta: Floats, stream: DrawnCartPole) -> list[Row]:
    position, angle = errors(frames, x, theta, stream)
    rows = []
    for name, unit, error in (("position", "cm", 100 * position), ("angle", "degree", np.degrees(angle))):
        known = np.abs(error[np.isfinite(error)])
        failed = len(error) - len(known)
        values = (
            (np.sqrt(np.square(known).mean()), np.quantile(known, 0.95), known.max()) if len(known) else (np.nan,) * 3
        )
        for statistic, value in zip(("RMS", "95th percentile", "largest"), values, strict=True):
            rows.append(_row(method, f"{name} read, {statistic} error", unit, float(value), len(error), failed))
    return rows


def _times(method: str, renderer: LayeredRenderer | MLPRenderer, settings: Settings) -> list[Row]:
    generator = torch.Generator().manual_seed(settings.seed)
    x = (torch.rand(settings.batch, generator=generator) - 0.5).requires_grad_()
    theta = (torch.rand(settings.batch, generator=generator) - 0.5).requires_grad_()

    def forward() -> None:
        with torch.no_grad():
            renderer(x, theta)

    def both() -> None:
        # As the joint loop does: the renderer is frozen, gradients go to the states.
        torch.autograd.grad(renderer(x, theta).square().mean(), (x, theta))

    for parameter in renderer.parameters():
        parameter.requires_grad_(False)
    before = torch.get_num_threads()
    torch.set_num_threads(settings.threads)
    rows = []
    for name, work in (("forward", forward), ("forward and backward", both)):
        taken = _timed(work, settings.repeats)
        label = f"time of {name}, batch of {settings.batch}, {settings.threads} thread(s), median"
        rows.append(_row(method, label, "ms", float(np.median(taken)), None, std=float(taken.std())))
    torch.set_num_threads(before)
    return rows


def _timed(work: Callable[[], None], repeats: int) -> Floats:
    """Milliseconds (repeats,) after three passes that warm up."""
    taken = []
    for _ in range(repeats + 3):
        start = time.perf_counter()
        work()
        taken.append(1000 * (time.perf_counter() - start))
    return np.array(taken[3:])


def _variance(frames: Floats) -> float:
    """Mean over pixels of the variance over frames: the error of the best still picture."""
    return float(frames.var(0).mean())


def _row(
    method: str, measure: str, unit: str, mean: float, episodes: int | None, failed: int = 0, std: float | None = None
) -> Row:
    """`episodes` counts frames here; `failed` those from which nothing could be read."""
    mean, std = float(f"{mean:.4g}"), None if std is None else float(f"{std:.4g}")
    return Row("renderers", "cartpole", method, "source", None, measure, unit, mean, std, episodes, failed, None)


def show(rows: list[Row]) -> None:
    """Print the rows: one line per measure, one column per method."""
    methods = list(dict.fromkeys(row.method for row in rows))
    table = Table("measure", "unit", *methods, title="Renderers of the cart-pole, held-out states")
    for name, unit in dict.fromkeys((row.measure, row.unit) for row in rows):
        cells = []
        for method in methods:
            found = next((row for row in rows if row.method == method and row.measure == name), None)
            unread = f" ({found.failed} unread)" if found is not None and found.failed else ""
            cells.append("" if found is None else f"{found.mean:.3g}{unread}")
        table.add_row(name, unit, *cells)
    Console().print(table)


def main(settings: Settings) -> None:
    """Compare, write, print."""
    try:
        rows = compare(settings)
        write_rows(settings.out, rows)
    except (RendererError, OSError) as error:
        raise SystemExit(str(error)) from error
    show(rows)
    print(settings.out)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

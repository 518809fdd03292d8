"""Fitting a learnt renderer to frames of known cart positions and pole angles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from renderers.learnt import LayeredRenderer, MLPRenderer

Progress = Callable[[int, int, float], None]
"""Called with (steps done, steps in total, loss)."""

KEEP_EVERY = 100
"""Steps between two states of an interruptible training."""


def fit(
    renderer: LayeredRenderer | MLPRenderer,
    x: Tensor,
    theta: Tensor,
    frames: Tensor,
    steps: int,
    generator: torch.Generator,
    batch: int = 32,
    progress: Progress | None = None,
    keep: Callable[[dict[str, Any]], None] | None = None,
    kept: dict[str, Any] | None = None,
) -> None:
    """Minimise the mean squared error of the renderer's frames, in place, by Adam under a one-cycle learning rate.

    Args:
        renderer: to fit.
        x, theta: (N,) cart positions in m and pole angles in rad.
        frames: (N, H, W) uint8, the camera's frames there.
        steps: of the optimiser, at least 3.
        generator: draws the batches.
        batch: frames in a step.
        progress: called after each step.
        keep: called with the state of the training, plain values and tensors, every `KEEP_EVERY` steps.
        kept: such a state, from which an interrupted training continues to the same renderer.

    Raises:
        ValueError: fewer than 3 steps.
    """
    if steps < 3:
        raise ValueError(f"steps is {steps}, must be at least 3")
    renderer.start_from(x, frames)
    if isinstance(renderer, LayeredRenderer):
        places = [renderer.origin, renderer.gain]
        view = [renderer.tilt, renderer.stretch, renderer.perspective, renderer.distortion]
        camera = {id(parameter) for parameter in (*places, *view)}
        pictures = [parameter for parameter in renderer.parameters() if id(parameter) not in camera]
        groups = [{"params": pictures}, {"params": places}, {"params": view}]
        rates = [0.1, 0.05, 0.003]
    else:
        groups, rates = [{"params": list(renderer.parameters())}], [4e-3]
    # Fused, since the optimiser would take most of a step of the MLP, whose last layer has 3 million weights.
    optimiser = torch.optim.Adam(groups, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rates, total_steps=steps, pct_start=max(0.2, 2 / steps))
    parts: dict[str, Any] = {"renderer": renderer, "optimiser": optimiser, "schedule": schedule}
    begun = 0
    if kept is not None:
        begun = kept["step"]
        for name, part in parts.items():
            part.load_state_dict(kept[name])
        generator.set_state(kept["generator"])
    for step in range(begun, steps):
        rows = torch.randint(len(frames), (batch,), generator=generator)
        loss = (renderer(x[rows], theta[rows]) - frames[rows].to(x) / 255).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if progress is not None:
            progress(step + 1, steps, float(loss.detach()))
        if keep is not None and (step + 1) % KEEP_EVERY == 0:
            states = {name: part.state_dict() for name, part in parts.items()}
            keep({"step": step + 1, "generator": generator.get_state(), **states})

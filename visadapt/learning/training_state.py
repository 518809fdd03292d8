"""Training that can be interrupted: all the state that is needed to continue to the same numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from visadapt.storage.checkpoints import fitting, load_network, load_tree, load_weights, save_network, save_tree

CHECKPOINT_ITERATIONS = 100
"""Iterations between two checkpoints."""


@dataclass
class TrainingState:
    """A network in training, its optimiser, learning-rate schedule and random generator, and its losses so far."""

    network: nn.Module
    optimiser: torch.optim.Optimizer
    generator: torch.Generator
    learning_rate: float
    """the highest of the schedule"""
    iterations: int
    progress: Callable[[int, int, float], None] | None
    """called with (iterations done, iterations in total, loss)"""
    path: Path | None
    """file of the state; None keeps it nowhere"""
    losses: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimiser, self.learning_rate, total_steps=self.iterations, pct_start=0.1
        )

    def resume(self) -> dict[str, Any] | None:
        """Restore what an interrupted training left; returns what else it kept, None where there is nothing.

        Raises:
            CheckpointError: it does not fit.
        """
        if self.path is None or not self.path.exists():
            return None
        tree = load_tree(self.path)
        with fitting(self.path):
            load_weights(self.network, tree["network"], self.path)
            self.optimiser.load_state_dict(tree["optimiser"])
            self.schedule.load_state_dict(tree["schedule"])
            self.generator.set_state(tree["generator"])
            self.losses = [float(loss) for loss in tree["losses"]]
            more: dict[str, Any] = tree["more"]
            return more

    def descend(self, loss: Tensor) -> None:
        """One step against the gradient, of a norm of 1 at most."""
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.schedule.step()
        self.losses.append(float(loss.detach()))

    def keep(self, more: dict[str, Any]) -> None:
        """Report the iteration; every `CHECKPOINT_ITERATIONS` of them write the state, and what else the loop needs."""
        done = len(self.losses)
        if self.progress is not None:
            self.progress(done, self.iterations, self.losses[-1])
        if self.path is not None and done % CHECKPOINT_ITERATIONS == 0:
            tree = {
                "network": self.network.state_dict(),
                "optimiser": self.optimiser.state_dict(),
                "schedule": self.schedule.state_dict(),
                "generator": self.generator.get_state(),
                "losses": self.losses,
                "more": more,
            }
            save_tree(self.path, tree)


def train_or_load(path: Path, network: nn.Module, about: Mapping[str, Any], train: Callable[[Path], object]) -> None:
    """Give `network` the weights in `path`; where there are none yet, train it, and keep it there with `about` it.

    `train` is given the file beside `path` that it keeps its state in, and from which an interrupted one goes on.
    """
    if path.exists():
        load_network(path, network)
        return
    partial = path.with_suffix(".partial.safetensors")
    train(partial)
    save_network(path, network, about)
    partial.unlink(missing_ok=True)

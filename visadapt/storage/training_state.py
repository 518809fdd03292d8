"""Training that can be interrupted: all the state that is needed to continue to the same numbers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from visadapt.storage.checkpoints import load_tree, load_weights, save_tree

CHECKPOINT_ITERATIONS = 100
"""Iterations between two checkpoints."""


@dataclass
class TrainingState:
    """A network in training, its optimiser, learning-rate schedule and random generator."""

    network: nn.Module
    optimiser: torch.optim.Optimizer
    schedule: torch.optim.lr_scheduler.LRScheduler
    generator: torch.Generator

    def keep(self, path: Path, losses: list[float], more: dict[str, Any]) -> None:
        """Write the state to `path`, with the losses so far and `more`, whatever else the loop needs."""
        tree = {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "schedule": self.schedule.state_dict(),
            "generator": self.generator.get_state(),
            "losses": losses,
            "more": more,
        }
        save_tree(path, tree)

    def resume(self, path: Path) -> tuple[list[float], dict[str, Any]]:
        """Restore what `keep` wrote; returns the losses and `more`; raises CheckpointError where it does not fit."""
        tree = load_tree(path)
        load_weights(self.network, tree["network"], path)
        self.optimiser.load_state_dict(tree["optimiser"])
        self.schedule.load_state_dict(tree["schedule"])
        self.generator.set_state(tree["generator"])
        return tree["losses"], tree["more"]

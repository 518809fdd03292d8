"""Training that can be interrupted: all the state that is needed to continue to the same numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from visadapt.storage.checkpoints import (
    CheckpointError,
    fitting,
    load_network,
    load_tree,
    load_weights,
    save_network,
    save_tree,
)

CHECKPOINT_ITERATIONS = 100
"""Iterations between two checkpoints."""

RENAMED = {"cost_of": "plan_cost"}
"""Fields of settings, by the names that files of earlier versions give them."""


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
    """file of the state; None: it is not written"""
    losses: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        # OneCycleLR divides by zero where the warm-up is of exactly one step.
        warm_up = 0.1 if self.iterations != 10 else 0.2
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimiser, self.learning_rate, total_steps=self.iterations, pct_start=warm_up
        )

    def resume(self) -> dict[str, Any] | None:
        """Restore what an interrupted training wrote; returns the `more` that `keep` was given, None without a file.

        Raises:
            CheckpointError: the file is of another network or training.
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
            return tree["more"]

    def descend(self, loss: Tensor) -> None:
        """One step of optimiser and schedule, with the gradient clipped to a norm of 1."""
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.schedule.step()
        self.losses.append(float(loss.detach()))

    def keep(self, more: dict[str, Any]) -> None:
        """Report progress; every `CHECKPOINT_ITERATIONS` iterations write the state, and `more` for the loop."""
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


def train_or_load(
    path: Path,
    network: nn.Module,
    about: Mapping[str, Any],
    train: Callable[[Path], object],
    may_be_unstated: Collection[str] = (),
) -> None:
    """Give `network` the weights in `path`; where there is no such file, train it and write it, described by `about`.

    Args:
        train: is given the file, beside `path`, of its training state, from which an interrupted training goes on.
        may_be_unstated: keys of `about` that a file may lack.

    Raises:
        CheckpointError: `path`, or what an interrupted training left, holds another network, or one that is trained in
            another way.
    """
    partial, begun = path.with_suffix(".partial.safetensors"), path.with_suffix(".begun.safetensors")
    if path.exists():
        _check(path, load_network(path, network), about, may_be_unstated)
    else:
        if partial.exists() and begun.exists():
            _check(partial, load_tree(begun), about, may_be_unstated)
        save_tree(begun, about)
        train(partial)
        save_network(path, network, about)
    for each in (partial, begun):  # also those of a run that was killed right after it had written `path`
        each.unlink(missing_ok=True)


def _check(path: Path, kept: Mapping[str, Any], about: Mapping[str, Any], may_be_unstated: Collection[str]) -> None:
    """Raise CheckpointError where the settings `kept` with the training in `path` differ from those in `about`."""
    stated = {key: value for key, value in about.items() if key in kept or key not in may_be_unstated}
    if other := [key for key, value in stated.items() if key not in kept or not _same(kept[key], value)]:
        raise CheckpointError(
            f"{path}: was trained with other values of {', '.join(other)}: remove it, or name another file"
        )


def _same(kept: Any, wanted: Any) -> bool:
    """Whether two values are equal, with numbers up to rounding: a file may come from another machine.

    Tensors and tuples equal lists, as which they may come back from a file.
    """
    kept, wanted = (each.tolist() if isinstance(each, Tensor) else each for each in (kept, wanted))
    if isinstance(kept, Mapping) and isinstance(wanted, Mapping):
        kept = {RENAMED.get(key, key): value for key, value in kept.items()}
        return kept.keys() == wanted.keys() and all(_same(kept[key], wanted[key]) for key in kept)
    if isinstance(kept, list | tuple) and isinstance(wanted, list | tuple):
        return len(kept) == len(wanted) and all(map(_same, kept, wanted))
    if isinstance(kept, float) and isinstance(wanted, float):
        return math.isclose(kept, wanted, rel_tol=1e-9)
    return bool(kept == wanted)

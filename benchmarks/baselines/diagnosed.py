"""Ours with the diagnosed effect in the simulator; a residual learns the gap only where nothing is named."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from benchmarks.baselines import ours
from benchmarks.baselines.cartpole import CartPoleProblem
from benchmarks.baselines.problem import Sizes, Stage


def stages(problem: CartPoleProblem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """As those of `ours`."""
    yield from ours.stages(problem, sizes, folder, seed, diagnose=True)

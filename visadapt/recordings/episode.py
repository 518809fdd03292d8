"""The episode: what was measured and commanded, row by row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Episode:
    """One uninterrupted run of T rows, state or frame or both.

    Row t holds what was measured at t and the action commanded from t to t + 1; the action of the last row was
    not executed, so T rows are T - 1 samples.

    Raises:
        ValueError: rows that do not match, a clock that does not run forward, or a value that is not finite.
    """

    time: NDArray[np.floating]
    """(T,) s since the episode began"""
    action: NDArray[np.floating]
    """(T, n_action)"""
    state: NDArray[np.floating] | None = None
    """(T, n_state), SI units"""
    frame: NDArray[np.uint8] | None = None
    """(T, H, W)"""

    def __post_init__(self) -> None:
        rows = len(self.time)
        if rows < 1:
            raise ValueError("an episode needs at least one row")
        if self.state is None and self.frame is None:
            raise ValueError("an episode needs states or frames")
        for name, values in (("action", self.action), ("state", self.state), ("frame", self.frame)):
            if values is None:
                continue
            if len(values) != rows:
                raise ValueError(f"an episode of {rows} rows has {len(values)} rows of {name}")
            bad = ~np.isfinite(values.reshape(rows, -1)).all(1) if values.dtype != np.uint8 else np.zeros(rows, bool)
            if bad.any():
                raise ValueError(f"{name} is not finite in row {int(bad.argmax())} of {rows}")
        backwards = np.diff(self.time) <= 0
        if backwards.any():
            raise ValueError(f"the clock does not run forward after row {int(backwards.argmax())}")

    @property
    def samples(self) -> int:
        """Executed actions: what the ledger counts."""
        return len(self.time) - 1

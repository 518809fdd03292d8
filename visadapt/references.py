"""References that a quadrotor is to follow: positions and velocities on a steady clock, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from torch import Tensor

from visadapt.flatness import demanded


@dataclass(frozen=True)
class Reference:
    """One reference, or many of one length: leading axes (...) number them, the next is time. World axes, z up."""

    positions: Tensor
    """(..., T, 3) m"""
    velocities: Tensor
    """(..., T, 3) m/s"""
    accelerations: Tensor
    """(..., T, 3) m/s2"""
    jerks: Tensor
    """(..., T, 3) m/s3"""
    period: float
    """s between rows"""

    @classmethod
    def of(cls, motion: Tensor, period: float) -> Self:
        """From positions, velocities, accelerations and jerks, one after the other: (4, ..., T, 3)."""
        positions, velocities, accelerations, jerks = motion
        return cls(positions, velocities, accelerations, jerks, period)

    def states(self, gravity: float = 9.81) -> Tensor:
        """The quadrotor's states (..., T, 13) on the reference; the first row is where an episode starts."""
        return demanded(self.accelerations, self.jerks, gravity).state(self.positions, self.velocities)

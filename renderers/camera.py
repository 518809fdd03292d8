"""A fixed camera whose image plane is parallel to the plane of motion."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Camera:
    """Maps metres in the plane of motion to pixels. Pixel centres are at whole numbers, rows count downwards."""

    width: int = 120
    """px"""
    height: int = 100
    """px"""
    scale: float = 40.0
    """px per m"""
    column: float = 59.5
    """px, column of x = 0"""
    row: float = 74.5
    """px, row of the pole's hinge"""

    @property
    def reach(self) -> float:
        """Largest |x| in m at which the hinge is in the frame."""
        return min(self.column + 0.5, self.width - 0.5 - self.column) / self.scale

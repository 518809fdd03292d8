"""A camera that stands still and looks at a plane of motion squarely."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Camera:
    """Maps metres in the plane of motion to pixels. Pixel centres lie at whole numbers, rows count downwards."""

    width: int = 120
    """px"""
    height: int = 100
    """px"""
    scale: float = 40.0
    """px per m"""
    column: float = 59.5
    """px, where x = 0 is"""
    row: float = 74.5
    """px, where the hinge of the pole is"""

    @property
    def reach(self) -> float:
        """Largest |x| in m of a cart whose hinge is in the frame."""
        return min(self.column + 0.5, self.width - 0.5 - self.column) / self.scale

"""What all films share: panels side by side on one clock, shown as stills or written as an mp4."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import numpy as np

from visadapt.films.canvas import Canvas, Floats, Picture
from visadapt.films.encoding import StrPath, write_mp4, write_picture
from visadapt.progress import Progress


class Film(ABC):
    """Runs side by side. A subclass knows one kind of run and draws its panel; a panel is the picture of one run."""

    panel_width: ClassVar[int]
    """px"""
    panel_height: ClassVar[int]
    """px"""
    panels_in_row: ClassVar[int | None] = None
    """None: all in one row"""

    panels: Sequence[Any]
    period: float
    """s between frames"""

    @property
    @abstractmethod
    def times(self) -> Sequence[float]:
        """s, of the frames"""

    @abstractmethod
    def draw_panel(self, canvas: Canvas, panel: Any, t: float) -> None:
        """Draw a panel as it is at t s on a canvas of its size."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame in px, both even, as yuv420p demands."""
        left, top = self._corner(min(len(self.panels), self._columns) - 1), self._corner(len(self.panels) - 1)
        width, height = left[0] + self.panel_width + 28, top[1] + self.panel_height + 28
        return width + width % 2, height + height % 2

    def still(self, t: float) -> Picture:
        """The frame (H, W, 3) at t s."""
        canvas = Canvas(*self.size)
        for index, panel in enumerate(self.panels):
            self.draw_panel(canvas.part(*self._corner(index), self.panel_width, self.panel_height), panel, t)
        return canvas.pixels

    def write_still(self, path: StrPath, t: float) -> None:
        """Write the frame at t s as a PNG."""
        write_picture(path, self.still(t))

    def write(self, path: StrPath, progress: Progress | None = None) -> None:
        """Write an mp4 (H.264, yuv420p) in real time.

        Raises:
            DiskFullError: the disk is full; a file that was at `path` before is unchanged.
            FilmError: ffmpeg failed for another reason; a file that was at `path` before is unchanged.
        """
        write_mp4(path, self._frames(progress), self.size, self.period)

    def _frames(self, progress: Progress | None) -> Iterator[Picture]:
        times = self.times
        for done, t in enumerate(times, 1):
            yield self.still(t)
            if progress is not None:
                progress(done, len(times), float("nan"))

    @property
    def _columns(self) -> int:
        return self.panels_in_row or len(self.panels)

    def _corner(self, index: int) -> tuple[int, int]:
        """Left and top in px of a panel: 28 px from the left edge, 16 px from the top, 36 px and 14 px apart."""
        row, column = divmod(index, self._columns)
        return 28 + column * (self.panel_width + 36), 16 + row * (self.panel_height + 14)


def last_row(times: Floats, t: float) -> int:
    """Index of the last of rising times (T,) in s at or before t s; 0 where there is none."""
    return max(int(np.searchsorted(times, t + 1e-6, side="right")) - 1, 0)

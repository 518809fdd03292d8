"""What all films share: panels side by side on one clock, shown as stills or written as an mp4, and the panels' parts.

What stands still is drawn once for a film; a frame is what moves, drawn on top of it by the same artists.
"""

from __future__ import annotations

import os
import signal
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any, ClassVar

import imageio_ffmpeg
import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from visadapt.films.widgets import STYLE
from visadapt.progress import Progress
from visadapt.storage.atomic_files import replacing

StrPath = str | os.PathLike[str]
PX_PER_INCH = 72
"""With these, matplotlib's points, in which it measures text and lines, are pixels."""
MARGIN, TOP_MARGIN, COLUMN_GAP, ROW_GAP = 28, 16, 36, 14
"""px around the panels of a film, above them, and between them"""


class FilmError(OSError):
    """ffmpeg could not write a film; the message is one line that names the file and quotes ffmpeg."""


class Film(ABC):
    """Runs side by side. A subclass knows one kind of run and draws its panel; a panel is the picture of one run."""

    panel_width: ClassVar[int]
    """px"""
    panel_height: ClassVar[int]
    """px"""

    def __init__(self, panels: Sequence[Any], period: float) -> None:
        if not panels:
            raise ValueError("a film needs at least one panel")
        if not period > 0:
            raise ValueError(f"the period of a film must be positive, got {period!r} s")
        self.panels, self.period = panels, period

    @property
    @abstractmethod
    def times(self) -> Sequence[float]:
        """s, of the frames"""

    @abstractmethod
    def draw_panel(self, page: Axes, panel: Any) -> Callable[[float], None]:
        """Draw a panel on a page, axes in px from the top left corner; returns a function that updates it to time t, s.

        Artists that are to move are `animated`.
        """

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame in px, both even, as yuv420p demands."""
        width, height = self._corner(self._columns - 1)[0], self._corner(len(self.panels) - 1)[1]
        width, height = width + self.panel_width + MARGIN, height + self.panel_height + MARGIN
        return width + width % 2, height + height % 2

    def still(self, t: float) -> NDArray[np.uint8]:
        """The frame (H, W, 3) at t s: red, green, blue."""
        return np.array(self._frame(t))[..., :3]

    def write_still(self, path: StrPath, t: float) -> None:
        """Write the frame at t s as a PNG."""
        with replacing(path) as temporary:
            Image.fromarray(self.still(t)).save(temporary, "PNG", optimize=True)

    def write(self, path: StrPath, progress: Progress | None = None) -> None:
        """Write an mp4 (H.264, yuv420p) in real time.

        Raises:
            DiskFullError: the disk is full; a file that was at `path` before is unchanged.
            FilmError: ffmpeg failed for another reason; a file that was at `path` before is unchanged.
        """
        size, colours = "{}x{}".format(*self.size), "colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv"
        command = [
            imageio_ffmpeg.get_ffmpeg_exe(),
            *("-y", "-nostdin", "-loglevel", "error"),
            *("-f", "rawvideo", "-pix_fmt", "rgb0", "-s", size, "-r", f"{1 / self.period:g}", "-i", "-"),
            # State the colour space: players guess otherwise, and guess differently.
            *("-vf", f"scale=out_color_matrix=bt709:out_range=tv,setparams={colours}"),
            *("-c:v", "libx264", "-preset", "medium", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"),
            *("-f", "mp4"),
        ]
        with replacing(path) as temporary:
            # Not through imageio, which does not report that ffmpeg failed at the end.
            ffmpeg = subprocess.Popen([*command, str(temporary)], stdin=subprocess.PIPE, stderr=subprocess.PIPE)
            assert ffmpeg.stdin is not None
            try:
                with suppress(BrokenPipeError):  # ffmpeg has ended; its message is read below
                    for done, t in enumerate(self.times, 1):
                        ffmpeg.stdin.write(self._frame(t))
                        if progress is not None:
                            progress(done, len(self.times), float("nan"))
                messages = ffmpeg.communicate()[1].decode(errors="replace").strip().splitlines()
            finally:
                ffmpeg.kill()
                ffmpeg.wait()
            status = ffmpeg.returncode
            if status < 0:
                raise FilmError(f"{path} was not written: ffmpeg was stopped by {signal.Signals(-status).name}")
            if status > 0 or messages:
                raise FilmError(f"{path} was not written: ffmpeg says {messages[0] if messages else f'exit {status}'}")

    def _frame(self, t: float) -> memoryview:
        """(H, W, 4) uint8 with opacity, which the next frame overwrites."""
        canvas, background, moving, moves = self._drawn
        canvas.restore_region(background)
        for move in moves:
            move(t)
        for artist in moving:
            canvas.figure.draw_artist(artist)
        return canvas.buffer_rgba()

    @cached_property
    def _drawn(self) -> tuple[Any, Any, list[Artist], list[Callable[[float], None]]]:
        """What is drawn on, what stands still there, what moves, and what moves it."""
        width, height = self.size
        with matplotlib.rc_context(STYLE):
            figure = Figure((width / PX_PER_INCH, height / PX_PER_INCH), PX_PER_INCH)
            canvas: Any = FigureCanvasAgg(figure)
            moves = []
            for index, panel in enumerate(self.panels):
                left, top = self._corner(index)
                bottom = height - top - self.panel_height
                box = np.array([left, bottom, self.panel_width, self.panel_height]) / (width, height, width, height)
                page = figure.add_axes(tuple(box), xlim=(0, self.panel_width), ylim=(self.panel_height, 0))
                page.set_axis_off()
                moves.append(self.draw_panel(page, panel))
            canvas.draw()
        moving = sorted(figure.findobj(lambda artist: artist.get_animated()), key=lambda artist: artist.get_zorder())
        return canvas, canvas.copy_from_bbox(figure.bbox), moving, moves

    @property
    def _columns(self) -> int:
        """Up to three panels are in one row, more in two."""
        return len(self.panels) if len(self.panels) <= 3 else -(-len(self.panels) // 2)

    def _corner(self, index: int) -> tuple[int, int]:
        """Left and top in px of a panel."""
        row, column = divmod(index, self._columns)
        return MARGIN + column * (self.panel_width + COLUMN_GAP), TOP_MARGIN + row * (self.panel_height + ROW_GAP)

"""Films of runs side by side: an mp4 that any browser plays, a short clip for a README, and stills of both.

    panels = [Panel.redrawn("source", before_transfer, camera), Panel.redrawn("target", after, camera)]
    write_film("film.mp4", panels, period=0.05)

All panels share one clock; one whose episode has ended stands still at its last frame.
"""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np
from PIL import Image

from visadapt.films.canvas import Canvas, Picture
from visadapt.films.cartpole_panel import HEIGHT, WIDTH, Panel, Scales, draw_panel
from visadapt.storage.atomic_files import replacing

__all__ = ["Panel", "still", "write_clip", "write_film", "write_frames", "write_picture", "write_still"]

MARGIN, GUTTER = 28, 36
"""px, around the panels and between them"""
StrPath = str | os.PathLike[str]
Progress = Callable[[int, int], None]
"""Told how many frames of how many are done."""


class FilmError(OSError):
    """A film could not be written; the message is one line that names it."""


def still(panels: Sequence[Panel], t: float) -> Picture:
    """The film's frame (H, W, 3) at t s, height and width even."""
    return _still(panels, t, _scales(panels))


def write_still(path: StrPath, panels: Sequence[Panel], t: float) -> None:
    """Write the film's frame at t s as a PNG."""
    write_picture(path, still(panels, t))


def write_picture(path: StrPath, picture: Picture) -> None:
    """Write a picture as a PNG."""
    with replacing(path) as temporary:
        Image.fromarray(picture).save(temporary, "PNG", optimize=True)


def write_film(path: StrPath, panels: Sequence[Panel], period: float, progress: Progress | None = None) -> None:
    """Write an mp4 (H.264, yuv420p) in real time: one frame every `period` s until the longest run has ended.

    Raises:
        ValueError: no panels, or a period that is not positive.
        DiskFullError: the disk is full; nothing stands under the film's name that did not before.
        FilmError: ffmpeg gave up for another reason.
    """
    times, scales = _times(panels, period), _scales(panels)
    write_frames(path, lambda t: _still(panels, t, scales), times, period, progress)


def write_frames(
    path: StrPath,
    draw: Callable[[float], Picture],
    times: Sequence[float],
    period: float,
    progress: Progress | None = None,
) -> None:
    """Write an mp4 (H.264, yuv420p) of what `draw` shows at times in s, one every `period` s; width and height even.

    Raises:
        DiskFullError: the disk is full; nothing stands under the film's name that did not before.
        FilmError: ffmpeg gave up for another reason.
    """
    height, width = draw(times[0]).shape[:2]
    with replacing(path) as temporary:
        frames = _counted(map(draw, times), len(times), progress)
        _encode(temporary, Path(path), frames, (width, height), 1 / period)


def write_clip(
    path: StrPath,
    panels: Sequence[Panel],
    period: float,
    start: float = 0.0,
    seconds: float = 6.0,
    width: int = 1000,
    quality: int = 60,
) -> None:
    """Write a short, looping animated WebP of every other frame, `width` px wide: a README shows it as it is."""
    times, scales = _times(panels, period), _scales(panels)
    chosen = [t for t in times[::2] if start - 1e-6 <= t <= start + seconds + 1e-6]
    if not chosen:
        raise ValueError(f"a clip from {start:g} s on is empty: the film ends at {times[-1]:g} s")
    whole = _size(panels)
    size = (width, round(whole[1] * width / whole[0]))
    images = [
        Image.fromarray(np.asarray(cv2.resize(_still(panels, t, scales), size, interpolation=cv2.INTER_AREA), np.uint8))
        for t in chosen
    ]
    with replacing(path) as temporary:
        images[0].save(
            temporary,
            "WEBP",
            save_all=True,
            append_images=images[1:],
            duration=round(2000 * period),
            loop=0,
            quality=quality,
            method=4,
        )


def _scales(panels: Sequence[Panel]) -> Scales:
    if not panels:
        raise ValueError("a film needs at least one panel")
    return Scales.of(panels)


def _times(panels: Sequence[Panel], period: float) -> list[float]:
    if not panels:
        raise ValueError("a film needs at least one panel")
    if not period > 0:
        raise ValueError(f"the period of a film must be positive, got {period!r} s")
    return [i * period for i in range(round(max(panel.end for panel in panels) / period) + 1)]


def _size(panels: Sequence[Panel]) -> tuple[int, int]:
    """Width and height in px, both even, as yuv420p wants them."""
    width = 2 * MARGIN + WIDTH * len(panels) + GUTTER * (len(panels) - 1)
    return width + width % 2, (2 * MARGIN + HEIGHT - 12) // 2 * 2


def _still(panels: Sequence[Panel], t: float, scales: Scales) -> Picture:
    canvas = Canvas(*_size(panels))
    for i, panel in enumerate(panels):
        draw_panel(canvas.part(MARGIN + i * (WIDTH + GUTTER), MARGIN - 12, WIDTH, HEIGHT), panel, t, scales)
    return canvas.pixels


def _counted(frames: Iterator[Picture], total: int, progress: Progress | None) -> Iterator[Picture]:
    for done, frame in enumerate(frames, 1):
        yield frame
        if progress is not None:
            progress(done, total)


def _encode(temporary: Path, path: Path, frames: Iterator[Picture], size: tuple[int, int], rate: float) -> None:
    """Pipe frames through ffmpeg. It is run here and not through imageio, which does not tell when its end failed."""
    colours = "colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv"
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        *("-y", "-nostdin", "-loglevel", "error"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{rate:g}", "-i", "-"),
        # Say which colours these are: players guess otherwise, and guess differently.
        *("-vf", f"scale=out_color_matrix=bt709:out_range=tv,setparams={colours}"),
        *("-c:v", "libx264", "-preset", "medium", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"),
        *("-f", "mp4", str(temporary)),
    ]
    ffmpeg = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert ffmpeg.stdin is not None
    assert ffmpeg.stderr is not None
    try:
        with suppress(BrokenPipeError):  # ffmpeg has given up: it says why below
            for frame in frames:
                ffmpeg.stdin.write(frame.tobytes())
        with suppress(BrokenPipeError):
            ffmpeg.stdin.close()
        said = ffmpeg.stderr.read().decode(errors="replace").strip().splitlines()
        status = ffmpeg.wait()
    finally:
        if ffmpeg.poll() is None:
            ffmpeg.kill()
            ffmpeg.wait()
        ffmpeg.stderr.close()
    if status < 0:
        raise FilmError(f"{path} was not written: ffmpeg was stopped by {signal.Signals(-status).name}")
    if status > 0 or said:
        raise FilmError(f"{path} was not written: ffmpeg says {said[0] if said else f'exit {status}'}")

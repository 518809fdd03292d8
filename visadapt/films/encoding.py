"""Pictures to files: an mp4 that any browser plays, and PNGs."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import imageio_ffmpeg
from PIL import Image

from visadapt.films.canvas import Picture
from visadapt.storage.atomic_files import replacing

StrPath = str | os.PathLike[str]


class FilmError(OSError):
    """ffmpeg could not write a film; the message is one line that names the file and quotes ffmpeg."""


def write_picture(path: StrPath, picture: Picture) -> None:
    """Write a picture as a PNG."""
    with replacing(path) as temporary:
        Image.fromarray(picture).save(temporary, "PNG", optimize=True)


def write_mp4(path: StrPath, pictures: Iterable[Picture], size: tuple[int, int], period: float) -> None:
    """Write pictures, one every `period` s, as an mp4 (H.264, yuv420p).

    Args:
        path: of the mp4.
        pictures: each (height, width, 3), red, green, blue.
        size: (width, height) in px, both even, as yuv420p demands.
        period: s between pictures.

    Raises:
        DiskFullError: the disk is full; a file that was at `path` before is unchanged.
        FilmError: ffmpeg failed for another reason; a file that was at `path` before is unchanged.
    """
    with replacing(path) as temporary:
        _encode(temporary, Path(path), pictures, size, 1 / period)


def _encode(temporary: Path, path: Path, pictures: Iterable[Picture], size: tuple[int, int], rate: float) -> None:
    """Pipe pictures through ffmpeg. Not through imageio, which does not report that ffmpeg failed at the end."""
    colours = "colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv"
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        *("-y", "-nostdin", "-loglevel", "error"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", f"{rate:g}", "-i", "-"),
        # State the colour space: players guess otherwise, and guess differently.
        *("-vf", f"scale=out_color_matrix=bt709:out_range=tv,setparams={colours}"),
        *("-c:v", "libx264", "-preset", "medium", "-crf", "20", "-pix_fmt", "yuv420p", "-movflags", "+faststart"),
        *("-f", "mp4", str(temporary)),
    ]
    ffmpeg = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert ffmpeg.stdin is not None
    assert ffmpeg.stderr is not None
    try:
        with suppress(BrokenPipeError):  # ffmpeg has ended; its message is read below
            for picture in pictures:
                ffmpeg.stdin.write(picture.tobytes())
        with suppress(BrokenPipeError):
            ffmpeg.stdin.close()
        messages = ffmpeg.stderr.read().decode(errors="replace").strip().splitlines()
        status = ffmpeg.wait()
    finally:
        if ffmpeg.poll() is None:
            ffmpeg.kill()
            ffmpeg.wait()
        ffmpeg.stderr.close()
    if status < 0:
        raise FilmError(f"{path} was not written: ffmpeg was stopped by {signal.Signals(-status).name}")
    if status > 0 or messages:
        raise FilmError(f"{path} was not written: ffmpeg says {messages[0] if messages else f'exit {status}'}")

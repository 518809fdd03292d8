"""A canvas for film frames: crisp text, anti-aliased lines and boxes at sub-pixel coordinates. Needs no display."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from visadapt.films.colours import HAIRLINE, INK, PAPER, Colour

Floats = NDArray[np.floating]
Picture = NDArray[np.uint8]
"""(H, W, 3), red, green, blue."""

FRACTION_BITS = 6
"""OpenCV takes coordinates as whole numbers of 2**-FRACTION_BITS px."""
FARTHEST_PX = 1e5
"""Coordinates are clipped to +- this, far outside any canvas, so that they fit OpenCV's 32-bit integers."""


class Canvas:
    """An area to draw on. (0, 0) is the top left corner of the top left pixel; everything is clipped to the area."""

    def __init__(self, width: int, height: int, colour: Colour = PAPER) -> None:
        self.pixels: Picture = np.full((height, width, 3), colour, np.uint8)

    def part(self, left: int, top: int, width: int, height: int) -> Canvas:
        """A canvas that draws on a part of this one, with its own origin."""
        inner = Canvas.__new__(Canvas)
        inner.pixels = self.pixels[top : top + height, left : left + width]
        return inner

    @property
    def width(self) -> int:
        """px"""
        return self.pixels.shape[1]

    @property
    def height(self) -> int:
        """px"""
        return self.pixels.shape[0]

    def line(self, points: Floats, colour: Colour, thickness: int = 1) -> None:
        """A polyline through points (n, 2)."""
        if len(points) > 1:
            cv2.polylines(self.pixels, [_fixed(points)], False, colour, thickness, cv2.LINE_AA, FRACTION_BITS)

    def dashes(self, start: tuple[float, float], end: tuple[float, float], colour: Colour, length: float = 5.0) -> None:
        """A straight dashed line, 1 px thick."""
        a, b = np.array(start), np.array(end)
        whole = float(np.linalg.norm(b - a))
        for at in np.arange(0.0, whole, 2 * length):
            stop = min(at + length, whole)
            self.line(np.stack([a + (b - a) * at / whole, a + (b - a) * stop / whole]), colour)

    def polygon(self, corners: Sequence[tuple[float, float]] | Floats, colour: Colour) -> None:
        """A filled convex polygon."""
        cv2.fillConvexPoly(self.pixels, _fixed(np.array(corners)), colour, cv2.LINE_AA, FRACTION_BITS)

    def disc(self, centre: Floats, radius: float, colour: Colour, corners: int = 20) -> None:
        """A filled disc, drawn as a regular polygon."""
        angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
        self.polygon(centre + radius * np.stack([np.cos(angle), np.sin(angle)], -1), colour)

    def glass(self, corners: Floats, colour: Colour, opacity: float) -> None:
        """A filled convex polygon of an opacity in [0, 1]."""
        size = (self.width, self.height)
        left, top = np.clip(np.floor(corners.min(0)).astype(int) - 1, 0, size)
        right, bottom = np.clip(np.ceil(corners.max(0)).astype(int) + 1, 0, size)
        if left < right and top < bottom:
            cover = np.zeros((bottom - top, right - left), np.uint8)
            cv2.fillConvexPoly(cover, _fixed(corners - (left, top)), 255, cv2.LINE_AA, FRACTION_BITS)
            inside = (slice(top, bottom), slice(left, right))
            self._blend(inside, cover.astype(np.float32) * (opacity / 255), colour)

    def box(self, left: float, top: float, right: float, bottom: float, colour: Colour) -> None:
        """A filled box; its edges blend with what is behind them in proportion to the pixels they cover."""
        rows, columns = _cover(top, bottom, self.height), _cover(left, right, self.width)
        y, x = np.flatnonzero(rows), np.flatnonzero(columns)
        if len(y) and len(x):
            inside = (slice(y[0], y[-1] + 1), slice(x[0], x[-1] + 1))
            self._blend(inside, rows[inside[0], None] * columns[inside[1]], colour)

    def frame(self, left: int, top: int, right: int, bottom: int, colour: Colour = HAIRLINE) -> None:
        """An outline 1 px thick, inside the box."""
        for box in ((left, top, right, top + 1), (left, bottom - 1, right, bottom)):
            self.box(*box, colour)
        for box in ((left, top, left + 1, bottom), (right - 1, top, right, bottom)):
            self.box(*box, colour)

    def arrow(
        self, tail: tuple[float, float], tip: tuple[float, float], colour: Colour, thickness: float = 6.0
    ) -> None:
        """A horizontal arrow with a solid head; one shorter than its head is drawn as the head alone."""
        length = abs(tip[0] - tail[0])
        sign, head, y = np.sign(tip[0] - tail[0]), min(length, 2.6 * thickness), tip[1]
        neck, half = tip[0] - sign * head, head / 2.6
        if length > head:
            self.box(min(tail[0], neck), y - thickness / 2, max(tail[0], neck), y + thickness / 2, colour)
        self.polygon([(tip[0], y), (neck, y - half * 1.3), (neck, y + half * 1.3)], colour)

    def text(
        self,
        x: float,
        baseline: float,
        string: str,
        size: int,
        colour: Colour = INK,
        bold: bool = False,
        align: Literal["left", "centre", "right"] = "left",
    ) -> None:
        """A line of text, `size` px tall; `align` says which of its ends, or its middle, is at x px."""
        mask, left, top, advance = _glyphs(string, size, bold)
        start = round(x - {"left": 0.0, "centre": advance / 2, "right": advance}[align]) + left
        row = round(baseline) + top
        upper, first = max(row, 0), max(start, 0)
        lower, last = min(row + mask.shape[0], self.height), min(start + mask.shape[1], self.width)
        if upper < lower and first < last:
            cover = mask[upper - row : lower - row, first - start : last - start]
            self._blend((slice(upper, lower), slice(first, last)), cover, colour)

    def paste(self, left: int, top: int, picture: Picture) -> None:
        """Copies a picture, which must fit on the canvas, to (left, top) px."""
        self.pixels[top : top + picture.shape[0], left : left + picture.shape[1]] = picture

    def fade(self, share: float, colour: Colour = PAPER) -> None:
        """Blends the whole area a share of the way towards a colour."""
        self._blend((slice(None), slice(None)), np.array(share, np.float32)[None, None], colour)

    def _blend(self, inside: tuple[slice, slice], cover: Floats, colour: Colour) -> None:
        below = self.pixels[inside].astype(np.float32)
        blended = below + (np.array(colour, np.float32) - below) * cover[..., None]
        self.pixels[inside] = np.round(blended).astype(np.uint8)


def text_width(string: str, size: int, bold: bool = False) -> float:
    """Width in px of a line of text."""
    return _glyphs(string, size, bold)[3]


@lru_cache(maxsize=4)
def _font_file(bold: bool) -> Path:
    # Installed with matplotlib; its digits are all equally wide, so that numbers do not jitter from frame to frame.
    return Path(matplotlib.get_data_path()) / "fonts" / "ttf" / ("DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf")


@lru_cache(maxsize=64)
def _font(size: int, bold: bool) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(_font_file(bold)), size)


@lru_cache(maxsize=4096)
def _glyphs(string: str, size: int, bold: bool) -> tuple[Floats, int, int, float]:
    """Cover (h, w) in [0, 1], its left and top edge from the origin of the baseline in px, and the text's advance."""
    font = _font(size, bold)
    left, top, right, bottom = (int(edge) for edge in font.getbbox(string, anchor="ls"))
    image = Image.new("L", (max(right - left, 1), max(bottom - top, 1)))
    ImageDraw.Draw(image).text((-left, -top), string, 255, font, anchor="ls")
    return np.asarray(image, np.float32) / 255, left, top, float(font.getlength(string))


def _fixed(points: Floats) -> NDArray[np.int32]:
    """Fixed-point coordinates; OpenCV has pixel centres at whole numbers, this canvas half a pixel further on."""
    return np.round((points.clip(-FARTHEST_PX, FARTHEST_PX) - 0.5) * 2**FRACTION_BITS).astype(np.int32)


def _cover(start: float, stop: float, size: int) -> Floats:
    """(size,) share of each pixel that lies between two edges."""
    edges = np.arange(size, dtype=np.float32)
    return np.clip(np.minimum(edges + 1, stop) - np.maximum(edges, start), 0, 1)

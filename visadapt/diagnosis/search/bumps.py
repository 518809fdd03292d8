"""Bumps of load, and the pushes that they make up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from torch import Tensor

from visadapt.diagnosis.result import Push
from visadapt.diagnosis.search.causes import Z_90
from visadapt.diagnosis.search.unexplained_load import LoadTrack
from visadapt.systems import Variable

EDGE = 2.5  # Deviations of a bump from its middle at which it ends

EDGE_SHARE = 0.05  # Share of a push's peak at which it starts and ends

SHAPE_POINTS = 500  # Instants at which the shape of a push is evaluated

MODEL_ERROR = 0.1  # Deviation of an impulse, as a share of it, since the masses that it moves are not known exactly

MAX_APART = 2.0  # Distance of two bumps on a joint, over the sum of their widths, up to which they overlap


@dataclass(frozen=True)
class Bump:
    """A Gaussian bump of load on a joint."""

    part: int
    joint: int
    middle: float  # s
    width: float  # s, deviation
    height: float = 0.0  # over the root mean square of the joint's load
    deviation: float = math.inf  # of the height

    @property
    def score(self) -> float:
        return abs(self.height) / self.deviation

    @property
    def area(self) -> float:
        """Its impulse, s, for a height of 1."""
        return self.width * math.sqrt(2 * math.pi)

    def overlaps(self, other: Bump) -> bool:
        """Whether it is on the same joint at nearly the same time."""
        apart = abs(self.middle - other.middle)
        return (self.part, self.joint) == (other.part, other.joint) and apart < MAX_APART * (self.width + other.width)

    def on(self, track: LoadTrack) -> Tensor:
        """(N, J) the bump with unit height, smoothed as the track is."""
        out = torch.zeros_like(track.load)
        out[:, self.joint] = bumps_at(track, torch.tensor([self.middle], dtype=torch.float64), self.width)[0]
        return out


def bumps_at(track: LoadTrack, middles: Tensor, width: float) -> Tensor:
    """(M, N) bumps of unit height at M instants, smoothed as the track is."""
    whole = math.hypot(width, track.smoothing)
    return width / whole * torch.exp(-0.5 * ((track.time - middles[:, None]) / whole).square())


def overlapping(bumps: Sequence[Bump]) -> list[list[Bump]]:
    """The bumps in groups: in each, every bump overlaps another one, if there are several."""
    groups: list[list[Bump]] = []
    for one in sorted(bumps, key=lambda bump: bump.middle):
        joined = [group for group in groups if any(one.overlaps(other) for other in group)]
        groups = [group for group in groups if group not in joined] + [[*chain(*joined), one]]
    return groups


def summed(
    bumps: Sequence[Bump],
    impulse: float,
    deviation: float,
    tracks: Sequence[LoadTrack],
    loads: Sequence[Variable],
    tries: int,
) -> Push:
    """The push whose shape is the sum of overlapping bumps; if all have one sign, its peak is scaled with its impulse.

    Args:
        impulse: over the root mean square of the joint's load, s.
        deviation: of the impulse.
        tries: how many bumps were tried on the tracks.
    """
    track, load = tracks[bumps[0].part], loads[bumps[0].joint]
    unit = float(track.unit[bumps[0].joint])
    extents = [(one.middle - EDGE * one.width, one.middle + EDGE * one.width) for one in bumps]
    time = np.linspace(min(a for a, _ in extents), max(b for _, b in extents), SHAPE_POINTS)
    heights, middles, widths = np.array([(one.height, one.middle, one.width) for one in bumps]).T
    shape = unit * np.exp(-0.5 * ((time[:, None] - middles) / widths) ** 2) @ heights
    peak = float(shape[np.abs(shape).argmax()])
    during = time[shape / peak >= EDGE_SHARE]
    if np.ptp(np.sign(heights)) == 0 and impulse * peak > 0:
        peak *= impulse / sum(one.height * one.area for one in bumps)
    impulse, spread = unit * impulse, Z_90 * unit * math.hypot(deviation, MODEL_ERROR * impulse)
    p_value = min(1.0, tries * math.erfc(max(one.score for one in bumps) / math.sqrt(2)))
    start, end = max(0.0, float(during[0])), float(during[-1])
    ci90 = impulse - spread, impulse + spread
    return Push(track.episode, load.name, start, end, peak, load.unit, impulse, ci90, p_value)

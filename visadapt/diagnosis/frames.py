"""From a recording of frames to one of the positions that are seen in them; velocities are never differentiated."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from visadapt.effects import AngleDelay, Dropout, FrozenZone, MeasurementDelay, PositionDelay
from visadapt.estimation.poses import PoseFinder
from visadapt.progress import Progress
from visadapt.recordings import Episode, Recording
from visadapt.systems import System

POSE = ("x", "theta")  # What a frame shows of a cart-pole

UNSEEN = (Dropout, FrozenZone, MeasurementDelay, PositionDelay, AngleDelay)
"""Faults of sensors that a camera cannot have: it shows cart and pole in one frame. A late camera is a camera's."""

LEAN = 0.5  # rad, largest |theta| at which the pole is looked for

LEAST_EXPLAINED = 0.2
"""Share of the frames that the renderer must explain; below, it is taken to be of another scene."""

LONGEST_MISS = 10
"""Rows in a row without a usable frame at which an episode is split: upright, errors grow by e in about 5 rows."""

FEWEST_POSES = 5  # In a part of an episode; shorter ones are left out


class FramesError(ValueError):
    """Frames that cannot be diagnosed; the message is one line: which, and what would be right."""


def pose_finder(renderer: nn.Module, system: System) -> PoseFinder:
    """Looks for the cart within the range of the system's table."""
    across = system.states[system.index("x")]
    return PoseFinder(renderer, max(-across.low, across.high), LEAN)


def check_frames(recording: Recording, size: tuple[int, ...]) -> None:
    """Raises FramesError where frames are not of the renderer's (height, width), or none differs from another."""
    for episode, source in zip(recording.episodes, recording.sources, strict=True):
        assert episode.frame is not None
        if episode.frame.shape[1:] != size:
            shown = " x ".join(str(side) for side in episode.frame.shape[1:])
            drawn = " x ".join(str(side) for side in size)
            raise FramesError(f"{source}: frames of {shown} px (height x width); the renderer draws {drawn} px")
        if len(episode.frame) > 1 and (episode.frame == episode.frame[0]).all():
            raise FramesError(f"{source}: all {len(episode.frame)} frames are the same; a film that moves is right")


def positions(recording: Recording, finder: PoseFinder, progress: Progress | None = None) -> Recording:
    """The recording with x and theta as measured, in the place of frames.

    Rows whose frame the renderer does not explain are not `usable`; where there are many of them in a row, the episode
    is split. An exact copy of the frame before it has the same pose.

    Raises:
        FramesError: the renderer explains hardly any frame.
    """
    places, explained, misfits = [], [], []
    for number, episode in enumerate(recording.episodes):
        assert episode.frame is not None
        poses = finder(torch.from_numpy(np.ascontiguousarray(episode.frame)))
        new = np.ones(len(episode.frame), dtype=bool)
        new[1:] = (episode.frame[1:] != episode.frame[:-1]).any((1, 2))
        shown = np.flatnonzero(new)[np.cumsum(new) - 1]
        places.append(poses.place.nan_to_num().numpy()[shown])
        explained.append(poses.explained.numpy()[shown])
        misfits.append(poses.misfit.numpy())
        if progress is not None:
            progress(number + 1, len(recording.episodes), float(poses.misfit.square().mean()))
    total, seen = sum(map(len, explained)), sum(int(each.sum()) for each in explained)
    if seen < LEAST_EXPLAINED * total:
        raise FramesError(
            f"{recording.sources[0]}: the renderer explains {seen} of {total} frames (misfit "
            f"{255 * float(np.median(np.concatenate(misfits))):.1f} grey levels, at most {255 * finder.limit:.1f} is "
            "right): it is of another scene; `visadapt renderer` trains one on frames of this one"
        )
    episodes: list[Episode] = []
    usable: list[NDArray[np.bool_]] = []
    sources: list[str] = []
    for episode, place, used, source in zip(recording.episodes, places, explained, recording.sources, strict=True):
        for first, last in _stretches(used):
            rows = slice(first, last)
            episodes.append(
                replace(
                    episode,
                    **{key: getattr(episode, key)[rows] for key in ("time", "action")},
                    state=place[rows],
                    frame=None,
                )
            )
            usable.append(used[rows])
            sources.append(source)
    if not episodes:
        raise FramesError(f"{recording.sources[0]}: no {FEWEST_POSES} frames close to each other are explained")
    warnings = recording.warnings
    if seen < total:
        episode_number = next(k for k, used in enumerate(explained) if not used.all())
        row = int((~explained[episode_number]).argmax())
        warnings += (
            f"the renderer does not explain {total - seen} of {total} frames, row {row + 1} of "
            f"{recording.sources[episode_number]} the first; they were left out",
        )
    return replace(
        recording,
        episodes=tuple(episodes),
        measured=POSE,
        sources=tuple(sources),
        warnings=warnings,
        usable=tuple(usable),
    )


def _stretches(used: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First row and the row after the last of each part without long misses, from its first usable row to its last."""
    rows = np.flatnonzero(used)
    cuts = [0, *(np.flatnonzero(np.diff(rows) > LONGEST_MISS) + 1), len(rows)]
    return [(int(rows[a]), int(rows[b - 1]) + 1) for a, b in pairwise(cuts) if b - a >= FEWEST_POSES]

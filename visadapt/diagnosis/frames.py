"""From a recording of frames to the camera, and to the positions that are seen in them.

Velocities are never differentiated: they are unknowns of the fits, as of any recording without them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from visadapt.diagnosis import next_experiment
from visadapt.diagnosis.explanations import first_explanation
from visadapt.diagnosis.result import (
    AMBIGUOUS,
    IDENTIFIED,
    NO_GAP,
    UNEXPLAINED,
    Cause,
    Diagnosis,
    Gap,
    Pixels,
    without_slight,
)
from visadapt.diagnosis.search.camera import CameraFindings, find_camera
from visadapt.diagnosis.search.pixels import expected_size, judged, left_over
from visadapt.diagnosis.verdict import CLOSES_BUT, at_bound
from visadapt.diagnosis.words import MISFIT, estimate
from visadapt.effects import (
    EFFECTS,
    AngleDelay,
    CameraEffect,
    CameraShift,
    Dropout,
    FrameDrop,
    FrozenZone,
    MeasurementDelay,
    PositionDelay,
    Stage,
)
from visadapt.estimation.camera_fit import SeenBy, within_frame
from visadapt.estimation.poses import HIDDEN, PoseFinder, Poses, reach_of
from visadapt.estimation.profiles import profile_of
from visadapt.progress import Progress, Report, staged
from visadapt.recordings import Episode, Recording
from visadapt.systems import System

POSE = ("x", "theta")  # What a frame shows of a cart-pole

RESOLUTION = (0.002, 0.005)
"""m and rad, the smallest meaningful differences of poses (0.08 px, and 0.2 px at the pole's tip). The errors of a
renderer are alike in neighbouring frames, so the scatter of poses underestimates them. Poses by the shipped renderer
are off by 0.14 mm and 0.23 mrad (root mean square), with scales off by up to 0.1 %."""

UNSEEN = (Dropout, FrozenZone, MeasurementDelay, PositionDelay, AngleDelay)
"""Faults of separate sensors, which a camera cannot have: one frame shows cart and pole at the same instant."""

MIN_MOTION_ERROR, MIN_MOTION_ERROR_MOVED = 1.1, 2.0
"""Error of the source's predictions, over the noise of positions, from which motion shows a gap, and the same where the
camera was moved. Below, it may be the renderer's own error, which is no noise: half a milliradian of the angle, which
would pass for an offset, where a renderer was trained on 600 noisy frames; more where frames are interpolated."""

VAGUE = 3.0  # Standard deviation of a pose, over the median, above which a frame does not show it

LEAST_EXPLAINED = 0.2
"""Share of the frames that the renderer must explain; below, it is taken to be of another scene."""

LONGEST_MISS = 0.5
"""s without a usable frame after which an episode is split: upright, errors grow by a factor e in about 0.25 s."""

FEWEST_TO_ORDER = 20
"""Frames of an episode from which their order is judged: by chance, fewer may jump about."""
SURE_STEPS = 20.0
"""Steps from frame to frame, over RESOLUTION, that no error of the poses makes."""

FEWEST_POSES = 5  # Usable frames of a part of an episode; parts with fewer are left out


class FramesError(ValueError):
    """Frames that cannot be diagnosed; the message is one line: which, and what would be right."""


@dataclass(frozen=True)
class Film:
    """What a recording of frames was found to show."""

    positions: Recording  # x and theta as measured, in the place of frames; episodes may be parts of those filmed
    frames: list[NDArray[np.uint8]]  # (T, H, W) of each of these episodes
    camera: CameraFindings
    seen: nn.Module  # the renderer, seen by that camera
    pixels: Pixels
    left: Tensor  # (H, W) mean square of what neither the drawn frames nor noise explain


def watch(recording: Recording, system: System, renderer: nn.Module, report: Report | None = None) -> Film:
    """Find the camera that explains the frames, then the positions that are seen through it.

    Raises:
        FramesError: frames of another size or scene than the renderer's, or that never change.
    """
    # Frames and poses are in single precision on the CPU, whatever the renderer was trained in.
    renderer = copy.deepcopy(renderer).to("cpu", torch.float32)
    reach = reach_of(renderer, system)
    finder = PoseFinder(renderer, reach)
    check_frames(recording, finder.size)
    every = torch.cat([torch.from_numpy(np.ascontiguousarray(episode.frame)) for episode in recording.episodes])
    camera = find_camera(renderer, finder, every, staged(report, "camera"))
    effects, seen = camera.best.effects, renderer
    if effects:
        seen = SeenBy(renderer, effects)
        finder = PoseFinder(seen, reach)
    known = within_frame(effects, every[0].float()).to(torch.uint8)
    poses = found_in(recording, finder, known, staged(report, "poses"))
    left = left_over(seen, effects, every, torch.cat([each.pose for each in poses]))
    found, frames = positions(recording, poses)
    pixels = judged(left, expected_size(renderer, effects, camera.best.pose))
    return Film(found, frames, camera, seen, pixels, left)


def with_camera(motion: Diagnosis, film: Film, system: System) -> Diagnosis:
    """The diagnosis of motion seen through the camera that was found, with that camera among the causes.

    Where the pixels are unexplained, so is the recording; a warning states what the motion shows nevertheless.
    """
    camera = film.camera
    causes = camera.causes()
    moved = any(type(effect).motion is not CameraEffect.motion for effect in camera.best.effects)
    if motion.gap.before < (MIN_MOTION_ERROR_MOVED if moved else MIN_MOTION_ERROR):
        motion = _without_gap(motion, bool(causes), system)
    motion = replace(
        motion,
        where=replace(motion.where, pixels=film.pixels),
        warnings=(*motion.warnings, *_at_bounds(causes)),
    )
    best = first_explanation(causes)
    if film.pixels.unexplained:
        return _unexplained_in_pixels(motion, best)
    names = tuple(cause.effect for cause in best)
    along = next_experiment.ALONG if camera.fixed and {CameraShift.name}.issuperset(names) else ""
    if not names:
        open_too = along if motion.verdict == NO_GAP else ""
        return replace(motion, next_experiment=" ".join(text for text in (motion.next_experiment, open_too) if text))
    if motion.verdict == UNEXPLAINED:
        return replace(motion, warnings=(*motion.warnings, f"found in the pixels, and corrected: {_values(best)}"))
    doubtful = [[EFFECTS[name] for name in (one.effect, *one.indistinguishable_from)] for one in without_slight(best)]
    settled = next_experiment.separate(doubtful, system)
    gap, following, where = motion.gap, motion.next_experiment, motion.where
    if motion.verdict == NO_GAP or math.isnan(gap.closed):  # frames may have been lost nevertheless
        before, after = 255 * camera.unchanged.misfit, 255 * camera.best.misfit
        floor = min(255 * camera.noise, after)
        gap, following = Gap(MISFIT, before, after, floor, after, (before - after) / (before - floor)), ""
        stages = dict.fromkeys(where.stages, 0.0) | {Stage.CAMERA.value: 1.0}
        where = replace(where, stages=stages, regions=())  # of a gap that is none
    return replace(
        motion,
        verdict=AMBIGUOUS if settled or motion.verdict == AMBIGUOUS else IDENTIFIED,
        causes=(*causes, *motion.causes),
        ranking=tuple(replace(one, effects=(*names, *one.effects)) for one in motion.ranking),
        gap=gap,
        where=where,
        next_experiment=" ".join(text for text in (settled, along, following) if text),
    )


def _without_gap(motion: Diagnosis, seen_by_a_faulty_camera: bool, system: System) -> Diagnosis:
    """The diagnosis where the source predicts the positions as closely as they can be seen."""
    stages = dict.fromkeys(motion.where.stages, 0.0) | {Stage.CAMERA.value: float(seen_by_a_faulty_camera)}
    drops = tuple(cause for cause in motion.causes if cause.effect == FrameDrop.name)
    return replace(
        motion,
        verdict=IDENTIFIED if drops else NO_GAP,
        causes=drops,
        partial=(),
        gap=replace(motion.gap, closed=math.nan),
        warnings=tuple(
            warning
            for warning in motion.warnings
            if warning.partition(":")[0] not in (CLOSES_BUT, *(cause.effect for cause in motion.causes))
        ),
        where=replace(motion.where, stages=stages | ({Stage.CAMERA.value: 1.0} if drops else {}), regions=()),
        next_experiment="" if drops else next_experiment.more(profile_of(system)),
    )


def _unexplained_in_pixels(motion: Diagnosis, camera: Sequence[Cause]) -> Diagnosis:
    """The diagnosis where frames show what neither renderer nor camera explains: its causes become warnings."""
    found = [
        f"found in the {shown}, to be trusted less: {_values(causes)}"
        for shown, causes in (("pixels", camera), ("motion", motion.causes))
        if causes
    ]
    return replace(
        motion,
        verdict=UNEXPLAINED,
        causes=(),
        next_experiment=next_experiment.LOOK,
        warnings=(*motion.warnings, *found),
    )


def _at_bounds(camera: Sequence[Cause]) -> list[str]:
    """A warning for each strength of a camera's effects that is at an end of the range searched."""
    return [
        at_bound(cause.effect, name, one.value, one.unit)
        for cause in camera
        for name, one in cause.parameters.items()
        if any(math.isnan(side) for side in one.ci90)
    ]


def _values(causes: Sequence[Cause]) -> str:
    return "; ".join(
        f"{cause.effect} ({', '.join(f'{name} = {estimate(one)}' for name, one in cause.parameters.items())})"
        for cause in causes
    )


def check_frames(recording: Recording, size: tuple[int, ...]) -> None:
    """Raises FramesError where frames are not of the renderer's (height, width), or none differs from another."""
    for episode, origin in zip(recording.episodes, recording.sources, strict=True):
        assert episode.frame is not None
        if episode.frame.shape[1:] != size:
            shown = " x ".join(str(side) for side in episode.frame.shape[1:])
            drawn = " x ".join(str(side) for side in size)
            raise FramesError(f"{origin}: frames of {shown} px (height x width); the renderer draws {drawn} px")
        if len(episode.frame) > 1 and (episode.frame == episode.frame[0]).all():
            raise FramesError(f"{origin}: all {len(episode.frame)} frames are the same; a film that moves is right")


def found_in(recording: Recording, finder: PoseFinder, known: Tensor, progress: Progress | None = None) -> list[Poses]:
    """The poses in the frames of each episode; `known` (H, W) is 1 where the finder's renderer draws what is seen."""
    out = []
    for number, episode in enumerate(recording.episodes):
        out.append(finder(known * torch.from_numpy(np.ascontiguousarray(episode.frame))))
        if progress is not None:
            progress(number + 1, len(recording.episodes), float(out[-1].misfit.square().mean()))
    return out


def positions(recording: Recording, found: Sequence[Poses]) -> tuple[Recording, list[NDArray[np.uint8]]]:
    """The recording with x and theta as measured in the place of frames, and the frames (T, H, W) of its episodes.

    Rows whose frame the renderer does not explain, or that does not show the pose, are not `usable`; where there are
    many of them in a row, the episode is split. An exact copy of the frame before it has the same pose.

    Raises:
        FramesError: the renderer explains hardly any frame.
    """
    seen = [_seen(episode, poses) for episode, poses in zip(recording.episodes, found, strict=True)]
    clear = _clear(seen)
    _check_scene(recording, clear, found)
    _check_order(recording, seen, clear)
    parts = list(_parts(recording, seen, clear))
    if not parts:
        raise FramesError(f"{recording.sources[0]}: no {FEWEST_POSES} frames close to each other are explained")
    episodes, usable, origins, frames = zip(*parts, strict=True)
    shown_in = replace(
        recording,
        episodes=episodes,
        measured=POSE,
        sources=origins,
        warnings=(*recording.warnings, *_misses(recording, clear)),
        usable=usable,
        resolution=RESOLUTION,
    )
    return shown_in, list(frames)


@dataclass(frozen=True)
class _Seen:
    """The poses that the frames of an episode show, row by row."""

    pose: NDArray[np.floating]  # (T, 2)
    explained: NDArray[np.bool_]  # (T,) whether the renderer explains the frame
    deviation: NDArray[np.floating]  # (T, 2) standard deviation of the pose
    usual: NDArray[np.bool_]  # (T,) False in the copies of its first frame with which a late camera begins


def _seen(episode: Episode, poses: Poses) -> _Seen:
    """The poses found in the frames of an episode; an exact copy of the frame before it has the same."""
    assert episode.frame is not None
    new = np.ones(len(episode.frame), dtype=bool)
    new[1:] = (episode.frame[1:] != episode.frame[:-1]).any((1, 2))
    original = np.flatnonzero(new)[np.cumsum(new) - 1]  # the row that each row is a copy of
    # A late camera repeats its first frame, until it has seen another one: no frame was lost.
    usual = np.ones(len(new), dtype=bool)
    if len(new) > 1:
        usual[1 : 1 + int(new[1:].argmax())] = False
    deviation = poses.covariance.diagonal(dim1=1, dim2=2).sqrt().nan_to_num(torch.inf).numpy()
    pose, explained = poses.pose.nan_to_num().numpy(), poses.explained.numpy()
    return _Seen(pose[original], explained[original], deviation[original], usual)


def _clear(seen: Sequence[_Seen]) -> list[NDArray[np.bool_]]:
    """(T,) of each episode: whether a frame is explained and shows the pose; a pole that is out of it may have any
    angle."""
    most = np.maximum(RESOLUTION, VAGUE * np.median(np.concatenate([each.deviation for each in seen]), 0))
    return [each.explained & (each.deviation <= most).all(1) for each in seen]


def _check_scene(recording: Recording, clear: Sequence[NDArray[np.bool_]], found: Sequence[Poses]) -> None:
    """Raises FramesError where so few frames are clear that the renderer is of another scene."""
    total, count = sum(map(len, clear)), sum(int(each.sum()) for each in clear)
    if count < LEAST_EXPLAINED * total:
        contrast = float(np.median(np.concatenate([poses.contrast.numpy() for poses in found])))
        raise FramesError(
            f"{recording.sources[0]}: the renderer explains {count} of {total} frames (where it draws cart and pole, "
            f"they differ by {100 * contrast:.0f} % of the contrast, at most {100 * HIDDEN:.0f} % is right): it is of "
            "another scene; `visadapt renderer` trains one on frames of this one"
        )


def _check_order(recording: Recording, seen: Sequence[_Seen], clear: Sequence[NDArray[np.bool_]]) -> None:
    """Raises FramesError where cart and pole of an episode jump about from row to row, as no motion does."""
    for poses, used, origin in zip(seen, clear, recording.sources, strict=True):
        pose = poses.pose[used & poses.usual]
        if len(pose) < FEWEST_TO_ORDER:
            continue
        spread, steps = pose.std(0), np.sqrt(np.square(np.diff(pose, axis=0)).mean(0))
        if (steps > spread).all() and (steps > SURE_STEPS * np.array(RESOLUTION)).any():
            raise FramesError(
                f"{origin}: from frame to frame the cart jumps by {steps[0]:.2g} m and the pole by {steps[1]:.2g} rad, "
                "root mean square, as no motion does: frames in the order of their rows are right"
            )


def _parts(
    recording: Recording, seen: Sequence[_Seen], clear: Sequence[NDArray[np.bool_]]
) -> Iterator[tuple[Episode, NDArray[np.bool_], str, NDArray[np.uint8]]]:
    """The stretches of the episodes without long misses: poses, which of them are usable, origin, and frames."""
    for episode, poses, used, origin in zip(recording.episodes, seen, clear, recording.sources, strict=True):
        assert episode.frame is not None
        for first, last in _stretches(used, recording.period):
            rows = slice(first, last)
            time, action = episode.time[rows], episode.action[rows]
            part = replace(episode, time=time, action=action, state=poses.pose[rows], frame=None)
            yield part, np.repeat((used & poses.usual)[rows, None], len(POSE), 1), origin, episode.frame[rows]


def _misses(recording: Recording, clear: Sequence[NDArray[np.bool_]]) -> Iterator[str]:
    """A warning that counts the frames that are left out, if there are any."""
    missed = sum(int((~each).sum()) for each in clear)
    if missed:
        episode = next(k for k, each in enumerate(clear) if not each.all())
        row = int((~clear[episode]).argmax())
        yield (
            f"no pose was found in {missed} of {sum(map(len, clear))} frames, row {row + 1} of "
            f"{recording.sources[episode]} the first; they were left out"
        )


def _stretches(used: NDArray[np.bool_], period: float) -> list[tuple[int, int]]:
    """First row and the row after the last of each part without long misses, from its first usable row to its last."""
    rows = np.flatnonzero(used)
    cuts = [0, *(np.flatnonzero(np.diff(rows) * period > LONGEST_MISS * (1 + 1e-6)) + 1), len(rows)]
    return [(int(rows[a]), int(rows[b - 1]) + 1) for a, b in pairwise(cuts) if b - a >= FEWEST_POSES]

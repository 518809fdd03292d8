"""Which effects of the camera explain the pixels better, if any: judged on frames, before motion is looked at."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from visadapt.diagnosis.result import Cause, Estimate
from visadapt.diagnosis.search.causes import SLIGHT, Z_90, is_at_end
from visadapt.effects import EFFECTS, Blur, Brightness, CameraEffect, CameraShift, Gamma, Occlusion
from visadapt.effects.camera import moved
from visadapt.estimation.camera_fit import Camera, CameraFit, fit_camera, made, through
from visadapt.estimation.frame_residuals import MAX_FRAME_RATIO, evenly_spaced, white_noise
from visadapt.estimation.poses import PoseFinder
from visadapt.progress import Progress

SEARCHED: Camera = tuple(kind for kind in EFFECTS.values() if issubclass(kind, CameraEffect) and kind.in_one_frame)

FRAMES, FRAMES_AT_FIRST = 16, 6
"""Frames, spread over the recording, to which a camera is fitted, and for which its first values are looked for."""

MIN_CLOSED = 0.02
"""Share by which an effect must lower the root mean square misfit: the same as that of a gap."""

EQUAL_FIT = 0.005  # Share by which another effect's misfit may exceed the best one's and still count as an equal fit

MOST_EFFECTS = 3

ASTRAY = 2.0  # Mean square residual of a frame, over the median of frames, above which its pose may be wrong

COVERED = 10 / 255  # Mean misfit of a pixel above which something may cover it
COVERED_PIXELS = 6

ON_GRID = 15  # Values of each parameter of a moved camera that are tried first

REFINED = 6  # Points of that grid, the best ones, about which others are tried

PROBE = 5.0  # px by which the camera is moved along the track as a test

UNSEEN_SHARE, UNSEEN_SHARE_OF_CHANGE = 0.5, 0.2
"""Misfit, as a share of that of the frames, and of the change that the move makes, below both of which another position
of the cart makes up for the move. Of the change, a scene of cart and pole alone leaves 1 % (10 % of a move by half a
pixel), one with faint marks along the track a half."""


Fits = dict[type[CameraEffect], CameraFit]
"""Fits of a camera with or without one effect, by that effect."""


@dataclass(frozen=True)
class CameraFindings:
    """The camera that explains the frames best; the fits have the same frames."""

    unchanged: CameraFit  # without effects
    best: CameraFit
    alone: Fits  # each effect by itself
    without: Fits  # the best less one
    alike: dict[type[CameraEffect], Fits]  # the best with another effect in its place that explains the frames as well
    fixed: frozenset[str]  # parameters that these frames do not show

    @property
    def noise(self) -> float:
        """Standard deviation of the pixels' white noise, grey levels of [0, 1]."""
        return white_noise(self.best.residual)

    @property
    def lost(self) -> float:
        """Log likelihood of the pixels of one frame that would be lost without the effects."""
        return 0.5 * self.best.residual[0].numel() * math.log(self.unchanged.mean_square / self.best.mean_square)

    def causes(self) -> list[Cause]:
        """The effects of the best camera, each followed by those that explain the frames as well in its place, as the
        result states them; shares are those of the pixels' misfit."""
        if not self.best.camera:
            return []
        whole = self.unchanged.misfit - self.best.misfit
        closes = {kind: (self.unchanged.misfit - fit.misfit) / whole for kind, fit in self.alone.items()}
        reopens = {kind: (fit.misfit - self.best.misfit) / whole for kind, fit in self.without.items()}
        carrying = {kind for kind in self.best.camera if reopens[kind] >= SLIGHT}
        if not carrying:  # they stand in for each other
            carrying = {max(self.best.camera, key=lambda kind: closes[kind])}
        out: dict[str, Cause] = {}
        for kind in self.best.camera:
            group = {kind: self.best, **self.alike[kind]}
            for one, fit in group.items():
                name, slight = one.name, kind not in carrying
                alike = tuple(other.name for other in group if other is not one)
                if known := out.get(name):  # in the place of two effects of the best camera
                    alike = (*known.indistinguishable_from, *alike)
                    out[name] = replace(known, slight=known.slight and slight, indistinguishable_from=alike)
                    continue
                found = self._estimates(one, fit)
                out[name] = Cause(name, found, 1 / len(group), closes[one], reopens[kind], slight, alike)
        return list(out.values())

    def _estimates(self, kind: type[CameraEffect], fit: CameraFit) -> dict[str, Estimate]:
        """The parameters of one effect of a fit."""
        first = sum(len(other.table) for other in fit.camera[: fit.camera.index(kind)])
        table = kind.table_in(*fit.residual.shape[1:])
        half_widths = Z_90 * fit.covariance.diagonal()[first:].sqrt()
        out = {}
        for p, value, half_width in zip(table, fit.values[first:].tolist(), half_widths.tolist(), strict=False):
            low, high = max(p.low, value - half_width), min(p.high, value + half_width)
            if kind is not Occlusion:  # what a box covers beyond the frame does not matter
                low = math.nan if is_at_end(p, value, p.low) else low
                high = math.nan if is_at_end(p, value, p.high) else high
            out[p.name] = Estimate(value, p.unit, (p.low, p.high) if p.name in self.fixed else (low, high))
        return out


def find_camera(
    renderer: nn.Module, finder: PoseFinder, frames: Tensor, progress: Progress | None = None
) -> CameraFindings:
    """Search the camera of frames (T, H, W) uint8."""
    search = _CameraSearch(renderer, finder, frames[evenly_spaced(len(frames), FRAMES)], progress)
    grown, alone, alike = search.grow()
    needed, without = search.drop_idle(grown)
    best, without = search.sharpen(needed, without)
    alone = {kind: alone.get(kind, search.unchanged) for kind in SEARCHED}
    return CameraFindings(search.unchanged, best, alone, without, search.exchanged(best, alike), search.fixed)


class _CameraSearch:
    """Fits of cameras to the same frames, of which those that show something else are left out.

    Args:
        frames: (N, H, W) uint8.
        progress: called with (fits made, fits at least, mean square of the last one).
    """

    def __init__(
        self, renderer: nn.Module, finder: PoseFinder, frames: Tensor, progress: Progress | None = None
    ) -> None:
        self._renderer, self._finder, self._progress = renderer, finder, progress
        self._done = 0
        self._shown = frames.float() / 255  # (N, H, W)
        self.fixed: frozenset[str] = frozenset()
        self.unchanged = self._fit((), torch.zeros(0), finder(frames).pose)
        square = self.unchanged.residual.square().mean((1, 2))
        usual = square <= MAX_FRAME_RATIO * square.median()
        if not usual.all():
            self._shown = self._shown[usual]
            self.unchanged = self._fit((), torch.zeros(0), self.unchanged.pose[usual])
        if _track_is_featureless(finder, self.unchanged):
            self.fixed = frozenset({"dx"})

    def grow(self) -> tuple[CameraFit, Fits, dict[type[CameraEffect], Fits]]:
        """The camera that grows by the best effect while that lowers the misfit enough; each effect alone; and, for
        each effect of the camera, the fits of those that did as well when it was added."""
        best, alike = self.unchanged, {}
        alone: Fits = {}
        while len(best.camera) < MOST_EFFECTS:
            tried = self._with_each(best)
            if not best.camera:
                alone = tried
            chosen = min(tried, key=lambda kind: tried[kind].misfit)
            if tried[chosen].misfit > (1 - MIN_CLOSED) * best.misfit:
                break
            best = tried[chosen]
            alike[chosen] = {kind: fit for kind, fit in tried.items() if kind is not chosen and _as_good(fit, best)}
        return best, alone, alike

    def drop_idle(self, best: CameraFit) -> tuple[CameraFit, Fits]:
        """The camera without effects that the others do without, and this camera without each of its effects."""
        while True:
            without = self._without_each(best)
            idle = [kind for kind, fit in without.items() if best.misfit > (1 - MIN_CLOSED) * fit.misfit]
            if not idle:
                return best, without
            best = without[idle[0]]

    def sharpen(self, best: CameraFit, without: Fits) -> tuple[CameraFit, Fits]:
        """The camera fitted to smoothed frames, without the effects that may do nothing by that fit (unless all may),
        and this camera without each of its effects. `best` and `without` are what `drop_idle` returns.

        A turned picture is softer than the one drawn. In sharp frames, a shift by a fraction of a pixel would seem to
        explain this softness.
        """
        if not best.camera:
            return best, without
        best = self._fit(best.camera, best.values, best.pose, smooth=True)
        still = may_do_nothing(best, self.fixed)
        if 0 < len(still) < len(best.camera):
            best = self._fit(*_without(best, still), best.pose, smooth=True)
            without = self._without_each(best)
        return best, without

    def exchanged(self, best: CameraFit, alike: dict[type[CameraEffect], Fits]) -> dict[type[CameraEffect], Fits]:
        """For each effect of the camera, the camera with another one in its place that explains the frames as well.
        `alike` are the fits among which these are looked for, which have the other effect last."""
        out: dict[type[CameraEffect], Fits] = {}
        for kind in best.camera:
            rest, values = _without(best, {kind})
            out[kind] = {}
            for other, fit in alike[kind].items():
                if other in best.camera:
                    continue
                start = torch.cat((values, fit.values[-len(other.table) :]))
                again = self._fit((*rest, other), start, best.pose, smooth=True)
                if _as_good(again, best):
                    out[kind][other] = again
        return out

    def _with_each(self, best: CameraFit) -> Fits:
        """The camera with one effect more."""
        tried = {}
        for kind in SEARCHED:
            start = None if kind in best.camera else _start(kind, self._finder, self._shown, best, self.fixed)
            if start is not None:
                values, pose = start
                tried[kind] = self._fit_all((*best.camera, kind), torch.cat((best.values, values)), pose)
        return tried

    def _without_each(self, best: CameraFit) -> Fits:
        """The camera with one effect less."""
        rests = {kind: _without(best, {kind}) for kind in best.camera}
        return {kind: self._fit_all(*rest, best.pose) if rest[0] else self.unchanged for kind, rest in rests.items()}

    def _fit_all(self, camera: Camera, values: Tensor, pose: Tensor) -> CameraFit:
        """A fit to all frames: poses that are wrong are looked for again, through the camera that explains the
        others."""
        fit = self._fit(camera, values, pose)
        square = fit.residual.square().mean((1, 2))
        astray = square > ASTRAY * square.median()
        if astray.any():
            nearest = _nearest(self._finder, fit.effects, self._shown)[0].to(fit.pose)
            again = self._fit(camera, fit.values, torch.where(astray[:, None], nearest, fit.pose))
            fit = min(fit, again, key=lambda one: one.misfit)
        if self._progress is not None:
            self._done += 1
            least = 2 * len(SEARCHED)
            self._progress(min(self._done, least), least, fit.mean_square)
        return fit

    def _fit(self, camera: Camera, values: Tensor, pose: Tensor, smooth: bool = False) -> CameraFit:
        return fit_camera(self._renderer, self._shown, camera, values, pose, self.fixed, smooth)


def _as_good(fit: CameraFit, best: CameraFit) -> bool:
    return fit.misfit < (1 + EQUAL_FIT) * best.misfit


def _without(fit: CameraFit, left_out: Collection[type[CameraEffect]]) -> tuple[Camera, Tensor]:
    """The other effects of a fit, and their values."""
    keep = torch.cat([torch.full((len(kind.table),), kind not in left_out) for kind in fit.camera])
    return tuple(kind for kind in fit.camera if kind not in left_out), fit.values[keep]


def may_do_nothing(fit: CameraFit, fixed: frozenset[str]) -> set[type[CameraEffect]]:
    """The effects that may do nothing: those whose parameters all have their neutral value within the 90 % interval, or
    are fixed, and a covered box that may be empty."""
    parameters = [(kind, p) for kind in fit.camera for p in kind.table]
    away = {
        kind
        for (kind, p), value, variance in zip(parameters, fit.values, fit.covariance.diagonal(), strict=True)
        if p.name not in fixed and (p.neutral is None or (value - p.neutral).abs() > Z_90 * variance.sqrt())
    }
    names = [p.name for _, p in parameters]
    for start, end in (("left", "right"), ("top", "bottom")) if Occlusion in fit.camera else ():
        across = torch.zeros_like(fit.values)
        across[names.index(start)], across[names.index(end)] = -1.0, 1.0
        if across @ fit.values < Z_90 * (across @ fit.covariance @ across).sqrt():
            away -= {Occlusion}
    return set(fit.camera) - away


def _start(
    kind: type[CameraEffect], finder: PoseFinder, shown: Tensor, best: CameraFit, fixed: frozenset[str]
) -> tuple[Tensor, Tensor] | None:
    """First values (P,) of an effect and poses (N, 2), beside what the best camera has; None where there are none."""
    neutral = torch.tensor([math.nan if p.neutral is None else p.neutral for p in kind.table], dtype=torch.float64)
    if kind is Occlusion:
        box = _covered(best.residual, shown)
        return None if box is None else (box, _nearest(finder, [*best.effects, *made((kind,), box)], shown)[0])
    if kind is Blur:
        return neutral + 0.7, best.pose  # its slope at 0 is 0
    few = shown[evenly_spaced(len(shown), FRAMES_AT_FIRST)]
    if kind is Brightness:
        gains = torch.logspace(math.log2(0.35), math.log2(1.9), 11, base=2)
        points = torch.stack((gains, few.mean() - gains * finder.grey), 1)
    elif kind is Gamma:
        points = torch.logspace(math.log2(0.35), math.log2(2.9), 13, base=2)[:, None]
    else:
        axes = [
            torch.tensor([p.neutral]) if p.name in fixed else torch.linspace(p.low, p.high, ON_GRID) for p in kind.table
        ]
        points = torch.cartesian_prod(*axes).reshape(-1, len(kind.table))
    points = torch.cat((neutral[None], points.double()))

    def camera(point: Tensor) -> list[CameraEffect]:
        return [*best.effects, *made((kind,), point)]

    def misfits(points: Tensor) -> Tensor:
        return torch.stack([_nearest(finder, camera(point), few)[1].mean() for point in points])

    first = misfits(points)
    if not first.argmin():
        return neutral, best.pose
    chosen = points[first.argmin()]
    if kind is CameraShift:
        # Marks along a track return: the grid may be nearer to a wrong one of them than to the right one.
        spacing = torch.tensor([0.0 if p.name in fixed else (p.high - p.low) / (ON_GRID - 1) for p in kind.table])
        between = torch.cartesian_prod(*(torch.tensor([-1.0, 0.0, 1.0]) / 3 * each for each in spacing)).double()
        near = torch.cat([points[k] + between for k in first.argsort()[:REFINED].tolist()])
        chosen = near[misfits(near).argmin()]
    return chosen, _nearest(finder, camera(chosen), shown)[0]


def _nearest(finder: PoseFinder, camera: Sequence[CameraEffect], frames: Tensor) -> tuple[Tensor, Tensor]:
    """`PoseFinder.nearest` through a camera: frames are moved back, the greys of what is drawn are changed."""
    still = []
    whole = torch.eye(3).to(frames)
    for effect in sorted(camera, key=lambda one: one.order):
        motion = effect.motion(frames)
        if motion is not None:
            whole = motion @ whole
            continue
        # What is drawn for the grid has half the resolution.
        values = [getattr(effect, p.name).item() * (0.5 if p.unit == "px" else 1.0) for p in effect.table]
        still += made((type(effect),), torch.tensor(values))
    if not torch.equal(whole, torch.eye(3).to(frames)):
        frames = moved(frames, [whole.inverse()])
    return finder.nearest(frames, (lambda drawn: through(drawn, still)) if still else None)


def _covered(residual: Tensor, shown: Tensor) -> Tensor | None:
    """The values (5,) of an `Occlusion` of the largest patch whose mean misfit exceeds `COVERED`; None without one."""
    wrong = (residual.mean(0).abs() > COVERED).numpy().astype(np.uint8)
    count, _, patches, _ = cv2.connectedComponentsWithStats(wrong)
    if count < 2:
        return None
    left, top, width, height, area = patches[1 + int(patches[1:, cv2.CC_STAT_AREA].argmax())].tolist()
    if area < COVERED_PIXELS:
        return None
    grey = float(shown[:, top : top + height, left : left + width].median())
    return torch.tensor([left, top, left + width, top + height, grey], dtype=torch.float64)


def _track_is_featureless(finder: PoseFinder, unchanged: CameraFit) -> bool:
    """Whether a camera moved along the track shows the same as a cart at another place."""
    drawn = finder.renderer(*unchanged.pose.to(unchanged.residual).T)
    shown = through(drawn, [CameraShift(dx=PROBE, dy=0.0)])
    again = finder((255 * shown).round().clamp(0, 255).to(torch.uint8))
    # Another fault of the camera may raise the frames' misfit far above what any feature of the track makes.
    changed = float((shown - drawn).square().mean((1, 2)).sqrt().median())
    return float(again.misfit.median()) < min(UNSEEN_SHARE * unchanged.misfit, UNSEEN_SHARE_OF_CHANGE * changed)

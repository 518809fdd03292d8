"""Which effects of the camera explain the pixels better, if any: judged on frames, before motion is looked at."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from visadapt.diagnosis.result import Cause, Estimate
from visadapt.diagnosis.search.causes import Z_90
from visadapt.effects import Blur, Brightness, CameraEffect, CameraRotation, CameraShift, CameraZoom, Gamma, Occlusion
from visadapt.effects.camera import moved
from visadapt.estimation.camera_fit import Camera, CameraFit, fit_camera, made, through
from visadapt.estimation.poses import PoseFinder
from visadapt.estimation.structure import MAX_FRAME_RATIO, evenly_spaced, white_noise
from visadapt.progress import Progress

SEARCHED: Camera = (CameraRotation, CameraZoom, CameraShift, Occlusion, Blur, Gamma, Brightness)

FRAMES, FRAMES_AT_FIRST = 16, 6
"""Frames, spread over the recording, to which a camera is fitted, and for which its first values are looked for."""

MIN_CLOSED = 0.02
"""Share by which an effect must lower the root mean square misfit: the same as that of a gap."""

EQUAL_FIT = 0.005  # Share by which another effect's misfit may exceed the best one's and still count as an equal fit

MOST_EFFECTS = 3

ASTRAY = 2.0  # Mean square residual of a frame, over the median of frames, above which its pose may be wrong

COVERED = 10 / 255  # Mean misfit of a pixel above which something may cover it
COVERED_PIXELS = 6

PROBE, UNSEEN_SHARE = 5.0, 0.5
"""px by which the camera is moved along the track as a test, and misfit, as a share of that of the frames, below which
another position of the cart makes up for the move."""


@dataclass(frozen=True)
class CameraFindings:
    """The camera that explains the frames best; the fits have the same frames."""

    unchanged: CameraFit  # without effects
    best: CameraFit
    alone: dict[type[CameraEffect], CameraFit]  # each effect of the best by itself
    without: dict[type[CameraEffect], CameraFit]  # the best less one
    alike: dict[type[CameraEffect], tuple[str, ...]]  # effects that explain the frames as well in its place
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
        """The effects of the best camera as the result states them; shares are those of the pixels' misfit."""
        whole = self.unchanged.misfit - self.best.misfit
        deviations = iter(self.best.covariance.diagonal().sqrt().tolist())
        out = []
        for kind, effect in zip(self.best.camera, self.best.effects, strict=True):
            parameters = {}
            for p in kind.table:
                value, reach = getattr(effect, p.name).item(), Z_90 * next(deviations)
                low, high = max(p.low, value - reach), min(p.high, value + reach)
                parameters[p.name] = Estimate(value, p.unit, (p.low, p.high) if p.name in self.fixed else (low, high))
            closed = (self.unchanged.misfit - self.alone[kind].misfit) / whole
            reopened = (self.without[kind].misfit - self.best.misfit) / whole
            out.append(Cause(kind.name, parameters, 1.0, closed, reopened, indistinguishable_from=self.alike[kind]))
        return out


def find_camera(
    renderer: nn.Module, finder: PoseFinder, frames: Tensor, progress: Progress | None = None
) -> CameraFindings:
    """Search the camera of frames (T, H, W) uint8."""
    rows = evenly_spaced(len(frames), FRAMES)
    shown = frames[rows].float() / 255
    place = finder(frames[rows]).place
    unchanged = fit_camera(renderer, shown, (), torch.zeros(0), place, frozenset())
    own = unchanged.residual.square().mean((1, 2))
    usual = own <= MAX_FRAME_RATIO * own.median()
    if not usual.all():
        shown, place = shown[usual], unchanged.place[usual]
        unchanged = fit_camera(renderer, shown, (), torch.zeros(0), place, frozenset())
    fixed = frozenset({"dx"}) if _track_is_featureless(finder, unchanged) else frozenset()
    done, least = 0, 2 * len(SEARCHED)

    def fitted(camera: Camera, values: Tensor, at: Tensor) -> CameraFit:
        nonlocal done
        fit = fit_camera(renderer, shown, camera, values, at, fixed)
        own = fit.residual.square().mean((1, 2))
        astray = own > ASTRAY * own.median()
        if astray.any():  # looked for again through the camera that explains the others
            there = torch.where(astray[:, None], _nearest(finder, fit.effects, shown)[0].to(fit.place), fit.place)
            fit = min(fit, fit_camera(renderer, shown, camera, fit.values, there, fixed), key=lambda one: one.misfit)
        if progress is not None:
            done += 1
            progress(min(done, least), least, fit.mean_square)
        return fit

    best, alike = unchanged, {}
    alone: dict[type[CameraEffect], CameraFit] = {}
    while len(best.camera) < MOST_EFFECTS:
        tried: dict[type[CameraEffect], CameraFit] = {}
        for kind in SEARCHED:
            start = None if kind in best.camera else _start(kind, finder, shown, best, fixed)
            if start is not None:
                values, at = start
                tried[kind] = fitted((*best.camera, kind), torch.cat((best.values, values)), at)
        if not best.camera:
            alone = tried
        chosen = min(tried, key=lambda kind: tried[kind].misfit)
        if tried[chosen].misfit > (1 - MIN_CLOSED) * best.misfit:
            break
        best = tried[chosen]
        alike[chosen] = tuple(
            kind.name
            for kind, fit in tried.items()
            if kind is not chosen and fit.misfit < (1 + EQUAL_FIT) * best.misfit
        )

    def without_each(best: CameraFit) -> dict[type[CameraEffect], CameraFit]:
        rests = {kind: _without(best, {kind}) for kind in best.camera}
        return {kind: fitted(*rest, best.place) if rest[0] else unchanged for kind, rest in rests.items()}

    while True:
        without = without_each(best)
        idle = [kind for kind, fit in without.items() if best.misfit > (1 - MIN_CLOSED) * fit.misfit]
        if not idle:
            break
        best = without[idle[0]]
    if best.camera:
        best = fit_camera(renderer, shown, best.camera, best.values, best.place, fixed, smooth=True)
        # A turned picture is softer than the drawn one, which a shift by a part of a pixel would seem to explain.
        still = may_do_nothing(best, fixed)
        if 0 < len(still) < len(best.camera):
            best = fit_camera(renderer, shown, *_without(best, still), best.place, fixed, smooth=True)
            without = without_each(best)
    alone = {kind: alone.get(kind, unchanged) for kind in best.camera}
    return CameraFindings(unchanged, best, alone, without, alike, fixed)


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
    """First values (P,) of an effect and places (N, 2), beside what the best camera has; None where there are none."""
    neutral = torch.tensor([math.nan if p.neutral is None else p.neutral for p in kind.table], dtype=torch.float64)
    if kind is Occlusion:
        box = _covered(best.residual, shown)
        return None if box is None else (box, _nearest(finder, [*best.effects, *made((kind,), box)], shown)[0])
    if kind is Blur:
        return neutral + 0.7, best.place  # its slope at 0 is 0
    few = shown[evenly_spaced(len(shown), FRAMES_AT_FIRST)]
    if kind is Brightness:
        gains = torch.logspace(math.log2(0.35), math.log2(1.9), 11, base=2)
        points = torch.stack((gains, few.mean() - gains * finder.grey), 1)
    elif kind is Gamma:
        points = torch.logspace(math.log2(0.35), math.log2(2.9), 13, base=2)[:, None]
    else:
        axes = [torch.tensor([p.neutral]) if p.name in fixed else torch.linspace(p.low, p.high, 15) for p in kind.table]
        points = torch.cartesian_prod(*axes).reshape(-1, len(kind.table))
    points = torch.cat((neutral[None], points.double()))
    cameras = [[*best.effects, *made((kind,), point)] for point in points]
    first = int(torch.stack([_nearest(finder, camera, few)[1].mean() for camera in cameras]).argmin())
    return points[first], _nearest(finder, cameras[first], shown)[0] if first else best.place


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
    drawn = finder.renderer(*unchanged.place.to(unchanged.residual).T)
    shift = CameraShift(dx=PROBE, dy=0.0)
    again = finder((255 * through(drawn, [shift])).round().clamp(0, 255).to(torch.uint8))
    return float(again.misfit.median()) < UNSEEN_SHARE * unchanged.misfit

"""Which effects are worth fitting beside a fitted set: a linear answer for a grid of shapes and sizes of each.

Where a small effect is added, the innovations of the filter change by what its one-step disturbances become when
passed through the same gains. So a whole grid is scored by one pass of the filter's means, without refitting; and
where an effect has too many strengths for a grid, a few of Gauss-Newton's steps through the same pass find them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.effects import Effect
from visadapt.estimation.grids import grid, is_climbed, spans, starts
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.estimation.sensitivity import View
from visadapt.systems import System

STEPS = 6
SETTLED = 0.1
"""Steps at most, and log likelihood that is not worth another."""


@dataclass(frozen=True)
class Candidate:
    """A promising start for an effect beside a fitted set."""

    effect: type[Effect]
    values: tuple[float, ...]
    gain: float
    """log likelihood that it promises"""


def screen(
    system: System, effects: Sequence[type[Effect]], fits: FitState, rows: Segments, candidates: Sequence[type[Effect]]
) -> list[Candidate]:
    """The best lead of every candidate beside the one fitted set in `fits`, best first."""
    seen_at = spans(system, rows, fits.state[0])
    views: dict[int, View] = {}

    def view(every: int) -> View:
        if every not in views:
            views[every] = View.of(system, effects, fits, rows, every)
        return views[every]

    leads = []
    for effect in candidates:
        points, columns = starts(effect, seen_at) if is_climbed(effect) else grid(effect, seen_at)
        every = _every(profile_of(system).tried_rows, rows, len(points) * (1 + len(columns)))
        if is_climbed(effect):
            leads.append(_climbed(view(1), effect, _nearest(view(every), effect, points, columns)))
        else:
            own = view(every)
            lead = _best(effect, points, columns, own.seen.error, own.by_unit(effect, points, columns))
            leads.append(None if lead is None else replace(lead, gain=every * lead.gain))
    return sorted((lead for lead in leads if lead is not None), key=lambda lead: -lead.gain)


def _every(most: float, rows: Segments, points: int) -> int:
    """Of how many windows one is looked at where an effect is tried at so many points."""
    wanted = points * float(rows.inside.sum()) / most
    # Powers of two, so that effects share what is looked at.
    return 2 ** max(0, min(math.ceil(math.log2(max(1.0, wanted))), int(math.log2(max(1, rows.shape[0] // 8)))))


def _nearest(view: View, effect: type[Effect], points: Tensor, strengths: list[int]) -> Tensor:
    """Of points (G, P) the one from which one step of the strengths promises most, after that step; (P,)."""
    change, slopes = view.beside(effect, points, strengths)
    left, slopes = view.seen.error[:, None] + change, slopes.movedim(1, 0)
    normal = slopes.mT @ slopes
    ridge = 1e-3 * torch.diagonal(normal, dim1=1, dim2=2) + 1e-30
    pull = -(slopes.mT @ left.T[..., None])[..., 0]
    steps = torch.linalg.solve(normal + torch.diag_embed(ridge), pull[..., None])[..., 0]
    after = (left + torch.einsum("gnk,gk->ng", slopes, steps)).square().sum(0)
    best = int(after.argmin())
    out = points[best].clone()
    out[strengths] += steps[best]
    return _inside(effect, out)


def _climbed(view: View, effect: type[Effect], point: Tensor) -> Candidate | None:
    """The lead that Gauss-Newton's method with damping (Levenberg 1944) reaches from a point (P,)."""
    every = list(range(len(effect.table)))
    damping, best, found, left = 1e-2, -math.inf, point, view.seen.error
    slopes = torch.zeros(len(left), len(every), dtype=left.dtype)
    for _ in range(STEPS):
        change, there = view.beside(effect, point[None], every)
        now = view.seen.error + change[:, 0]
        gain = float(0.5 * (view.seen.error.square().sum() - now.square().sum()))
        if gain > best:
            damping, settled = damping / 5, gain - best < SETTLED
            best, found, slopes, left = gain, point, there[:, 0], now
            if settled:
                break
        else:
            damping *= 10
        normal = slopes.T @ slopes
        normal = normal + torch.diag(damping * normal.diagonal() + 1e-12 * normal.diagonal().max() + 1e-30)
        point = _inside(effect, found - torch.linalg.solve(normal, slopes.T @ left))
    return Candidate(effect, tuple(found.tolist()), best) if best > 0 else None


def _inside(effect: type[Effect], point: Tensor) -> Tensor:
    low, high = (torch.tensor([getattr(p, end) for p in effect.table], dtype=point.dtype) for end in ("low", "high"))
    return point.clamp(low, high)


def _best(effect: type[Effect], shapes: Tensor, linear: list[int], error: Tensor, answer: Tensor) -> Candidate | None:
    """The point of a grid that takes most from `error` (N,), given the answers (N, G, columns)."""
    if not linear:
        gains = 0.5 * (error.square().sum() - (error[:, None] + answer[..., 0]).square().sum(0))
        best = int(gains.argmax())
        return Candidate(effect, tuple(shapes[best].tolist()), float(gains[best])) if gains[best] > 0 else None
    answer = answer.movedim(1, 0)
    normal = answer.mT @ answer
    ridge = 1e-9 * torch.diagonal(normal, dim1=1, dim2=2).mean(1) + 1e-30
    normal = normal + ridge[:, None, None] * torch.eye(len(linear), dtype=error.dtype)
    pull = -(answer.mT @ error)
    sizes = torch.linalg.solve(normal, pull[..., None])[..., 0]
    for j, column in enumerate(linear):
        parameter = effect.table[column]
        neutral = float(parameter.neutral or 0.0)
        sizes[:, j] = sizes[:, j].clamp(parameter.low - neutral, parameter.high - neutral)
    gains = (pull * sizes).sum(-1) - 0.5 * torch.einsum("gi,gij,gj->g", sizes, normal, sizes)
    best = int(gains.argmax())
    if gains[best] <= 0:
        return None
    values = shapes[best].clone()
    values[linear] += sizes[best]
    return Candidate(effect, tuple(values.tolist()), float(gains[best]))

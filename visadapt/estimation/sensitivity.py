"""What an effect would change of a fitted set's innovations, at any of its parameters' values, without a new fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.effects import Effect
from visadapt.estimation.candidate import GLANCE, CandidateModel
from visadapt.estimation.innovations import Innovations
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.segments import Segments
from visadapt.systems import System

PROBE = 0.02
"""Share of its range at which an effect that is proportional to a parameter is probed."""

CLOSE = 1e-4
"""Share of its range by which a parameter is changed to see what it does beside a point."""


@dataclass(frozen=True)
class View:
    """A fitted set on some of the windows."""

    system: System
    effects: Sequence[type[Effect]]
    fits: FitState
    rows: Segments
    seen: Innovations

    @classmethod
    def of(cls, system: System, effects: Sequence[type[Effect]], fits: FitState, rows: Segments, every: int) -> View:
        """On every so manieth window."""
        if every > 1:
            windows = torch.arange(0, rows.shape[0], every)
            rows, fits = rows.of(windows), replace(fits, state=fits.state[:, windows])
        return cls(system, effects, fits, rows, Innovations(CandidateModel(system, effects, rows), fits))

    def by_unit(self, effect: type[Effect], points: Tensor, linear: Sequence[int]) -> Tensor:
        """The change (N, G, linear) with a unit of each parameter to which an effect is proportional.

        The others are those of the points (G, P); without linear parameters it is the change (N, G, 1) by the points.
        """
        columns = max(1, len(linear))
        tried = points[:, None].repeat(1, columns, 1)
        unit = torch.ones(columns, dtype=torch.float64)
        for j, column in enumerate(linear):
            parameter = effect.table[column]
            nothing = float(parameter.neutral or 0.0)
            end = parameter.high if parameter.high > nothing else parameter.low
            unit[j] = PROBE * (end - nothing)
            tried[:, j, column] = nothing + unit[j]
        return self._changes(effect, tried.flatten(0, 1)).unflatten(1, (len(points), columns)) / unit

    def beside(self, effect: type[Effect], points: Tensor, columns: Sequence[int]) -> tuple[Tensor, Tensor]:
        """The change (N, G) by points (G, P), and how it goes on (N, G, columns) with parameters from there."""
        steps = torch.zeros(len(points), len(columns), dtype=torch.float64)
        tried = points[:, None].repeat(1, 1 + len(columns), 1)
        for j, column in enumerate(columns):
            # Inwards, so that no parameter leaves its range.
            parameter = effect.table[column]
            step = CLOSE * (parameter.high - parameter.low)
            steps[:, j] = torch.where(points[:, column] + step > parameter.high, -step, step)
            tried[:, 1 + j, column] += steps[:, j]
        changes = self._changes(effect, tried.flatten(0, 1)).unflatten(1, (len(points), -1))
        return changes[..., 0], (changes[..., 1:] - changes[..., :1]) / steps

    def _changes(self, effect: type[Effect], tried: Tensor) -> Tensor:
        """How the innovations change (N, M) with the effect at parameters (M, P)."""
        rows, fits = self.rows, self.fits
        model = CandidateModel(self.system, [*self.effects, effect], rows, GLANCE)
        own = tried.shape[1]
        neutral = torch.tensor([0.0 if p.neutral is None else p.neutral for p in effect.table], dtype=torch.float64)
        tried = torch.cat((neutral[None], tried))
        theta = torch.cat((fits.theta[0].expand(len(tried), -1), tried), 1)
        # The base's own value of a shape has no meaning; only what switches the effect off counts.
        for j, parameter in enumerate(effect.table):
            if parameter.neutral is None:
                theta[0, j - own] = tried[1, j]
        windows, length = rows.shape
        count, n = len(theta), fits.state.shape[-1]
        commands = model.commands(theta)[:, :, :-1].flatten(0, 2)

        def spread(x: Tensor) -> Tensor:
            return x[None].expand(count, *x.shape).reshape(-1, *x.shape[2:])

        def each(used: int) -> Tensor:
            return theta[:, None].expand(-1, windows * used, -1).flatten(0, 1)

        state = fits.state[0]
        after = model.at(each(length - 1)).integrate(spread(rows.time[:, :-1]), spread(state[:, :-1]), commands)
        seen = model.measure(each(length), spread(state))
        after = after.reshape(count, windows, length - 1, n)
        seen = seen.reshape(count, windows, length, -1)
        drive = (after[1:] - after[:1]).movedim(0, -1) * rows.inside[:, 1:, None, None]
        reading = -(seen[1:] - seen[:1]).movedim(0, -1) * rows.used[..., None]
        return self.seen.answer(drive, reading)

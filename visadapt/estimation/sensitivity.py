"""The whitened innovations of a fitted set, and how they change when an effect is added, without a new fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from visadapt.effects import ActuationEffect, DynamicsEffect, Effect, SensingEffect
from visadapt.estimation.candidate import COARSEST, SHORT_PERIOD, CandidateModel, with_loads
from visadapt.estimation.colour import whitened, whitened_adjoint
from visadapt.estimation.grids import neutral_point
from visadapt.estimation.kalman import adjoints, forward, respond
from visadapt.estimation.likelihood import FitState, linear_problem, variances
from visadapt.estimation.linearise import integrate, linearise_step
from visadapt.estimation.segments import Segments
from visadapt.systems import System
from visadapt.world import WorldState


class Innovations:
    """The whitened innovations (N,), N = W T m, of a fitted set (C = 1), without their components along the derivatives
    by the set's own parameters: what refitting these would explain is not credited to a new effect."""

    def __init__(self, model: CandidateModel, fits: FitState) -> None:
        self.model = model
        problem = linear_problem([model], fits)
        self._filtered = forward(problem, *variances(model, fits, problem))
        white = self._white(self._filtered.white)
        self._known, _ = torch.linalg.qr(white[:, 1:])
        self.error: Tensor = self._projected(white[:, :1])[:, 0]
        """(N,)"""

    def response(self, drive: Tensor, reading: Tensor) -> Tensor:
        """Change (N, M) of the innovations with M inputs: `drive` (W, T - 1, n, M) and `reading` (W, T, m, M), which is
        0 where nothing was measured."""
        return self._projected(self._white(respond(self._filtered, drive, reading)))

    @cached_property
    def slope(self) -> Tensor:
        """(W, T - 1, n) derivative of half the squared innovations by a `drive`, which one pass backwards gives."""
        coloured = whitened_adjoint(self.error.view(*self._filtered.white.shape[:3], 1), self.model.rows.colour)
        return adjoints(self._filtered, coloured)[:, 1:, :, 0]

    def _white(self, innovations: Tensor) -> Tensor:
        """(N, M) of innovations (W, T, m, M)."""
        return whitened(innovations, self.model.rows.colour).flatten(0, 2)

    def _projected(self, white: Tensor) -> Tensor:
        return white - self._known @ (self._known.T @ white)


PROBE_SHARE = 0.02
"""A parameter to which the effect is proportional is probed at this share of the way from neutral to an end of its
range."""

DIFFERENCE_SHARE = 1e-4  # Share of its range by which a parameter is moved to take a finite difference


@dataclass(frozen=True)
class Sensitivity:
    """A fitted set on some of the windows, to which effects are added for a trial."""

    system: System
    effects: Sequence[type[Effect]]
    fits: FitState
    rows: Segments
    innovations: Innovations

    @classmethod
    def on_every(
        cls, stride: int, system: System, effects: Sequence[type[Effect]], fits: FitState, rows: Segments
    ) -> Sensitivity:
        """Use every `stride`-th window."""
        if stride > 1:
            windows = torch.arange(0, rows.shape[0], stride)
            rows, fits = rows.select(windows), fits.on(windows)
        return cls(system, effects, fits, rows, Innovations(CandidateModel(system, effects, rows), fits))

    def by_unit(self, effect: type[Effect], points: Tensor, linear: Sequence[int]) -> Tensor:
        """Change (N, G, L) of the N innovations per unit of each of the L `linear` parameters, at points (G, P).

        The effect must be proportional to these parameters.
        """
        columns = len(linear)
        tried = points[:, None].repeat(1, columns, 1)
        unit = torch.ones(columns, dtype=torch.float64)
        for j, column in enumerate(linear):
            parameter = effect.table[column]
            neutral = float(parameter.neutral or 0.0)
            end = parameter.high if parameter.high > neutral else parameter.low
            unit[j] = PROBE_SHARE * (end - neutral)
            tried[:, j, column] = neutral + unit[j]
        return self._changes(effect, tried.flatten(0, 1)).unflatten(1, (len(points), columns)) / unit

    def around(self, effect: type[Effect], points: Tensor, columns: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Change (N, G) of the innovations at points (G, P), and its derivatives (N, G, C) by C columns of these."""
        steps = torch.zeros(len(points), len(columns), dtype=torch.float64)
        tried = points[:, None].repeat(1, 1 + len(columns), 1)
        for j, column in enumerate(columns):
            # Directed inwards, so that no parameter leaves its range.
            parameter = effect.table[column]
            step = DIFFERENCE_SHARE * (parameter.high - parameter.low)
            steps[:, j] = torch.where(points[:, column] + step > parameter.high, -step, step)
            tried[:, 1 + j, column] += steps[:, j]
        changes = self._changes(effect, tried.flatten(0, 1)).unflatten(1, (len(points), -1))
        return changes[..., 0], (changes[..., 1:] - changes[..., :1]) / steps

    def pull(self, effect: type[Effect], point: Tensor, column: int) -> Tensor:
        """(W, T - 1) for each period, the first-order decrease of half the sum of squared innovations per unit of the
        strength in `column`, if the effect acts in that period alone.

        The effect must be proportional to the strength, which is neutral at the point (P,), and act on the motion.
        """
        tried, step = point.clone(), PROBE_SHARE * (effect.table[column].high - point[column])
        tried[column] += step
        drive = self._drive(effect, tried[None]) / step
        return -(self.innovations.slope[..., None] * drive).sum((2, 3))

    def _changes(self, effect: type[Effect], tried: Tensor) -> Tensor:
        """Change (N, M) of the innovations with the effect at parameters (M, P)."""
        drive = torch.zeros_like(self.fits.state[0, :, 1:, :, None])
        reading = torch.zeros_like(self.rows.measured[..., None])
        sensed = issubclass(effect, SensingEffect)
        if not sensed:
            drive = self._drive(effect, tried)
        if sensed or (issubclass(effect, ActuationEffect) and self.innovations.model.reads_commands):
            read = self._read(*self._with(effect, tried))
            reading = (read[:1] - read[1:]).movedim(0, -1).nan_to_num()
        return self.innovations.response(drive, reading)

    def _drive(self, effect: type[Effect], tried: Tensor) -> Tensor:
        """Change (W, T - 1, n, M) of the next state after each row, with the effect at M parameter vectors `tried`
        (M, P); the effect is not one on sensors.

        For periods up to SHORT_PERIOD the next state is taken as linear in loads and commands: nothing is integrated.
        """
        model, theta = self._with(effect, tried)
        linear = self.rows.period <= SHORT_PERIOD
        if linear and issubclass(effect, ActuationEffect):
            mean = self._acted(model, theta).mean(3)
            drive = torch.einsum("wtna,mwta->wtnm", self._slopes[0], mean[1:] - mean[:1])
        elif linear and issubclass(effect, DynamicsEffect) and effect.only_loads():
            load = self._loads(model, theta)
            drive = torch.einsum("wtnl,mwtl->wtnm", self._slopes[1], load[1:] - load[:1])
        else:
            after = self._after(model, theta)
            drive = (after[1:] - after[:1]).movedim(0, -1)
        return drive * self.rows.inside[:, 1:, None, None]

    def _with(self, effect: type[Effect], tried: Tensor) -> tuple[CandidateModel, Tensor]:
        """The set with the effect, and its parameters (1 + M, P): first without the effect, then at `tried` (M, P)."""
        model = CandidateModel(self.system, [*self.effects, effect], self.rows, COARSEST)
        count = tried.shape[1]
        tried = torch.cat((neutral_point(effect)[None], tried))
        theta = torch.cat((self.fits.theta[0].expand(len(tried), -1), tried), 1)
        # In row 0 strengths are at neutral; shapes do not matter there.
        for j, parameter in enumerate(effect.table):
            if parameter.neutral is None:
                theta[0, j - count] = tried[1, j]
        return model, theta

    def _read(self, model: CandidateModel, theta: Tensor) -> Tensor:
        """(M, W, T, m) the readings with parameters (M, P), each in the row in which the innovations have the reading;
        NaN where they have none."""
        fitted = self.innovations.model
        read = model.read_along(theta, self.fits.state[0], fitted.columns_later(self.fits.theta[0]))
        return torch.where(fitted.shown(self.fits.theta[0])[1] > 0, read, torch.nan)

    def _acted(self, model: CandidateModel, theta: Tensor) -> Tensor:
        """What acts of the commands after each row with parameters (M, P): (M, W, T - 1, substeps, n_action), or one
        for all where it does not depend on them."""
        return model.commands(theta if model.acting_parameters else theta[:1])[:, :, :-1]

    def _after(self, model: CandidateModel, theta: Tensor) -> Tensor:
        """(M, W, T - 1, n) the states a period after each row with parameters (M, P)."""
        (time, duration), count, (windows, length) = self.rows.clock, len(theta), self.rows.shape
        acted = self._acted(model, theta)
        after = integrate(
            model.at(theta[0]),
            model.by_row(theta, length - 1),
            time.repeat(count),
            self.fits.state[0, :, :-1].flatten(0, 1).repeat(count, 1),
            acted.expand(count, *acted.shape[1:]).flatten(0, 2),
            duration.repeat(count),
        )
        return after.unflatten(0, (count, windows, length - 1))

    @cached_property
    def _slopes(self) -> tuple[Tensor, Tensor]:
        """Change of the state after a period per unit of a command that acts over it, (W, T - 1, n, n_action), and per
        unit of a load, (W, T - 1, n, n_load)."""
        model, count = with_loads(self.innovations.model, COARSEST), len(self.system.loads)
        theta = torch.cat((self.fits.theta[0], torch.zeros(count, dtype=torch.float64)))
        acted = self._acted(model, theta[None])[0].flatten(0, 1)
        time, duration = self.rows.clock
        values, state = model.by_row(theta, self.rows.shape[1] - 1), self.fits.state[0, :, :-1].flatten(0, 1)
        step = linearise_step(
            model.at(theta), values, time, state, acted, by_state=False, by_command=True, duration=duration
        )
        shape = (self.rows.shape[0], -1)
        return step.by_command.unflatten(0, shape), step.by_parameter[..., -count:].unflatten(0, shape)

    def _loads(self, model: CandidateModel, theta: Tensor) -> Tensor:
        """(M, W, T - 1, n_load) the loads of all effects with parameters (M, P) in the middle of every period."""
        rows, state, count = self.rows, self.fits.state[0], len(theta)
        time = (rows.time[:, :-1] + rows.duration[:, :-1] / 2).flatten()
        middle = ((state[:, :-1] + state[:, 1:]) / 2).flatten(0, 1)
        world = model.at(model.by_row(theta, rows.shape[1] - 1))
        out = world.load(WorldState(time.repeat(count), middle.repeat(count, 1), ()))
        return out.unflatten(0, (count, rows.shape[0], -1))

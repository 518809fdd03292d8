"""A candidate model: the source with a set of effects, evaluated along a recording for any parameter values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from visadapt.effects import ActuationEffect, DynamicsEffect, Effect
from visadapt.effects.actuation import follows_late
from visadapt.effects.applied import applied_along
from visadapt.effects.late_sensors import LateSensors
from visadapt.estimation.episode_phases import phase_columns
from visadapt.estimation.late_readings import Delays, Following, Rows, following, interpolated, reading, rows_later
from visadapt.estimation.linearise import (
    Tangent,
    linearise_reading,
    linearise_step,
    load_effect,
    parameter_steps,
    search_range,
)
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.estimation.unmodelled_loads import leading_loads, noise_directions, response_without_friction
from visadapt.systems import System
from visadapt.systems.base import Parameters, parameters
from visadapt.systems.integrators import steps_within
from visadapt.systems.stiffness import longest_step
from visadapt.world import World, WorldState

COARSEST, COARSE, FINE = 0, 1, 2
"""Accuracy of integration, an index into `SystemProfile.longest_abrupt_steps`: for screening, for cross-validated and
quick fits, and for reported results."""

SHORT_PERIOD = 0.005
"""s: up to it the midpoint rule is accurate enough for what is not reported, and takes half as long, unless the system
is stiff. The screening uses it in every step that is short enough for the rows' motion."""

MIDPOINT_SHARE = 0.1  # Longest step of the midpoint rule, over that of Runge-Kutta

SCREENED_STEPS = 4.0
"""Length of the screening's steps, over the longest in which Runge-Kutta follows the rows' motion, where no command is
late: with an effect and without it, steps of the same length err alike."""

STEPS_WHERE_LATE = 4
"""Steps in a row, for what is reported, where motors follow their commands late: what acts changes within the row, and
over a step its mean acts. With one step, a lag of two rows came out 1.2 % short."""

STABLE = 2.0
"""Ratio, to the longest step that is accurate, of one in which Runge-Kutta is stable."""


@lru_cache(1024)
def stable_step(kind: type[System], values: Parameters, effect: type[Effect]) -> float:
    """s, the longest step in which a system stays stable wherever in its range an effect alters a parameter.

    In a longer one the fit of a machine near the end of the range would meet numbers that are not finite.
    """
    if not issubclass(effect, DynamicsEffect) or effect.alter is DynamicsEffect.alter:
        return math.inf
    system = kind(**dict(values))
    ends = ({p.name: p.low for p in effect.table}, {p.name: p.high for p in effect.table})
    return STABLE * min(longest_step(effect(**each).alter(system)) for each in ends)


class CandidateModel:
    """A source with a set of effects along W windows of T rows; their P parameters in all are arguments of its methods.

    `accuracy` is COARSEST, COARSE or FINE.
    """

    def __init__(self, system: System, effects: Sequence[type[Effect]], rows: Segments, accuracy: int = FINE) -> None:
        self.system = system
        self.profile = profile_of(system)
        self.effects = tuple(effects)
        self.rows = rows
        self.accuracy = accuracy
        smooth_step = self.profile.coarsest_step
        if accuracy > COARSEST:
            own = type(system), parameters(system)
            smooth_step = min([self.profile.longest_step, *(stable_step(*own, effect) for effect in effects)])  # type: ignore[arg-type]  # hashable, as types
        if accuracy == FINE:
            smooth_step = min(smooth_step, self.profile.fine_step)
        late = any(follows_late(effect, system) for effect in effects)
        steps = SCREENED_STEPS if accuracy == COARSEST and not late else 1.0
        step = smooth_step = min(smooth_step, steps * rows.longest_step)
        if any(effect.abrupt for effect in effects):
            step = min(smooth_step, self.profile.longest_abrupt_steps[accuracy])
        if accuracy == FINE and late:
            step = min(step, rows.period / STEPS_WHERE_LATE)
        longest = float(rows.held.max())
        if accuracy == COARSEST:
            taken, most = longest / steps_within(longest, step), rows.longest_step
        else:
            taken, most = rows.period, SHORT_PERIOD
        short = taken <= min(most, MIDPOINT_SHARE * longest_step(system))
        integrator = "midpoint" if accuracy < FINE and short else "rk4"
        placeholders = [effect(**{parameter.name: 0.0 for parameter in effect.table}) for effect in effects]
        self._world, self._smooth_world = (
            World(system, placeholders, rows.period, integrator, steps_within(longest, each))
            for each in (step, smooth_step)
        )
        self._only_commands_jump = not any(e.abrupt and not issubclass(e, ActuationEffect) for e in effects)
        self.table = self._world.table
        self.low, self.high = search_range(self.table)
        acting = [effect for effect in effects if issubclass(effect, ActuationEffect)]
        from_commands_alone = all(effect.acting_on is ActuationEffect.acting_on for effect in acting)
        owners = [effect for effect in effects for _ in effect.table]
        self.acting_parameters = [
            k for k, effect in enumerate(owners) if acting and (effect in acting or not from_commands_alone)
        ]
        """columns of the parameters that change what acts of the commands"""
        self.reads_commands = self._world.reads_commands
        self._late = [(k, effect.late) for k, effect in enumerate(owners) if issubclass(effect, LateSensors)]
        rubs = any(effect.rubs() for effect in effects)
        self.feels_unmodelled_loads = rows.colour is not None and rubs
        """whether what is missing from the model decides which way friction acts"""
        self._phase_columns = phase_columns(effects, len(rows.command))
        self.slopes: tuple[Tensor, Tensor] | None = None
        """transition (W, T - 1, n, n) and sensing (W, T, m, n) of an earlier linearisation, reused where given"""

    @cached_property
    def noise_directions(self) -> Tensor:
        """(W, T - 1, n, L) how process noise enters the states; see `unmodelled_loads`."""
        return noise_directions(self.rows, self.system)

    def on(self, windows: Tensor) -> CandidateModel:
        """The same set along these windows, by index."""
        return CandidateModel(self.system, self.effects, self.rows.select(windows), self.accuracy)

    def at(self, theta: Tensor) -> World:
        """The world with parameters (P,), or (N, P) for a batch of N states; `by_row` gives those of rows."""
        return self._world.with_values(theta)

    def by_row(self, theta: Tensor, length: int) -> Tensor:
        """Parameters (R W length, P), a row for each of `length` rows of every window, from R vectors (R, P); or from
        one, (P,), which stays as it is where all episodes have the same.

        They differ where an effect has a phase for each episode.
        """
        windows = len(self.rows.episode)
        if self._phase_columns is None:
            return theta if theta.dim() == 1 else theta.repeat_interleave(windows * length, 0)
        every = theta.reshape(-1, theta.shape[-1])[:, self._phase_columns[self.rows.episode]]
        return every.flatten(0, 1).repeat_interleave(length, 0)

    def by_theta(self, by_row: Tensor) -> Tensor:
        """Derivatives (W, T, n, P) by the parameters, from those by the parameters of each row."""
        if self._phase_columns is None:
            return by_row
        columns = self._phase_columns[self.rows.episode][:, None, None].expand_as(by_row)
        return torch.zeros_like(by_row).scatter_add(-1, columns, by_row)

    def commands(self, theta: Tensor) -> Tensor:
        """Commands after the actuation effects, (R, W, T, substeps, n_action), for R parameter vectors (R, P)."""
        return self.in_windows(self.acting(theta))

    def in_windows(self, acting: Tensor) -> Tensor:
        """What acts after the windows' rows, (R, W, T, substeps, n_action), of what acts in whole episodes."""
        return acting[:, self.rows.episode[:, None], self.rows.index]

    def acting(self, theta: Tensor) -> Tensor:
        """The same as `commands` of whole episodes, (R, E, L, substeps, n_action)."""
        rows = self.rows
        episodes = len(rows.command)
        given, held = rows.command.repeat(len(theta), 1, 1), rows.held.repeat(len(theta), 1)
        acting = self.at(theta.repeat_interleave(episodes, 0)).actuate(given, held)
        return acting.unflatten(0, (len(theta), episodes))

    def stepping(self, theta: Tensor, acting: Tensor) -> tuple[World, Tensor]:
        """The world with parameters (P,) and the commands that act (..., substeps, n_action), with no more substeps
        than are needed.

        If no effect is abrupt but those on commands, and these leave every command constant over its period, as a gain
        or a limit does, the substeps of smooth physics are enough.
        """
        if self._only_commands_jump and bool((acting == acting[..., :1, :]).all()):
            return self._smooth_world.with_values(theta), acting[..., : self._smooth_world.substeps, :]
        return self.at(theta), acting

    def started(self, theta: Tensor, state: Tensor) -> WorldState:
        """World states of all rows, flattened, for states (W, T, n): at the rows' times, with the memory of each effect
        as the recorded commands leave it; parameters (P,)."""
        rows, length = self.rows, state.shape[1]
        episode, index = rows.episode.repeat_interleave(length), rows.index[:, :length].flatten()
        first = rows.command.new_zeros(len(rows.command), state.shape[-1])
        memory = self.at(theta).memories(first, rows.command, held=rows.held)
        time = rows.time[:, :length].flatten()
        return WorldState(time, state.flatten(0, 1), tuple(m[episode, index] for m in memory))

    def measure(self, theta: Tensor, state: Tensor, chosen: Rows = slice(None)) -> Tensor:
        """Expected readings (W, T', m), without noise, of the states (W, T', n) in the `chosen` rows of every window,
        with parameters (P,). As in `shown`, a late sensor's reading is in the row whose state it shows, not in the row
        in which it is taken."""
        after = applied = None
        if self._late or self.reads_commands:
            acting = self.acting(theta[None])[0]
            after = self.following(theta, acting, chosen)
            applied = self.applied(acting, chosen) if self.reads_commands else None
        seen = reading(self._world, self.by_row(theta, state.shape[1]), state.flatten(0, 1), after, applied)
        return seen[:, list(self.rows.channels)].unflatten(0, state.shape[:2])

    def read_along(self, theta: Tensor, state: Tensor, later: Sequence[int]) -> Tensor:
        """Expected readings (R, W, T, m), without noise, of the motion through states (W, T, n), with R parameter
        vectors (R, P). Row t holds, for each state, the reading taken `later` (n,) rows after row t. Between rows the
        motion is interpolated, not integrated; NaN where a reading shows an instant outside the window."""
        late, none = self._late_by(theta), torch.zeros_like(theta[:, 0])
        delays = [late.get(column, none) for column in range(state.shape[2])]
        seen = interpolated(self.rows, state, later, delays, self.profile.position_of)
        instant = theta.clone()
        instant[:, [k for k, _ in self._late]] = 0.0
        applied = None
        if self.reads_commands:
            acting = self.acting(theta if self.acting_parameters else theta[:1])
            applied = torch.stack([self.applied(each) for each in acting]).expand(len(theta), -1, -1, -1).flatten(0, 1)
        read = self.at(self.by_row(instant, state.shape[1])).reading(seen.flatten(0, 2), applied)
        return read[:, list(self.rows.channels)].unflatten(0, seen.shape[:3])

    def shown(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """The recorded readings (W, T, m), each in the row whose state it shows with parameters (P,), and 1 where there
        is one that a fit may use."""
        later = self.rows_later(theta)
        return self.rows.later(self.rows.measured, later), self.rows.later(self.rows.used, later)

    def rows_later(self, theta: Tensor) -> list[int]:
        """By how many rows the readings (m,) come after the row whose state they show, with parameters (P,)."""
        return rows_later(self.rows, self._delays(theta), self.rows.channels)

    def columns_later(self, theta: Tensor) -> list[int]:
        """The same of all states (n,), measured or not."""
        return rows_later(self.rows, self._delays(theta), range(len(self.system.states)))

    def following(self, theta: Tensor, acting: Tensor, chosen: Rows = slice(None)) -> Following | None:
        """What late sensors with parameters (P,) show of what follows the `chosen` rows of every window, where `acting`
        (E, L, substeps, n_action) acts; None without such sensors."""
        if not self._late:
            return None
        return following(self.rows, self._delays(theta), acting, len(self.system.states), chosen)

    def applied(self, acting: Tensor, chosen: Rows = slice(None)) -> Tensor:
        """What acts (N, 2, n_action) as the `chosen` rows of every window, flattened, are read, and its rate of change;
        `acting` (E, L, substeps, n_action) acts in whole episodes."""
        every = applied_along(acting, self.rows.held)
        return every[self.rows.episode[:, None], self.rows.index[:, chosen]].flatten(0, 1)

    def _delays(self, theta: Tensor) -> Delays:
        """s by which states are read late."""
        return {column: float(delay) for column, delay in self._late_by(theta).items()}

    def _late_by(self, theta: Tensor) -> dict[int, Tensor]:
        """s (...,) by which states are read late, by their columns, with parameters (..., P)."""
        columns = sorted({column for _, late in self._late for column in late})
        return {c: torch.stack([theta[..., k] for k, late in self._late if c in late]).sum(0) for c in columns}


def with_loads(model: CandidateModel, accuracy: int) -> CandidateModel:
    """The set of a model with a constant load on each degree of freedom, whose values are its last parameters."""
    return CandidateModel(model.system, [*model.effects, load_effect(type(model.system))], model.rows, accuracy)


@dataclass(frozen=True)
class Linearised:
    """Step and measurement of a candidate model along states (W, T, n), with derivatives; K parameters in all."""

    next_state: Tensor  # (W, T - 1, n) the state one period after each row but the last
    transition: Tensor  # (W, T - 1, n, n) its derivative by the state
    by_parameter: Tensor  # (W, T - 1, n, K) its derivative by the parameters
    measured: Tensor  # (W, T, m)
    sensing: Tensor  # (W, T, m, n) its derivative by the state
    sensing_by_parameter: Tensor  # (W, T, m, K) its derivative by the parameters


def linearise(model: CandidateModel, theta: Tensor, state: Tensor) -> Linearised:
    """Linearise step and measurement with parameters (K,) along states (W, T, n)."""
    windows, length, _ = state.shape
    known = model.slopes
    shifted = torch.cat((theta[None], theta + torch.diag(parameter_steps(model.table, theta))))
    # What acts changes with the parameters of actuation effects alone: for the others it is computed once.
    variants = [0, *(1 + k for k in model.acting_parameters)]
    variant = [variants.index(k) if k in variants else 0 for k in range(len(shifted))]
    acting = model.acting(shifted[variants])
    step = _step(model, theta, state, model.in_windows(acting)[:, :, :-1].flatten(1, 2), variant)
    followings = [shown for each in acting if (shown := model.following(theta, each)) is not None]
    after = [followings[k] for k in variant] if followings else []
    applied = [model.applied(each) for each in acting] if model.reads_commands else []
    applied = [applied[k] for k in variant] if applied else []
    values = model.by_row(theta, length)
    read = linearise_reading(model.at(theta), values, state.flatten(0, 1), after, applied, by_state=known is None)
    channels = list(model.rows.channels)
    steps, rows = (windows, length - 1), (windows, length)
    out = Linearised(
        step.value.unflatten(0, steps),
        step.by_state.unflatten(0, steps),
        model.by_theta(step.by_parameter.unflatten(0, steps)),
        read.value[:, channels].unflatten(0, rows),
        read.by_state[:, channels].unflatten(0, rows),
        model.by_theta(read.by_parameter[:, channels].unflatten(0, rows)),
    )
    return out if known is None else replace(out, transition=known[0], sensing=known[1])


def _step(model: CandidateModel, theta: Tensor, state: Tensor, acting: Tensor, variant: Sequence[int]) -> Tangent:
    """The step with parameters (K,) from all states (W, T, n) but the last, with the derivative by the state unless
    `model.slopes` has it. Row `variant[k]` of `acting` (V, W (T - 1), substeps, n_action) acts with the base
    parameters (k = 0) or with the k-th moved."""
    if model.feels_unmodelled_loads:
        return _step_under_loads(model, theta, state, acting, variant)
    world, acting = model.stepping(theta, acting)
    values, time, duration = model.by_row(theta, state.shape[1] - 1), *model.rows.clock
    now, by_state = state[:, :-1].flatten(0, 1), model.slopes is None
    return linearise_step(world, values, time, now, acting[list(variant)], by_state, duration=duration)


def _step_under_loads(
    model: CandidateModel, theta: Tensor, state: Tensor, acting: Tensor, variant: Sequence[int]
) -> Tangent:
    """As `_step`, but under the unmodelled loads that lead from each state to the next, so that dry friction feels
    them; what these loads do without friction is then subtracted. See `unmodelled_loads`."""
    loaded, count = with_loads(model, model.accuracy), len(model.system.loads)
    time, duration = model.rows.clock
    now, following = state[:, :-1].flatten(0, 1), state[:, 1:].flatten(0, 1)
    values = loaded.by_row(torch.cat((theta, theta.new_zeros(count))), state.shape[1] - 1).expand(len(now), -1)
    world = loaded.at(values)
    response = response_without_friction(world, now, acting[0, :, 0], duration)
    loads = leading_loads(world, values, time, now, following, acting[0], duration, response)
    values = torch.cat((values[:, : len(theta)], loads), 1)
    given = acting[[*variant, *[0] * count]]
    out = linearise_step(world, values, time, now, given, model.slopes is None, duration=duration)
    without_friction = (response @ loads[..., None])[..., 0]
    return replace(out, value=out.value - without_friction, by_parameter=out.by_parameter[..., : len(theta)])

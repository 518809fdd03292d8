"""A grounded simulator, the source with a set of effects, as a function of its parameters; and its linearisation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor, nn

from visadapt.effects import ActuationEffect, DynamicsEffect, Effect, Role, SensingEffect
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System
from visadapt.systems.integrators import rk4

Made = TypeVar("Made", bound=Effect)

STATE_STEP = 1e-6
PARAMETER_STEP = 1e-6
"""Finite differences: of a state, and as a share of the range of a parameter. All is in float64."""

TURNS = 4 * math.pi
"""rad that a phase may go beyond its range on its way to where it fits."""

GLANCE, COARSE, FINE = 0, 1, 2
"""Which of the profile's numbers of substeps: to propose an effect, to try it, and for figures that are reported."""


class CandidateModel:
    """All simulators that a set of effects, with any parameters, makes of a source; K parameters in all."""

    def __init__(self, system: System, effects: Sequence[type[Effect]], rows: Segments, effort: int = FINE) -> None:
        self.system = system
        self.profile = profile_of(system)
        self.effects = tuple(effects)
        self.rows = rows
        abrupt = any(effect.abrupt for effect in effects)
        smooth = 1 if effort == GLANCE else math.ceil(rows.period / self.profile.smooth_step)
        self.substeps = max(smooth, self.profile.substeps[effort] if abrupt else 1)
        self.table = [parameter for effect in effects for parameter in effect.table]
        turns = torch.tensor([TURNS * (p.role is Role.PHASE) for p in self.table], dtype=torch.float64)
        self.low = torch.tensor([p.low for p in self.table], dtype=torch.float64) - turns
        self.high = torch.tensor([p.high for p in self.table], dtype=torch.float64) + turns
        chain = sorted((e for e in effects if issubclass(e, ActuationEffect)), key=lambda effect: effect.order)
        sensors = sorted((e for e in effects if issubclass(e, SensingEffect)), key=lambda effect: effect.order)
        self.slopes: tuple[Tensor, Tensor] | None = None
        """transition (W, T - 1, n, n) and sensing (W, T, m, n) of an earlier linearisation that are near enough"""
        self._order = [*chain, *(e for e in effects if issubclass(e, DynamicsEffect)), *sensors]

    def _made(self, kind: type[Made], theta: Tensor) -> list[Made]:
        """The effects of a kind in the order in which they act, with the parameters (P,), or (N, P) for N rows."""
        out = []
        for effect in self._order:
            if issubclass(effect, kind):
                first = sum(len(e.table) for e in self.effects[: self.effects.index(effect)])
                made = effect(**{parameter.name: 0.0 for parameter in effect.table})
                for column, parameter in enumerate(effect.table, first):
                    setattr(made, parameter.name, nn.Parameter(theta[..., column], requires_grad=False))
                out.append(made)
        return out

    def _chain(self, theta: Tensor) -> list[ActuationEffect]:
        """The actuation effects with what they take from the system that the others have altered."""
        system = self.system
        for effect in self._made(DynamicsEffect, theta):
            system = effect.alter(system)
        return [effect.acting_on(system) for effect in self._made(ActuationEffect, theta)]

    def commands(self, theta: Tensor) -> Tensor:
        """(R, W, T, S, n_action) what acts over the substeps, for parameters (R, P)."""
        rows = self.rows
        h = rows.period / self.substeps
        episodes, length, width = rows.command.shape
        commands = rows.command[None, :, :, None].expand(len(theta), -1, -1, self.substeps, -1)
        commands = commands.reshape(len(theta) * episodes, length * self.substeps, width)
        for effect in self._chain(theta.repeat_interleave(episodes, 0)):
            commands, _ = effect.apply_to(commands, effect.memory(commands, h), h)
        commands = commands.reshape(len(theta), episodes, length, self.substeps, width)
        index = rows.first[:, None] + torch.arange(rows.shape[1])
        return commands[:, rows.episode[:, None], index]

    def instead(self, theta: Tensor, actions: Tensor) -> Tensor:
        """(W, T, K, S, 1) what acts over a row's substeps if its command alone were another, for parameters (P,).

        `actions` (W, T, K) are the other commands of a system with one action; those before the row stay as they were
        given, since the chain remembers them.
        """
        rows = self.rows
        h = rows.period / self.substeps
        chain = self._chain(theta)
        out = actions[..., None, None].expand(-1, -1, -1, self.substeps, -1).clone()
        if not chain:
            return out
        given = rows.command[:, :, None].expand(-1, -1, self.substeps, -1)
        memory = [effect.memory(given[:, 0], h) for effect in chain]
        length, count = actions.shape[1:]
        for row in range(int(rows.first.max()) + length):
            place = row - rows.first
            windows = ((place >= 0) & (place < length)).nonzero()[:, 0]
            tried = out[windows, place[windows]].flatten(0, 1)
            past = rows.episode[windows].repeat_interleave(count)
            was = given[:, row]
            for k, effect in enumerate(chain):
                tried, _ = effect.apply_to(tried, memory[k][past], h)
                was, memory[k] = effect.apply_to(was, memory[k], h)
            out[windows, place[windows]] = tried.reshape(len(windows), count, self.substeps, 1)
        return out

    def step(self, theta: Tensor, commands: Tensor, time: Tensor, state: Tensor) -> Tensor:
        """One period on from states (N, n) under commands (N, S, n_action); parameters (P,), or a row's own (N, P)."""
        loads = self._made(DynamicsEffect, theta)
        system = self.system
        for effect in loads:
            system = effect.alter(system)
        h = self.rows.period / self.substeps
        nothing = torch.zeros(len(state), len(system.loads), dtype=state.dtype, device=state.device)

        def derivative(t: Tensor, s: Tensor, u: Tensor) -> Tensor:
            now, load = system, nothing
            for effect in loads:
                now = effect.vary(now, t, s)
            for effect in loads:
                load = load + effect.load(t, s, now)
            return now.derivative(s, u, load)

        for k in range(self.substeps):
            u = commands[:, k]
            state = rk4(lambda t, s, u=u: derivative(t, s, u), time, state, h)  # type: ignore[misc]
            time = time + h
        return state

    def sense(self, theta: Tensor, state: Tensor) -> Tensor:
        """What sensors, had every state one, would read (N, n) of states (N, n), with parameters as in `step`."""
        for effect in self._made(SensingEffect, theta):
            state, _ = effect.apply_to(state, effect.memory(state, self.rows.period), self.rows.period, None)
        return state

    def measure(self, theta: Tensor, state: Tensor) -> Tensor:
        """What is measured (N, m) of states (N, n), with parameters as in `step`."""
        return self.sense(theta, state)[:, list(self.rows.channels)]


@dataclass(frozen=True)
class Linearised:
    """A simulator along states (W, T, n)."""

    following: Tensor
    """(W, T - 1, n) the states a period on"""
    transition: Tensor
    """(W, T - 1, n, n)"""
    by_parameter: Tensor
    """(W, T - 1, n, K)"""
    measured: Tensor
    """(W, T, m)"""
    sensing: Tensor
    """(W, T, m, n)"""
    sensing_by_parameter: Tensor
    """(W, T, m, K)"""


def linearise(family: CandidateModel, theta: Tensor, state: Tensor) -> Linearised:
    """Finite differences of the simulator with parameters (K,) along states (W, T, n)."""
    windows, rows, n = state.shape
    count = len(theta)
    # Steps go inwards, so that no parameter leaves its range.
    step = PARAMETER_STEP * (family.high - family.low)
    step = torch.where(theta + step > family.high, -step, step)
    shifted = torch.cat((theta[None], theta + torch.diag(step)))
    commands = family.commands(shifted)
    # The replicas: the base, one per state, one per parameter.
    known = family.slopes
    varied = 0 if known is not None else n
    alike = [0] * (1 + varied) + list(range(1, 1 + count))
    moved = state[None].repeat(len(alike), 1, 1, 1)
    for i in range(varied):
        moved[1 + i, ..., i] += STATE_STEP

    def parameters(used: int) -> Tensor:
        return shifted[alike][:, None].expand(-1, windows * used, -1).flatten(0, 1)

    time = family.rows.time[:, :-1].expand(len(alike), -1, -1).flatten()
    after = family.step(
        parameters(rows - 1), commands[alike, :, :-1].flatten(0, 2), time, moved[:, :, :-1].flatten(0, 2)
    )
    after = after.reshape(len(alike), windows, rows - 1, n)
    seen = family.measure(parameters(rows), moved.flatten(0, 2)).reshape(len(alike), windows, rows, -1)

    def differences(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        change = (values[1:] - values[:1]).movedim(0, -1)
        return values[0], change[..., :varied] / STATE_STEP, change[..., varied:] / step

    out = Linearised(*differences(after), *differences(seen))
    return out if known is None else replace(out, transition=known[0], sensing=known[1])

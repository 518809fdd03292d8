"""The physics of a world: a system under the effects on its dynamics, integrated over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from visadapt.effects import DynamicsEffect
from visadapt.systems import System
from visadapt.systems.dry_friction import Limits, sliding, stopped
from visadapt.systems.integrators import INTEGRATORS, Duration
from visadapt.systems.stiffness import longest_step

EDGE_STEP = 0.025
"""Integration step that resolves the edges of abrupt loads (`PulseLaw`, `FrictionPatch`), in prediction times."""


class Dynamics:
    """A system and the effects on its dynamics; `integrator` is one of `INTEGRATORS`.

    Methods that take a system expect the one that `altered` gives, which is the same for many steps.
    """

    def __init__(self, system: System, effects: Sequence[DynamicsEffect], integrator: str) -> None:
        self.system = system
        self.integrator = integrator
        self._effects = effects
        # Most effects do one of these three alone, and a step asks for them at every derivative.
        self._varying = [e for e in effects if type(e).vary is not DynamicsEffect.vary]
        self._loading = [e for e in effects if type(e).load is not DynamicsEffect.load]
        self._rubbing = [e for e in effects if e.rubs()]
        self._friction_varies = any(e.dry_friction_by_velocity for e in self._rubbing)
        self._columns = torch.tensor([velocity for _, velocity in system.coordinates], dtype=torch.long)

    def altered(self, like: Tensor) -> System:
        """The system with the parameters that effects change permanently, with the device and dtype of `like`."""
        system = self.system
        for effect in self._effects:
            system = effect.alter(system)
        return system if system is self.system and system.is_constant else system.to(like)

    def longest_step(self) -> float:
        """s, the longest Runge-Kutta step for the system under its effects, as their parameters are now."""
        edges = any(effect.abrupt and not effect.rubs() for effect in self._effects)
        system = self.altered(torch.zeros(0, dtype=torch.float64))

        def load(state: Tensor) -> Tensor:
            time = torch.zeros_like(state[:, 0])
            return self._load(time, state, self.varied(system, time, state))

        follows = longest_step(system, load if self._loading or self._varying else None)
        return min(EDGE_STEP * system.prediction_time, follows) if edges else follows

    def varied(self, system: System, time: Tensor, state: Tensor) -> System:
        """The system with the parameters that effects give it at the time (B,) in the state (B, n_state)."""
        for effect in self._varying:
            system = effect.vary(system, time, state)
        return system

    def load(self, system: System, time: Tensor, state: Tensor, command: Tensor) -> Tensor:
        """Sum of the loads (B, n_load) of all effects at an instant in which `command` (B, n_action) acts, with dry
        friction of the coordinates that move."""
        here, velocity = self.varied(system, time, state), self._velocity(state)
        load, limits = self._load(time, state, here), self._dry_friction(time, state, command, here)
        return load if limits is None else load + sliding(limits, velocity, velocity.sign())

    def step(self, system: System, time: Tensor, state: Tensor, command: Tensor, h: Duration) -> Tensor:
        """The state (B, n_state) after `h` s, a number or (B,), in which `command` (B, n_action) acts."""
        here = self.varied(system, time, state)
        limits = self._dry_friction(time, state, command, here)
        friction = None if limits is None else self._sliding(limits, state)

        def derivative(t: Tensor, s: Tensor) -> Tensor:
            now = self.varied(system, t, s)
            load = self._load(t, s, now)
            return now.derivative(s, command, load if friction is None else load + friction(s))

        after = INTEGRATORS[self.integrator](derivative, time, state, h)
        return after if limits is None else stopped(here, state, after, command, limits, h)

    def _sliding(self, limits: Limits, start: Tensor) -> Callable[[Tensor], Tensor]:
        """Dry friction (B, n_load) in each state (B, n_state) of a step that starts in `start`."""
        direction = self._velocity(start).sign()
        if self._friction_varies:
            return lambda state: sliding(limits, self._velocity(state), direction)
        constant = sliding(limits, self._velocity(start), direction)
        return lambda state: constant

    def _velocity(self, state: Tensor) -> Tensor:
        """The velocities (B, n_load) of the coordinates."""
        return state.index_select(1, self._columns.to(state.device))

    def _load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        """Sum of the loads (B, n_load) without dry friction."""
        load = torch.zeros(len(state), len(system.loads), device=state.device, dtype=state.dtype)
        for effect in self._loading:
            load = load + effect.load(time, state, system)
        return load

    def _dry_friction(self, time: Tensor, state: Tensor, command: Tensor, system: System) -> Limits | None:
        """Limits of dry friction, added up over all effects, as a function of the velocities; all else is as in `state`
        (B, n_state). None if no effect has dry friction."""

        def limits(velocities: Tensor) -> Tensor:
            near = state.index_copy(1, self._columns.to(state.device), velocities)
            each = [effect.dry_friction(time, near, command, system) for effect in self._rubbing]
            return sum(each[1:], each[0])

        if self._friction_varies:
            return limits
        if not self._rubbing:
            return None
        same = limits(self._velocity(state))
        return lambda velocities: same

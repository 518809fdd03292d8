"""A world is a system and a list of effects: one batched, differentiable step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from visadapt.effects import ActuationEffect, DynamicsEffect, Effect, Residual, SensingEffect
from visadapt.history import History
from visadapt.systems import SYSTEMS, System
from visadapt.systems.integrators import INTEGRATORS

ACTUATION_CHAIN = (
    "actuator_delay",
    "actuator_backlash",
    "actuator_deadzone",
    "actuator_saturation",
    "actuator_gain",
    "actuator_bias",
    "actuator_lag",
)
"""The order in which actuation effects act; any other comes last."""

SENSING_CHAIN = (
    # First: it interpolates the true motion, and what follows then sees the state as it was.
    "measurement_delay",
    "frozen_zone",
    "sensor_scale",
    "angle_offset",
    "position_offset",
    "dropout",
)
"""The order in which sensing effects act; any other comes last."""


@dataclass(frozen=True)
class WorldState:
    """All that a step needs: the time since the episode began (B,), the state (B, n_state), what effects remember."""

    time: Tensor
    state: Tensor
    memory: tuple[Tensor, ...] = ()
    """what each actuation effect remembers, then what each sensing effect does, (B, any, any) each"""

    def detach(self) -> WorldState:
        """The same, cut off from the graph."""
        return WorldState(self.time.detach(), self.state.detach(), tuple(m.detach() for m in self.memory))

    def __getitem__(self, rows: Tensor) -> WorldState:
        return WorldState(self.time[rows], self.state[rows], tuple(m[rows] for m in self.memory))

    def joined(self, other: WorldState) -> WorldState:
        """The rows of this world state and, after them, those of another."""
        memory = tuple(torch.cat(pair) for pair in zip(self.memory, other.memory, strict=True))
        return WorldState(torch.cat((self.time, other.time)), torch.cat((self.state, other.state)), memory)

    def where(self, keep: Tensor, other: WorldState) -> WorldState:
        """This world state in the rows where `keep` (B,) holds, `other` in the rest."""
        return WorldState(
            torch.where(keep, self.time, other.time),
            torch.where(keep[:, None], self.state, other.state),
            tuple(torch.where(keep[:, None, None], a, b) for a, b in zip(self.memory, other.memory, strict=True)),
        )


class World(nn.Module):
    """A system with effects, integrated over one period of the controller at a time.

    Args:
        system: the source physics.
        effects: what separates the target from it.
        period: s between commands.
        integrator: one of `visadapt.systems.integrators.INTEGRATORS`.
        substeps: integration steps in a period.

    Raises:
        ValueError: an unknown integrator, or a period or number of substeps that is not positive.
        TypeError: an effect that does not act on this system.
    """

    def __init__(
        self,
        system: System,
        effects: Sequence[Effect] = (),
        period: float = 0.05,
        integrator: str = "rk4",
        substeps: int = 1,
    ) -> None:
        super().__init__()
        if integrator not in INTEGRATORS:
            raise ValueError(f"unknown integrator {integrator!r}; there are {', '.join(INTEGRATORS)}")
        if not period > 0 or substeps < 1:
            raise ValueError(f"period and substeps must be positive, got {period!r} s and {substeps!r}")
        for effect in effects:
            # A system of one's own may be near enough to the one that an effect was written for.
            if type(system) in SYSTEMS.values() and not isinstance(system, effect.systems):
                kinds = " or a ".join(getattr(kind, "name", kind.__name__) for kind in effect.systems)
                raise TypeError(f"{effect.name} acts on a {kinds}, not on a {system.name}")
        self.system = system
        self.period = period
        self.integrator = integrator
        self.substeps = substeps
        self.effects = nn.ModuleList(effects)
        self._actuation = sorted((e for e in effects if isinstance(e, ActuationEffect)), key=place_in_chain)
        self._sensing = sorted((e for e in effects if isinstance(e, SensingEffect)), key=place_in_chain)
        self._dynamics = [effect for effect in effects if isinstance(effect, DynamicsEffect)]
        self._residuals = [effect for effect in effects if isinstance(effect, Residual)]

    @property
    def has_residual(self) -> bool:
        """Whether a step needs the history of observations and actions."""
        return bool(self._residuals)

    def start(self, state: Tensor) -> WorldState:
        """The world at the start of an episode in the state (B, n_state)."""
        commands = torch.zeros(
            len(state), self.substeps, len(self.system.actions), device=state.device, dtype=state.dtype
        )
        acting = tuple(effect.memory(commands, self.period / self.substeps) for effect in self._actuation)
        sensing = tuple(effect.memory(state, self.period) for effect in self._sensing)
        return WorldState(torch.zeros_like(state[:, 0]), state, acting + sensing)

    def step(self, at: WorldState, action: Tensor, history: History | None = None) -> WorldState:
        """One period on, with `action` (B, n_action) in [-1, 1] held over it.

        `history` is what the observer has seen up to now; a world with a residual needs it, and no other reads it.
        """
        h = self.period / self.substeps
        commands = action.clamp(-1, 1)[:, None].expand(-1, self.substeps, -1)
        system = self.altered(at.state)
        memory = []
        for effect, remembered in zip(self._actuation, at.memory, strict=False):
            commands, remembered = effect.acting_on(system).apply_to(commands, remembered, h)
            memory.append(remembered)
        integrate = INTEGRATORS[self.integrator]
        time, state = at.time, at.state
        for k in range(self.substeps):
            command = commands[:, k]

            def derivative(t: Tensor, s: Tensor, u: Tensor = command) -> Tensor:
                now = self._varied(system, t, s)
                return now.derivative(s, u, self._load(t, s, now))

            state = integrate(derivative, time, state, h)
            time = time + h
        for residual in self._residuals:
            if history is None:
                raise ValueError("a world with a residual needs the history of observations and actions")
            state = state + residual.delta(history.acting(action)).to(state)
        return WorldState(time, state, (*memory, *at.memory[len(memory) :]))

    def measure(self, at: WorldState, generator: torch.Generator | None = None) -> tuple[Tensor, WorldState]:
        """What sensors read (B, n_state) of the row `at`, and the world with that row read.

        A row is read once: after `start`, then after each `step`. Without sensing effects the reading is the state.
        `generator` is needed by random effects alone.
        """
        first = len(self._actuation)
        measured = at.state
        memory = list(at.memory)
        for k, effect in enumerate(self._sensing, first):
            measured, memory[k] = effect.apply_to(measured, memory[k], self.period, generator)
        return measured, replace(at, memory=tuple(memory))

    def load(self, at: WorldState) -> Tensor:
        """Sum of the loads (B, n_load) of all effects at an instant."""
        return self._load(at.time, at.state, self.system_at(at))

    def system_at(self, at: WorldState) -> System:
        """The system with the parameters that effects give it at an instant."""
        return self._varied(self.altered(at.state), at.time, at.state)

    def altered(self, like: Tensor) -> System:
        """The system with the parameters that effects give it for good, with the device and dtype of `like`."""
        system = self.system
        for effect in self._dynamics:
            system = effect.alter(system)
        return system if system is self.system else system.to(like)

    def _varied(self, system: System, time: Tensor, state: Tensor) -> System:
        for effect in self._dynamics:
            system = effect.vary(system, time, state)
        return system

    def _load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        load = torch.zeros(len(state), len(system.loads), device=state.device, dtype=state.dtype)
        for effect in self._dynamics:
            load = load + effect.load(time, state, system)
        return load


def place_in_chain(effect: Effect | type[Effect]) -> int:
    """Where an actuation or sensing effect acts among the others of its stage: the sorting key."""
    chain = ACTUATION_CHAIN + SENSING_CHAIN
    return chain.index(effect.name) if effect.name in chain else len(chain)

"""A world is a system and a list of effects: one batched, differentiable step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from visadapt.effects import ActuationEffect, DynamicsEffect, Effect, Residual
from visadapt.history import History
from visadapt.integrators import INTEGRATORS
from visadapt.systems import System

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


@dataclass(frozen=True)
class WorldState:
    """All that a step needs: the time since the episode began (B,), the state (B, n_state), what effects remember."""

    time: Tensor
    state: Tensor
    memory: tuple[Tensor, ...] = ()

    def detach(self) -> WorldState:
        """The same, cut off from the graph."""
        return WorldState(self.time.detach(), self.state.detach(), tuple(m.detach() for m in self.memory))

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
        integrator: one of `visadapt.integrators.INTEGRATORS`.
        substeps: integration steps in a period.

    Raises:
        ValueError: an unknown integrator, or a period or number of substeps that is not positive.
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
        self.system = system
        self.period = period
        self.integrator = integrator
        self.substeps = substeps
        self.effects = nn.ModuleList(effects)
        self._actuation = sorted(
            (effect for effect in effects if isinstance(effect, ActuationEffect)), key=_place_in_chain
        )
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
        memory = tuple(effect.memory(commands, self.period / self.substeps) for effect in self._actuation)
        return WorldState(torch.zeros_like(state[:, 0]), state, memory)

    def step(self, at: WorldState, action: Tensor, history: History | None = None) -> WorldState:
        """One period on, with `action` (B, n_action) in [-1, 1] held over it.

        `history` is what the observer has seen up to now; a world with a residual needs it, and no other reads it.
        """
        h = self.period / self.substeps
        commands = action.clamp(-1, 1)[:, None].expand(-1, self.substeps, -1)
        memory = []
        for effect, remembered in zip(self._actuation, at.memory, strict=True):
            commands, remembered = effect.apply_to(commands, remembered, h)
            memory.append(remembered)
        integrate = INTEGRATORS[self.integrator]
        time, state = at.time, at.state
        for k in range(self.substeps):
            command = commands[:, k]
            state = integrate(lambda t, s, u=command: self._derivative(t, s, u), time, state, h)  # type: ignore[misc]
            time = time + h
        for residual in self._residuals:
            if history is None:
                raise ValueError("a world with a residual needs the history of observations and actions")
            state = state + residual.delta(history.acting(action)).to(state)
        return WorldState(time, state, tuple(memory))

    def _derivative(self, time: Tensor, state: Tensor, command: Tensor) -> Tensor:
        load = torch.zeros(len(state), len(self.system.loads), device=state.device, dtype=state.dtype)
        for effect in self._dynamics:
            load = load + effect.load(time, state)
        return self.system.derivative(state, command, load)


def _place_in_chain(effect: Effect) -> int:
    return ACTUATION_CHAIN.index(effect.name) if effect.name in ACTUATION_CHAIN else len(ACTUATION_CHAIN)

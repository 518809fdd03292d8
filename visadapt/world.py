"""A world is a system and a list of effects: one batched, differentiable step."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import torch
from torch import Tensor, nn

from visadapt.batch import Batch
from visadapt.dynamics import Dynamics
from visadapt.effects import ActuationEffect, CameraEffect, DynamicsEffect, Effect, Parameter, Residual, SensingEffect
from visadapt.effects.applied import LastApplied
from visadapt.effects.base import check_acts_on
from visadapt.effects.camera import seen_by
from visadapt.history import History
from visadapt.systems import System
from visadapt.systems.integrators import INTEGRATORS, Duration, steps_within


@dataclass(frozen=True)
class WorldState(Batch):
    """All that a step needs: the time since the episode began (B,), the state (B, n_state), what effects remember."""

    time: Tensor
    state: Tensor
    memory: tuple[Tensor, ...] = ()
    """what each actuation effect remembers, then each sensing effect, then each camera effect, (B, any, any) each"""


class World(nn.Module):
    """A system with effects, integrated over one period of the controller at a time.

    Args:
        system: the source physics.
        effects: what separates the target from it.
        period: s between commands.
        integrator: one of `visadapt.systems.integrators.INTEGRATORS`.
        substeps: integration steps in a period; None: as few as resolve abrupt loads (a gust, a patch of friction) and
            follow the system under its effects, as their parameters are when the world is made
            (`systems/stiffness.py`).

    Raises:
        ValueError: an unknown integrator, or a period or number of substeps that is not positive.
        TypeError: an effect that does not act on this system.

    >>> import torch, visadapt as va
    >>> world = va.World(va.CartPole(), [va.effects.ConstantForce(force=1.1)])
    >>> at = world.step(world.start(torch.zeros(1, 4)), torch.zeros(1, 1))
    >>> float(at.time), bool(at.state[0, 1] > 0)  # pushed towards +x
    (0.05000000074505806, True)
    """

    def __init__(
        self,
        system: System,
        effects: Iterable[Effect] = (),
        period: float = 0.05,
        integrator: str = "rk4",
        substeps: int | None = None,
    ) -> None:
        super().__init__()
        if integrator not in INTEGRATORS:
            raise ValueError(f"unknown integrator {integrator!r}; there are {', '.join(INTEGRATORS)}")
        if not period > 0 or (substeps is not None and substeps < 1):
            raise ValueError(f"period and substeps must be positive, got {period!r} s and {substeps!r}")
        effects = list(effects)  # an iterator can be read only once
        for effect in effects:
            check_acts_on(system, effect)
        self.system = system
        self.period = period
        self.integrator = integrator
        if substeps is None:
            substeps = _steps(system, effects, period)
        self.substeps = substeps
        self.effects = nn.ModuleList(effects)
        self._arrange()

    @property
    def has_residual(self) -> bool:
        """Whether a step needs the history of observations and actions."""
        return bool(self._residuals)

    @property
    def reads_commands(self) -> bool:
        """Whether what sensors read depends on what acts of the commands."""
        return any(type(effect).under is not SensingEffect.under for effect in self._sensing)

    @property
    def table(self) -> list[Parameter]:
        """The parameters of all effects, in the order of the effects."""
        return [parameter for effect in self._named for parameter in effect.table]

    @property
    def values(self) -> Tensor:
        """(P,) present values of the parameters in `table`, which must be scalars."""
        values = [getattr(effect, parameter.name) for effect in self._named for parameter in effect.table]
        return torch.stack(values) if values else torch.zeros(0)

    def with_effects(self, effects: Sequence[Effect]) -> World:
        """The same system and clock with these effects instead, in steps that are at least as fine."""
        steps = max(self.substeps, _steps(self.system, effects, self.period))
        return World(self.system, effects, self.period, self.integrator, steps)

    def with_values(self, values: Tensor) -> World:
        """The same world with other values of the parameters of its effects.

        Args:
            values: (P,) in the order of `table`, or (B, P) with a row for each row of the batch that is stepped.
                A gradient flows back to them.
        """
        effects, first = [], 0
        for effect in self._named:
            effects.append(effect.with_values(values[..., first : first + len(effect.table)]))
            first += len(effect.table)
        made = object.__new__(type(self))  # a diagnosis makes thousands: without what a module registers
        made.__dict__ = {**self.__dict__, "effects": effects, "_modules": {}}
        made._arrange()
        return made

    def start(
        self, state: Tensor, time: Tensor | None = None, commands: Tensor | None = None, states: Tensor | None = None
    ) -> WorldState:
        """The world in the state (B, n_state), at the start of an episode or within one, before the sensors read it.

        Args:
            time: (B,) s since the episode began; 0 without it.
            commands: (B, T, n_action) that were given since the episode began, at least to `time`: from these the
                actuation effects fill their memory. What comes after `time` is not used.
            states: (B, T, n_state) that the episode went through: from these the sensing effects fill theirs. Without
                them these remember `state` alone.
        """
        clock = torch.zeros_like(state[:, 0]) if time is None else time
        if commands is None:
            if states is not None:
                raise ValueError(
                    "start with states needs the commands between them: World.start(..., commands, states)"
                )
            return WorldState(clock, state, self._at_rest(state))
        rows = torch.arange(len(state), device=state.device), (clock / self.period).round().long()
        return WorldState(clock, state, tuple(memory[rows] for memory in self.memories(state, commands, states)))

    def memories(
        self, state: Tensor, commands: Tensor, states: Tensor | None = None, held: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """What effects remember at every row of B episodes, before that row is read: (B, T + 1, any, any) each.

        Args: as those of `start`, where `commands` and `states` begin where the episodes do; `held` (B, T) s is how
        long each command was, where the clock is unsteady.
        """
        first = state if states is None else states[:, 0]
        shortest = self.period if held is None else float(held[held > 0].min())
        acting, sensing, seeing = self._split(self._at_rest(first, shortest))
        rows = [(*acting, *sensing, *seeing)]
        if not any(memory.numel() for memory in rows[0]):
            return tuple(memory[:, None].expand(-1, commands.shape[1] + 1, -1, -1) for memory in rows[0])
        generator = torch.Generator().manual_seed(0)  # which readings were lost is not known
        system = self.altered(first)
        for t in range(commands.shape[1]):
            if states is not None:
                row = states[:, min(t, states.shape[1] - 1)]
                _, sensing = self._read(row, sensing, generator, self._applied(acting))
                _, seeing = self._scene(row, seeing)
            _, acting = self._act(commands[:, t, None], acting, system, None if held is None else held[:, t, None])
            rows.append((*acting, *sensing, *seeing))
        return tuple(torch.stack(memory, 1) for memory in zip(*rows, strict=True))

    def actuate(self, commands: Tensor, held: Tensor | None = None) -> Tensor:
        """Commands after the actuation effects (B, T, substeps, n_action), from those given (B, T, n_action) since the
        episodes began.

        `held` (B, T) s is how long each command is, where the clock is unsteady; one period without it.
        """
        episodes, length, width = commands.shape
        like = commands.new_zeros(episodes, len(self.system.states))
        acting, _ = self._act(commands, self._split(self._at_rest(like))[0], self.altered(like), held)
        return acting.reshape(episodes, length, self.substeps, width)

    def step(
        self, at: WorldState, action: Tensor, history: History | None = None, correction: Tensor | None = None
    ) -> WorldState:
        """One period on, with `action` (B, n_action), limited to its range, held over it.

        A world with a residual needs the `history` of observations and actions so far, or a `correction` (B, n_state)
        in place of the residual's; other worlds use neither.
        """
        acting, *others = self._split(at.memory)
        system = self.altered(at.state)
        commands, acting = self._act(action[:, None], acting, system)
        state = self._integrate(system, at.time, at.state, commands)
        if self._residuals:
            state = state + (self.correction(action, history) if correction is None else correction)
        # Counted in whole periods: sums of short ones drift in single precision, by 20 ms a minute at 1 kHz.
        rows = (at.time / self.period).round()
        time = (rows + 1) * self.period + (at.time - rows * self.period)
        return WorldState(time, state, (*acting, *chain(*others)))

    def steps_along(self, states: Tensor, actions: Tensor) -> Tensor:
        """The step from each of the states (B, T, n) that follow each other, under actions (B, T, n_action).

        Actuation effects remember the actions given here, but none before them; the time in the episode counts as 0.
        """
        memory = self.memories(states[:, 0], actions, states)
        before = tuple(each[:, :-1].flatten(0, 1) for each in memory)
        at = WorldState(states.new_zeros(states[..., 0].numel()), states.flatten(0, 1), before)
        return self.step(at, actions.flatten(0, 1)).state.unflatten(0, states.shape[:2])

    def correction(self, action: Tensor, history: History | None) -> Tensor:
        """What the residuals add (B, n_state) to the state after a period with `action` (B, n_action)."""
        if history is None:
            raise ValueError("a world with a residual needs the history of observations and actions")
        added = action.new_zeros(len(action), len(self.system.states))
        for residual in self._residuals:
            added = added + residual.delta(history.acting(action)).to(added)
        return added

    def integrate(self, time: Tensor, state: Tensor, commands: Tensor, duration: Tensor | None = None) -> Tensor:
        """The state (B, n_state) a period, or `duration` (B,) s, after `time` (B,) where `commands` act.

        `commands` (B, substeps, n_action) are what `actuate` makes of those that were given: this is the physics alone.
        """
        return self._integrate(self.altered(state), time, state, commands, duration)

    def measure(self, at: WorldState, generator: torch.Generator | None = None) -> tuple[Tensor, WorldState]:
        """What sensors read (B, n_state) of the row `at`, and the world after they have read it.

        A row is read once: after `start`, then after each `step`. Without sensing effects the reading is the state.
        `generator` is needed by random effects alone.
        """
        acting, sensing, seeing = self._split(at.memory)
        measured, sensing = self._read(at.state, sensing, generator, self._applied(acting))
        return measured, replace(at, memory=(*acting, *sensing, *seeing))

    def show(
        self, at: WorldState, draw: Callable[[Tensor], Tensor], generator: torch.Generator | None = None
    ) -> tuple[Tensor, WorldState]:
        """What the camera shows (B, H, W) of the row `at`, and the world after it has shown it.

        `draw` makes frames of states (B, n_state). A row is shown once: after `start`, then after each `step`. Without
        camera effects the frame is what is drawn.
        """
        acting, sensing, seeing = self._split(at.memory)
        state, seeing = self._scene(at.state, seeing)
        frame, seeing = seen_by(self._camera, draw(state), seeing, generator)
        return frame, replace(at, memory=(*acting, *sensing, *seeing))

    def reading(self, state: Tensor, applied: Tensor | None = None) -> Tensor:
        """What sensors read (B, n_state) of states, each as if it were the first row of an episode.

        `applied` (B, 2, n_action) is what acts of the command in that row, and its rate of change, per s; 0 without it.
        Only a world that `reads_commands` needs it.
        """
        return self._read(state, self._split(self._at_rest(state))[1], None, applied)[0]

    def load(self, at: WorldState) -> Tensor:
        """Sum of the loads (B, n_load) of all effects at an instant without a command, with dry friction of the
        coordinates that move."""
        idle = at.state.new_zeros(len(at.state), len(self.system.actions))
        return self._dynamics.load(self.altered(at.state), at.time, at.state, idle)

    def system_at(self, at: WorldState) -> System:
        """The system with the parameters that effects give it at an instant."""
        return self._dynamics.varied(self.altered(at.state), at.time, at.state)

    def altered(self, like: Tensor) -> System:
        """The system with the parameters that effects change permanently, with the device and dtype of `like`."""
        return self._dynamics.altered(like)

    def _arrange(self) -> None:
        """Sort the effects by what they act on, in the order in which they act."""
        effects = list(self.effects)
        self._named = [effect for effect in effects if isinstance(effect, Effect)]
        self._actuation = sorted(
            (e for e in effects if isinstance(e, ActuationEffect)), key=lambda effect: effect.order
        )
        self._sensing = sorted((e for e in effects if isinstance(e, SensingEffect)), key=lambda effect: effect.order)
        if self.reads_commands:
            self._actuation.append(LastApplied(self.substeps))
        self._camera = sorted((e for e in effects if isinstance(e, CameraEffect)), key=lambda effect: effect.order)
        self._residuals = [effect for effect in effects if isinstance(effect, Residual)]
        self._dynamics = _physics(self.system, effects, self.integrator)

    def _at_rest(self, state: Tensor, shortest: float | None = None) -> tuple[Tensor, ...]:
        """What effects remember at the start of an episode in the state (B, n_state), whose commands last `shortest` s
        at least; without it, about a period."""
        commands = state.new_zeros(len(state), self.substeps, len(self.system.actions))
        substep = (shortest or self.period) / self.substeps
        acting = tuple(effect.memory(commands, substep) for effect in self._actuation)
        sensing = tuple(effect.memory(state, self.period) for effect in self._sensing)
        return acting + sensing + tuple(effect.memory(state, self.period) for effect in self._camera)

    def _split(self, memory: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor, ...]]:
        """What the effects on commands, on readings and on frames remember."""
        acting, sensing = len(self._actuation), len(self._actuation) + len(self._sensing)
        return memory[:acting], memory[acting:sensing], memory[sensing:]

    def _act(
        self, commands: Tensor, memory: tuple[Tensor, ...], system: System, held: Tensor | None = None
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """What acts (B, T substeps, n_action) of commands (B, T, n_action), and the new memory."""
        acting = self.system.within_range(commands).repeat_interleave(self.substeps, 1)
        substep: Duration = self.period / self.substeps
        if held is not None:
            substep = (held / self.substeps).repeat_interleave(self.substeps, 1)
        remembered = []
        for effect, own in zip(self._actuation, memory, strict=True):
            acting, own = effect.acting_on(system).apply_to(acting, own, substep)
            remembered.append(own)
        return acting, tuple(remembered)

    def _integrate(
        self, system: System, time: Tensor, state: Tensor, commands: Tensor, duration: Tensor | None = None
    ) -> Tensor:
        h: Duration = (self.period if duration is None else duration) / self.substeps
        for k in range(self.substeps):
            state = self._dynamics.step(system, time, state, commands[:, k], h)
            time = time + h
        return state

    def _applied(self, acting: tuple[Tensor, ...]) -> Tensor | None:
        """What acts (B, 2, n_action) as a row is read, and its rate, of what actuation effects remember."""
        return acting[-1] if self.reads_commands else None

    def _read(
        self,
        state: Tensor,
        memory: tuple[Tensor, ...],
        generator: torch.Generator | None,
        applied: Tensor | None,
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """What sensors read of states (B, n_state) while `applied` (B, 2, n_action) acts, and the new memory."""
        remembered = []
        system = self.system if applied is None else self.altered(state)
        for effect, own in zip(self._sensing, memory, strict=True):
            if applied is not None:
                effect = effect.under(system, *applied.unbind(1))
            state, own = effect.apply_to(state, own, self.period, generator)
            remembered.append(own)
        return state, tuple(remembered)

    def _scene(self, state: Tensor, memory: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The states (B, n_state) that a frame shows in the row of these, and the new memory."""
        remembered = []
        for effect, own in zip(self._camera, memory, strict=True):
            state, own = effect.scene(state, own, self.period)
            remembered.append(own)
        return state, tuple(remembered)


def _steps(system: System, effects: Sequence[nn.Module], period: float) -> int:
    """As few integration steps in a period as follow the system under its effects."""
    return steps_within(period, _physics(system, effects, "rk4").longest_step())


def _physics(system: System, effects: Sequence[nn.Module], integrator: str) -> Dynamics:
    return Dynamics(system, [effect for effect in effects if isinstance(effect, DynamicsEffect)], integrator)

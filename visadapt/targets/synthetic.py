"""Synthetic targets, cart-poles and vehicles: worlds whose effects the learner does not see."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from renderers import DrawnCartPole
from visadapt.effects import ConstantForce, Effect, PeriodicForce
from visadapt.systems import CartPole, RigidBody, System
from visadapt.systems.integrators import steps_within
from visadapt.targets.base import Observation, Target, TargetError, TaskTarget
from visadapt.tasks.base import FlightTask
from visadapt.world import World, WorldState

DrawEffects = Callable[[int, torch.Generator], Sequence[Effect]]
"""(batch, generator) to the effects of a batch of episodes."""


def no_effects(batch: int, generator: torch.Generator) -> Sequence[Effect]:
    """No effects: the target is the source."""
    return ()


def sine_force(batch: int, generator: torch.Generator) -> Sequence[Effect]:
    """A force of 2 (cos(t + phase) + 1) N on the cart (the paper, section 3.2.2), the phase uniform in [-pi, pi].

    >>> import torch, visadapt as va
    >>> va.sine_force(2, torch.Generator().manual_seed(0))[0].name
    'periodic_force'
    """
    phase = math.pi * (2 * torch.rand(batch, generator=generator) - 1)
    return (PeriodicForce(amplitude=2.0, frequency=1 / (2 * math.pi), phase=phase, offset=2.0),)


def constant_force(newtons: float) -> DrawEffects:
    """The same force on the cart in every episode.

    >>> import torch, visadapt as va
    >>> float(va.constant_force(3.3)(2, torch.Generator())[0].force)
    3.299999952316284
    """

    def draw(batch: int, generator: torch.Generator) -> Sequence[Effect]:
        return (ConstantForce(force=newtons),)

    return draw


@dataclass(frozen=True)
class Start:
    """Half-widths of the uniform distribution, around 0, of an episode's first state."""

    x: float = 0.2
    """m"""
    x_dot: float = 0.1
    """m/s"""
    theta: float = 0.1
    """rad"""
    theta_dot: float = 0.1
    """rad/s"""

    def draw(self, batch: int, generator: torch.Generator) -> Tensor:
        """First states (batch, 4)."""
        width = torch.tensor([self.x, self.x_dot, self.theta, self.theta_dot])
        return width * (2 * torch.rand(batch, 4, generator=generator) - 1)


SMOOTH_STEP, ABRUPT_STEP = 0.005, 0.002
"""s, the longest integration steps of a target under smooth effects alone, and under abrupt ones; of a system that
states a longer prediction time, longer in proportion."""


def fine_world(system: System, effects: Sequence[Effect], period: float) -> World:
    """A world that is integrated more finely than any source, and by another method.

    >>> import visadapt as va
    >>> fine_world(va.CartPole(), [va.effects.ViscousFriction(coefficient=1.0)], 0.05).substeps
    10
    """
    longest = ABRUPT_STEP if any(effect.abrupt for effect in effects) else SMOOTH_STEP
    longest *= max(1.0, system.prediction_time / System.prediction_time)
    return World(system, effects, period, "rk3", steps_within(period, longest)).requires_grad_(False)


class WorldTarget(Target):
    """A batch of worlds with hidden effects, as `fine_world` integrates them."""

    def __init__(self, system: System, period: float, draw_effects: DrawEffects) -> None:
        self.system: System = system
        self.period = period
        self.n_action = len(system.actions)
        self.draw_effects = draw_effects
        self._world: World | None = None
        self._at: WorldState
        self._generator: torch.Generator

    def _start(self, state: Tensor, effects: Sequence[Effect], generator: torch.Generator) -> Observation:
        """Start episodes in states (batch, n_state)."""
        self._generator = generator
        self._world = fine_world(self.system, effects, self.period)
        self._at = self._world.start(state)
        return self._observe()

    def step(self, action: Tensor) -> Observation:
        if self._world is None:
            raise TargetError(f"{self.name}: step before reset")
        with torch.no_grad():
            self._at = self._world.step(self._at, action)
        return self._observe()

    def _observe(self) -> Observation:
        """What the sensors read, with `alive` where the state is finite, and as `force` the sum of all loads."""
        assert self._world is not None
        measured, self._at = self._world.measure(self._at, self._generator)
        return Observation(measured, self._at.state.isfinite().all(1), force=self._world.load(self._at))


class SyntheticTarget(WorldTarget):
    """A cart-pole with hidden effects, integrated more finely and by another method than any source.

    Args:
        draw_effects: draws the hidden effects of a batch of episodes.
        camera: draws the frames; without one the target shows states only and the cart may go anywhere.
        system: the physics.
        period: s between actions.
        angle_limit: rad; the episode ends beyond it.

    >>> import torch, visadapt as va
    >>> target = va.SyntheticTarget(va.sine_force)
    >>> target.reset(2, torch.Generator().manual_seed(0)).state.shape
    torch.Size([2, 4])
    """

    name = "synthetic cart-pole"

    def __init__(
        self,
        draw_effects: DrawEffects = no_effects,
        camera: DrawnCartPole | None = None,
        system: System | None = None,
        period: float = 0.05,
        start: Start | None = None,
        angle_limit: float = 0.3,
    ) -> None:
        super().__init__(system or CartPole(), period, draw_effects)
        self.camera = camera
        self.initial = start or Start()
        self.angle_limit = angle_limit

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        effects = self.draw_effects(batch, generator)
        return self._start(self.initial.draw(batch, generator), effects, generator)

    def _observe(self) -> Observation:
        seen, state = super()._observe(), self._at.state
        alive = seen.alive & (state[:, 2].abs() <= self.angle_limit)
        frame = None
        if self.camera is not None:
            alive &= state[:, 0].abs() <= self.camera.camera.reach
            assert self._world is not None
            with torch.no_grad():
                grey, self._at = self._world.show(self._at, self.draw, self._generator)
            frame = (255 * grey).round().clamp(0, 255).to(torch.uint8)
        assert seen.force is not None
        return replace(seen, alive=alive, frame=frame, force=seen.force[:, 0])

    def draw(self, state: Tensor) -> Tensor:
        """Frames (B, H, W) in [0, 1] of states (B, 4), by the camera."""
        assert self.camera is not None
        # The state of a fallen cart-pole may be huge or nan: it is drawn at finite values within +-10.
        shown = state.nan_to_num().clamp(-10, 10).double().numpy()
        return torch.from_numpy(self.camera(shown[:, 0], shown[:, 2])).to(state) / 255


class FlightTarget(WorldTarget, TaskTarget):
    """A vehicle with hidden effects, integrated more finely and by another method than any source.

    A flight ends when its state is no longer finite or, with a finite `reach`, when it is too far off.

    Args:
        task: where flights start and what a policy is shown.
        system: its physics.
        draw_effects: draws the hidden effects of a batch of flights.
        reach: m; a flight ends when it is further than this from its reference or its line to the point
            (`FlightTask.distance_off`), unless it has passed the point.

    >>> import torch, visadapt as va
    >>> from visadapt.tasks.reach import Reach
    >>> target = va.FlightTarget(Reach(), va.FixedWing())
    >>> seen = target.reset(2, torch.Generator().manual_seed(0))
    >>> seen.state.shape, seen.goal.shape, target.period
    (torch.Size([2, 13]), torch.Size([2, 3]), 0.05)
    """

    name = "synthetic vehicle"

    def __init__(
        self, task: FlightTask, system: RigidBody, draw_effects: DrawEffects = no_effects, reach: float = math.inf
    ) -> None:
        super().__init__(system, task.period, draw_effects)
        self.task = task
        self.system: RigidBody = system
        self.reach = reach
        self._task_state: Tensor

    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        state, self.first = self.task.evaluation_start(batch, generator)
        self._task_state = self.first
        return self._start(state, self.draw_effects(batch, generator), generator)

    def step(self, action: Tensor) -> Observation:
        if self._world is not None:
            self._task_state = self.task.advance(self._task_state)
        return super().step(action)

    def _observe(self) -> Observation:
        seen = super()._observe()
        assert seen.force is not None
        state, task_state = self._at.state, self._task_state
        near = (self.task.distance_off(state, task_state) <= self.reach) | self.task.passed(state, task_state)
        goal, force = self.task.goal(task_state), seen.force[:, :3]
        return replace(seen, alive=seen.alive & near, force=force, goal=goal, task_state=task_state)

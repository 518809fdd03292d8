"""Laws of forces and torques on one joint, which effects of a cart-pole and of a system of one's own share.

A joint is a load of the system with the position and the velocity that it acts on (`System.coordinates`). A subclass
gives the law a name, units and ranges; parameters that stand for a force have the name that the subclass gives them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.effects.base import DynamicsEffect, Effect, inside
from visadapt.systems import System


class JointEffect(DynamicsEffect):
    """Acts on one joint alone."""

    joint: ClassVar[int] = 0
    """index of its load; in all the library's systems load 0 is a force along x"""

    def joint_position(self, state: Tensor, system: System) -> Tensor:
        """Position of the joint, (B,)."""
        return state[:, system.coordinates[self.joint][0]]

    def joint_velocity(self, state: Tensor, system: System) -> Tensor:
        """Velocity of the joint, (B,)."""
        return state[:, system.coordinates[self.joint][1]]

    def _on_joint(self, value: Tensor, system: System) -> Tensor:
        """(B, n_load, ...) with a value (B, ...) at the joint and 0 elsewhere."""
        after = len(system.loads) - 1 - self.joint
        return pad(value[:, None], (*(0, 0) * (value.dim() - 1), self.joint, after))


class JointLoad(JointEffect):
    """A load on one joint."""

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        """The load, (B,)."""
        raise NotImplementedError

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return self._on_joint(self.push(time, state, system), system)


class ViscousLaw(JointLoad):
    """Friction proportional to the joint's velocity."""

    source = "Olsson et al. (1998), Friction models and friction compensation, section 2"

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return -self.value("coefficient", state) * self.joint_velocity(state, system)


class DragLaw(JointLoad):
    """Drag of the air at high Reynolds numbers."""

    source = "Batchelor (1967), An Introduction to Fluid Dynamics, section 5.11"

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        velocity = self.joint_velocity(state, system)
        return -self.value("coefficient", state) * velocity.abs() * velocity


class SpringLaw(JointLoad):
    """A spring, such as a cable, that pulls the joint to its rest position."""

    source = "Hooke's law"

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return -self.value("stiffness", state) * (self.joint_position(state, system) - self.value("rest", state))


class ConstantLaw(JointLoad):
    """A constant load on the joint, such as a cable's pull."""

    source = "Newton's second law; the paper, section 3.2.1"

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return self.value(self.table[0].name, state).expand_as(time)


class PeriodicLaw(JointLoad):
    """A sinusoidal load on the joint, with an offset; the phase is that at the start of the episode."""

    source = "the paper, section 3.2.2"

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        angle = 2 * math.pi * self.value("frequency", state) * time + self.value("phase", state)
        return self.value("amplitude", state) * angle.cos() + self.value("offset", state)


class CoggingLaw(JointLoad):
    """A load that returns a whole number of times in every turn: a motor's cogging, a gear's mesh, an eccentric wheel.

    Its phase is that at the zero of the joint's angle.
    """

    abrupt = True  # a fast shaft passes several waves within a period
    source = "Hendershot and Miller (2010), Design of Brushless Permanent-Magnet Machines, on cogging"

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        angle = self.value("waves", state) * self.joint_position(state, system) + self.value("phase", state)
        return self.value("torque", state) * angle.cos()


class PulseLaw(JointLoad):
    """A constant load between two times, counted from the start of the episode.

    Its edges are logistic, 10 % to 90 % in 18 ms, so that integration steps of 12.5 ms resolve them; its impulse,
    load (end - start), is that of sharp edges. On a slow machine both are longer, as its prediction time is.
    """

    abrupt = True
    source = "Newton's second law"

    EDGE: ClassVar[float] = 0.008  # Width of the edges, in prediction times

    def push(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        start, end = self.value("start", state), self.value("end", state)
        return self.value(self.table[2].name, state) * inside(time, start, end, self.EDGE * system.prediction_time)


class DryFrictionLaw(JointEffect):
    """Friction that stops the joint and holds it at rest."""

    abrupt = True

    def limits(self, state: Tensor, command: Tensor, system: System) -> tuple[Tensor, Tensor]:
        """The largest friction against positive and against negative motion, () or (B,) each."""
        raise NotImplementedError

    def dry_friction(self, time: Tensor, state: Tensor, command: Tensor, system: System) -> Tensor:
        both = [limit.expand_as(time) for limit in self.limits(state, command, system)]
        return self._on_joint(torch.stack(both, -1), system)


class CoulombLaw(DryFrictionLaw):
    """Dry friction of the joint, the same at every speed; a joint at rest sticks."""

    dry_friction_by_velocity = False
    source = "Olsson et al. (1998), Friction models and friction compensation, section 2"

    def limits(self, state: Tensor, command: Tensor, system: System) -> tuple[Tensor, Tensor]:
        limit = self.value(self.table[0].name, state)
        return limit, limit


class StribeckLaw(DryFrictionLaw):
    """Dry friction of the joint that is larger near rest than at speed."""

    source = "Armstrong-Helouvry, Dupont and Canudas de Wit (1994), Automatica 30(7), section 2.2"

    @classmethod
    def is_simpler(cls, values: Sequence[float]) -> bool:
        at_speed, breakaway, _ = values
        return breakaway <= at_speed

    def limits(self, state: Tensor, command: Tensor, system: System) -> tuple[Tensor, Tensor]:
        at_speed, breakaway = self.value(self.table[0].name, state), self.value("breakaway", state)
        share = (-(self.joint_velocity(state, system) / self.value("velocity", state)).square()).exp()
        limit = at_speed + (breakaway - at_speed).clamp_min(0) * share
        return limit, limit


class _OwnForward:
    """The parameter `forward`, which torch's method of the same name would hide."""

    def __get__(self, effect: Effect | None, owner: type[Effect]) -> Any:
        return self if effect is None else effect._parameters["forward"]


class DirectionalLaw(DryFrictionLaw):
    """Dry friction of the joint that differs between its two directions."""

    forward = _OwnForward()

    dry_friction_by_velocity = False
    source = "Armstrong-Helouvry, Dupont and Canudas de Wit (1994), Automatica 30(7), section 2"

    def limits(self, state: Tensor, command: Tensor, system: System) -> tuple[Tensor, Tensor]:
        return self.value("forward", state), self.value("backward", state)


class LoadDependentLaw(DryFrictionLaw):
    """Dry friction of a gear, a share of what the motor passes through it; the joint's other loads add none."""

    dry_friction_by_velocity = False
    source = "Duclusaud et al. (2025), Extended friction models for the physics simulation of servo actuators, model M3"

    def limits(self, state: Tensor, command: Tensor, system: System) -> tuple[Tensor, Tensor]:
        limit = self.value("share", state) * system.motor_loads(state, command)[:, self.joint].abs()
        return limit, limit

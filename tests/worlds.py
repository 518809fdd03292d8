"""A system simple enough for closed forms, and the energy of a cart-pole, for the tests of effects and worlds."""

from dataclasses import dataclass
from typing import ClassVar

import torch

from visadapt.systems import System, Variable


@dataclass(frozen=True)
class Mass(System):
    """A mass of 2 kg on a line, pushed by `command` newtons; the columns after x and x_dot stay as they are."""

    kilograms: float = 2.0

    name: ClassVar[str] = "mass"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("x", "m", -1.0, 1.0),
        Variable("x_dot", "m/s", -1.0, 1.0),
        Variable("theta", "rad", -1.0, 1.0),
        Variable("theta_dot", "rad/s", -1.0, 1.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (Variable("command", "N", -1.0, 1.0),)
    loads: ClassVar[tuple[Variable, ...]] = (
        Variable("force", "N", -10.0, 10.0),
        Variable("pivot_torque", "N m", -10.0, 10.0),
    )

    coordinates: ClassVar[tuple[tuple[int, int], ...]] = ((0, 1), (2, 3))

    def derivative(self, state, command, load):
        acceleration = (command[:, 0] + load[:, 0]) / self.kilograms
        still = torch.zeros_like(acceleration)
        return torch.stack((state[:, 1], acceleration, still, still), 1)


def columns(*values, dtype=torch.float64):
    """A batch of one row."""
    return torch.tensor([values], dtype=dtype)


def run(world, state, actions):
    """States (T + 1, B, n_state) of a world under actions (T, B, n_action)."""
    at = world.start(state)
    states = [at.state]
    for action in actions:
        at = world.step(at, action)
        states.append(at.state)
    return torch.stack(states)


def energy_of(system, state):
    """Kinetic plus potential energy of a cart-pole in J, (B,): conserved without command, load and friction."""
    _, velocity, angle, angular_velocity = state.unbind(-1)
    moment = system.pole_mass * system.pole_half_length
    inertia = 4.0 / 3.0 * moment * system.pole_half_length
    return (
        0.5 * (system.cart_mass + system.pole_mass) * velocity.square()
        + moment * velocity * angular_velocity * angle.cos()
        + 0.5 * inertia * angular_velocity.square()
        + moment * system.gravity * angle.cos()
    )

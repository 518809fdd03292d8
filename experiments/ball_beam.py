"""A ball on a beam: the system, and recordings in which a controller sends the ball to and fro.

A camera that is slower than the encoder of the beam sees the ball, as in a laboratory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from visadapt.effects import Effect
from visadapt.recordings import Episode, Recording
from visadapt.systems import System, Variable
from visadapt.world import World


@dataclass(frozen=True)
class BallBeam(System):
    """A ball rolls on a beam, which a motor tilts about its middle."""

    ball_mass: float | Tensor = 0.11  # kg
    beam_inertia: float | Tensor = 0.02  # kg m2
    gravity: float | Tensor = 9.81

    name = "ball_beam"
    states: ClassVar[tuple[Variable, ...]] = (
        Variable("ball", "m", -0.45, 0.45),
        Variable("beam", "rad", -0.6, 0.6),
        Variable("ball_rate", "m/s", -2.0, 2.0),
        Variable("beam_rate", "rad/s", -6.0, 6.0),
    )
    actions: ClassVar[tuple[Variable, ...]] = (Variable("torque", "N m", -1.0, 1.0),)
    loads = (Variable("track", "N", -0.3, 0.3), Variable("axle", "N m", -0.3, 0.3))
    coordinates = ((0, 2), (1, 3))

    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        ball, beam, rate, turn = state.unbind(-1)
        mass = self.ball_mass
        rolls = (mass * (ball * turn**2 - self.gravity * beam.sin()) + load[:, 0]) / (1.4 * mass)
        torque = command[:, 0] + load[:, 1] - mass * self.gravity * ball * beam.cos() - 2 * mass * ball * rate * turn
        return torch.stack((rate, turn, rolls, torque / (self.beam_inertia + mass * ball**2)), -1)


PERIOD = 0.01  # s
GAINS = torch.tensor([-3.95, 3.45, -1.77, 0.39], dtype=torch.float64)
READ = (0, 3, 7)  # Rows of every ten in which the camera sees the ball


NOISE = (1e-3, 1e-4)  # Standard deviations of the readings: of the ball in m, of the beam in rad


def to_and_fro(time: float) -> float:
    """Where the ball is sent to, in m, at a time in s."""
    return 0.15 * float(np.sign(np.sin(2.1 * time + 0.5)))


def balanced(
    effects: Sequence[Effect], seed: int, rows: int, goal: Callable[[float], float] = to_and_fro
) -> tuple[Recording, Tensor]:
    """The recording of a ball that is sent to a goal, and its states (rows, 4)."""
    generator, probe = torch.Generator().manual_seed(seed), 0.0
    world = World(BallBeam(), [effect.double() for effect in effects], PERIOD, substeps=10)
    at, states, torques = world.start(torch.tensor([[0.05, 0.0, 0.0, 0.0]], dtype=torch.float64)), [], []
    with torch.no_grad():
        for row in range(rows):
            there = goal(PERIOD * row)
            if row % 20 == 0:
                probe = 0.04 * float(2 * torch.randint(0, 2, (1,), generator=generator) - 1)
            away = at.state[0] - torch.tensor([there, 0, 0, 0])
            torque = (0.11 * 9.81 * there - GAINS @ away + probe).clamp(-1, 1)
            states.append(at.state[0])
            torques.append(torque)
            at = world.step(at, torque.reshape(1, 1))
    clean = torch.stack(states)
    noise = torch.tensor(NOISE) * torch.randn(rows, 2, generator=generator, dtype=torch.float64)
    usable = np.ones((rows, 2), bool)
    usable[:, 0] = np.isin(np.arange(rows) % 10, READ)
    read = (clean[:, :2] + noise).numpy()
    episode = Episode(PERIOD * np.arange(rows), torch.stack(torques)[:, None].numpy(), read)
    return Recording((episode,), ("ball", "beam"), PERIOD, ("beam.csv",), usable=(usable,)), clean

"""Recordings of a ball that a controller moves on a beam, seen by a camera that is slower than the beam's encoder."""

import numpy as np
import torch

from tests.own_systems import BallBeam
from visadapt.recordings import Episode, Recording
from visadapt.world import World

PERIOD = 0.01
GAINS = torch.tensor([-3.95, 3.45, -1.77, 0.39], dtype=torch.float64)
READ = (0, 3, 7)  # Rows of every ten in which the camera sees the ball


def to_and_fro(time):
    """Where the ball is sent to, in m."""
    return 0.15 * np.sign(np.sin(2.1 * time + 0.5))


def balanced(effects, seed, rows, goal=to_and_fro):
    """The recording, and the states (rows, 4), of a ball that is sent to its goals at each time in s."""
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
    noise = torch.tensor([1e-3, 1e-4]) * torch.randn(rows, 2, generator=generator, dtype=torch.float64)
    usable = np.ones((rows, 2), bool)
    usable[:, 0] = np.isin(np.arange(rows) % 10, READ)
    read = (clean[:, :2] + noise).numpy()
    episode = Episode(PERIOD * np.arange(rows), torch.stack(torques)[:, None].numpy(), read)
    return Recording((episode,), ("ball", "beam"), PERIOD, ("beam.csv",), usable=(usable,)), clean

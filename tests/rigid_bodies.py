"""A quadrotor unlike the default, states and flights, for the tests of rigid bodies."""

import torch

from visadapt.systems import Quadrotor
from visadapt.world import World

HEAVY = Quadrotor(mass=1.7, arm_length=0.3, roll_gain=9.0, yaw_gain=3.0, max_rate=2.0, gravity=9.7)


def at_rest(batch=1, dtype=torch.float64):
    state = torch.zeros(batch, 13, dtype=dtype)
    state[:, 6] = 1
    return state


def random_states(batch, seed=0):
    """Any attitude, of any norm."""
    return torch.randn(batch, 13, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def fly(system, state, commands, period=0.1, substeps=50):
    """States (K + 1, B, 13) under commands (K, B, 4)."""
    world = World(system, period=period, substeps=substeps)
    at = world.start(state)
    states = [state]
    for command in commands:
        at = world.step(at, command)
        states.append(at.state)
    return torch.stack(states)

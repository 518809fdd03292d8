"""A fixed wing without left-right symmetry, and its states, for the tests of the fixed wing."""

import torch

from visadapt.systems import FixedWing
from visadapt.systems.rigid_body import from_angles

LOPSIDED = FixedWing(side_zero=0.01, roll_zero=0.0005, yaw_zero=-0.002, inertia_xz=0.02, side_aileron=0.05)


def double(values):
    return torch.as_tensor(values, dtype=torch.float64)


def state_of(velocity, angles=(0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0)):
    return torch.cat((double(position), double(velocity), from_angles(double(angles)), double(rates)))[None]

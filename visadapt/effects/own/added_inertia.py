"""Inertia added to the joints of a system of one's own."""

from __future__ import annotations

import torch

from visadapt.effects.laws import JointEffect
from visadapt.effects.own.extended import with_inertia
from visadapt.systems import System


class AddedInertia(JointEffect):
    """A body fixed to the joint that adds inertia and no weight, such as a flywheel or a rotor behind a gear."""

    source = "Newton's second law"

    def alter(self, system: System) -> System:
        return with_inertia(system, self.joint, getattr(self, self.table[0].name))


def inertia_of(system: System, joint: int) -> float:
    """The joint's own inertia, in units of load per acceleration, in the middle of the states' ranges."""
    state, command, load = (
        torch.tensor([[(one.low + one.high) / 2 for one in variables]], dtype=torch.float64)
        for variables in (system.states, system.actions, system.loads)
    )
    _, gain = system.response_to_loads(state, command, load)
    return 1 / float(gain[0, joint, joint])

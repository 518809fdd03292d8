"""An effect that Coulomb's friction describes nearly: for tests of what is said of such a machine."""

import torch

import visadapt as va
from visadapt.effects import EFFECTS


class Creep(va.DynamicsEffect):
    """Dry friction of 3 N that lets the cart creep, as MuJoCo's does: it acts fully well above `speed`, in m/s."""

    name = "creep"
    table = ()

    def __init__(self, speed):
        super().__init__()
        self.speed = speed

    def load(self, time, state, system):
        force = -3.0 * (state[:, 1] / self.speed).tanh()
        return torch.stack((force, torch.zeros_like(force)), -1)


EFFECTS.pop("creep")  # no cause that a diagnosis may name

"""Forces of the air on vehicles that fly."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import pad

from visadapt.effects.base import DynamicsEffect, Parameter
from visadapt.systems import RigidBody, System
from visadapt.systems.rigid_body import VELOCITY


class LinearDrag(DynamicsEffect):
    """Drag in proportion to the speed, as rotors in forward flight have it.

    The paper's v' = v' - r v, with r = 0.3 1/s, is coefficient = r mass, on both vehicles.
    """

    name = "linear_drag"
    equation = "F = -coefficient v, v the velocity in world axes"
    source = "Faessler, Franchi and Scaramuzza (2017), Differential flatness of quadrotor dynamics; the paper, 3.2.1"
    table = (Parameter("coefficient", "N s/m", 0.0, 3.0, 0.0, linear=True),)
    systems = (RigidBody,)

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        return pad(-self.value("coefficient", state)[..., None] * state[:, VELOCITY], (0, 3))

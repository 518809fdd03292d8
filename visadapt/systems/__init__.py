"""Systems: the physics of the source simulator, in continuous time."""

from visadapt.systems.base import System, Variable
from visadapt.systems.cartpole import CartPole
from visadapt.systems.fixed_wing import FixedWing
from visadapt.systems.quadrotor import Quadrotor
from visadapt.systems.rigid_body import RigidBody

SYSTEMS: dict[str, type[System]] = {system.name: system for system in (CartPole, Quadrotor, FixedWing)}

__all__ = ["SYSTEMS", "CartPole", "FixedWing", "Quadrotor", "RigidBody", "System", "Variable"]

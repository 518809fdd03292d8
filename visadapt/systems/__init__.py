"""Systems: the physics of the source simulator, in continuous time."""

from visadapt.systems.base import NAMED, System, Variable
from visadapt.systems.cartpole import CartPole
from visadapt.systems.fixed_wing import FixedWing
from visadapt.systems.quadrotor import Quadrotor
from visadapt.systems.rigid_body import RigidBody

SYSTEMS: dict[str, type[System]] = {system.name: system for system in (CartPole, Quadrotor, FixedWing)}


def system_named(name: str) -> type[System]:
    """A system of the library, or else one of the user's own, by its name."""
    return {**NAMED, **SYSTEMS}[name]


__all__ = ["SYSTEMS", "CartPole", "FixedWing", "Quadrotor", "RigidBody", "System", "Variable", "system_named"]

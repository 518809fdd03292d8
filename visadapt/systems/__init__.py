"""Systems: the source physics, in continuous time."""

from visadapt.systems.base import System, Variable
from visadapt.systems.cartpole import CartPole

SYSTEMS: dict[str, type[System]] = {system.name: system for system in (CartPole,)}

__all__ = ["SYSTEMS", "CartPole", "System", "Variable"]

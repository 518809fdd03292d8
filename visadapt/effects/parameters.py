"""Effects that change some parameters of a system and leave the others as they are."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from visadapt.effects.base import DynamicsEffect, Parameter, require_system
from visadapt.systems import CartPole, System

__all__ = ["CartMass", "ParameterScale", "ParameterShift", "PoleLength", "PoleMass"]


class ParameterScale(DynamicsEffect):
    """Scale factors on parameters of the system that a subclass acts on; adds no load."""

    scaled: ClassVar[dict[str, str]]  # the system's parameter for each of the effect's

    def alter(self, system: System) -> System:
        own = require_system(system, self)
        values = {field: getattr(self, factor) * getattr(own, field) for factor, field in self.scaled.items()}
        return replace(own, **values)


class ParameterShift(DynamicsEffect):
    """Amounts added to parameters of the system that a subclass acts on; adds no load."""

    shifted: ClassVar[dict[str, str]]  # the effect's parameter for each of the system's

    def alter(self, system: System) -> System:
        own = require_system(system, self)
        values = {field: getattr(own, field) + getattr(self, amount) for field, amount in self.shifted.items()}
        return replace(own, **values)


class CartMass(ParameterScale):
    """A cart heavier or lighter than the source's."""

    name = "cart_mass"
    equation = "M = scale M_source"
    source = "Barto, Sutton and Anderson (1983), appendix, the cart's mass"
    table = (Parameter("scale", "1", 0.05, 20.0, 1.0),)
    systems = (CartPole,)
    scaled: ClassVar[dict[str, str]] = {"scale": "cart_mass"}


class PoleMass(ParameterScale):
    """A pole heavier or lighter than the source's, still uniform."""

    name = "pole_mass"
    equation = "m = scale m_source"
    source = "Barto, Sutton and Anderson (1983), appendix, the pole's mass"
    table = (Parameter("scale", "1", 0.02, 20.0, 1.0),)
    systems = (CartPole,)
    scaled: ClassVar[dict[str, str]] = {"scale": "pole_mass"}
    caveat = (
        "motion shows the pole's mass only against the cart's mass and the forces: if the pole weighs what the source "
        "says, the cart's mass, the motor's force and every friction are divided by this scale instead; weigh the pole"
    )


class PoleLength(ParameterScale):
    """A pole longer or shorter than the source's, of the same mass and still uniform."""

    name = "pole_length"
    equation = "l = scale l_source"
    source = "Barto, Sutton and Anderson (1983), appendix, the pole's half-length"
    table = (Parameter("scale", "1", 0.2, 5.0, 1.0),)
    systems = (CartPole,)
    scaled: ClassVar[dict[str, str]] = {"scale": "pole_half_length"}

"""Effects that change parameters of a cart-pole. Each scales one and leaves the others as they are."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from torch import Tensor

from visadapt.effects.base import DynamicsEffect, Parameter, expect
from visadapt.systems import CartPole, System


class ParameterScale(DynamicsEffect):
    """A factor on one parameter of a cart-pole; adds no load."""

    systems = (CartPole,)
    field: ClassVar[str]
    """the parameter's name in the system"""
    scale: Tensor

    def alter(self, system: System) -> System:
        cart_pole = expect(system, CartPole, self)
        return replace(cart_pole, **{self.field: self.scale * getattr(cart_pole, self.field)})


class CartMass(ParameterScale):
    """A cart heavier or lighter than the source's."""

    name = "cart_mass"
    equation = "M = scale M_source"
    source = "Barto, Sutton and Anderson (1983), appendix, the cart's mass"
    table = (Parameter("scale", "1", 0.3, 8.0, 1.0),)
    field = "cart_mass"


class PoleMass(ParameterScale):
    """A pole heavier or lighter than the source's, still uniform."""

    name = "pole_mass"
    equation = "m = scale m_source"
    source = "Barto, Sutton and Anderson (1983), appendix, the pole's mass"
    table = (Parameter("scale", "1", 0.05, 5.0, 1.0),)
    field = "pole_mass"


class PoleLength(ParameterScale):
    """A pole longer or shorter than the source's, of the same mass and still uniform."""

    name = "pole_length"
    equation = "l = scale l_source"
    source = "Barto, Sutton and Anderson (1983), appendix, the pole's half-length"
    table = (Parameter("scale", "1", 0.4, 2.5, 1.0),)
    field = "pole_half_length"

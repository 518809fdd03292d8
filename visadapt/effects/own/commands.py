"""Effects on the commands of a system of one's own, one command at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from visadapt.effects import actuation
from visadapt.effects.base import ActuationEffect, Effect, Parameter
from visadapt.effects.own.statement import ALL_SENSORS, Made, delay_of_all
from visadapt.systems import System, Variable
from visadapt.systems.integrators import Duration


class OneCommand(ActuationEffect):
    """An effect on one command of several; `action` is its index."""

    action: int

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        return super().memory(self._own(commands), substep)

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        acting, memory = super().apply_to(self._own(commands), memory, substep)
        before, after = commands[..., : self.action], commands[..., self.action + 1 :]
        return torch.cat((before, acting, after), -1), memory

    def _own(self, commands: Tensor) -> Tensor:
        return commands[..., self.action : self.action + 1]


def on_commands(system: type[System]) -> Iterator[Made]:
    """The effects on each command, and a delay of all commands."""
    twin = f"{ALL_SENSORS}.measurement_delay"
    settled = {twin: actuation.ActuatorDelay.settled_by["measurement_delay"]}
    delay_in_common = {"indistinguishable_from": (twin,), "settled_by": settled}
    if len(system.actions) > 1:
        yield delay_of_all(system), actuation.ActuatorDelay, delay_in_common
    for index, action in enumerate(system.actions):
        for base in (
            actuation.ActuatorDelay,
            actuation.ActuatorBacklash,
            actuation.ActuatorDeadzone,
            actuation.ActuatorSaturation,
            actuation.ActuatorGain,
            actuation.ActuatorBias,
            actuation.ActuatorLag,
        ):
            table = tuple(_in_units_of(parameter, action) for parameter in base.table)
            if base is actuation.ActuatorBias:
                # As wide as that of a constant load, which may do the same: only one of the two is searched.
                table = tuple(replace(one, low=-action.largest, high=action.largest) for one in table)
            says = _SAYS.get(base, (base.__doc__ or "").partition("\n\n")[0])
            name, attributes = f"{action.name}.{base.name}", {"table": table, "action": index, "__doc__": says}
            if name == delay_of_all(system):
                attributes |= delay_in_common
            yield name, type(base.__name__, (OneCommand, base), {}), attributes


_SAYS: dict[type[Effect], str] = {
    actuation.ActuatorSaturation: "A limit on the command that the motor follows, of its supply or its current.",
    actuation.ActuatorBias: "A constant added to every command.",
}
"""Summaries of effects whose docstring is about a cart-pole."""


def _in_units_of(parameter: Parameter, action: Variable) -> Parameter:
    """A parameter in units of the command (of 1), converted to those of an action; scales and times are kept."""
    if parameter.unit != "1" or parameter.name == "scale":
        return parameter
    most = action.largest
    neutral = None if parameter.neutral is None else parameter.neutral * most
    return replace(parameter, unit=action.unit, low=parameter.low * most, high=parameter.high * most, neutral=neutral)

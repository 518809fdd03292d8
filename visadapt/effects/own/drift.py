"""A drift of states of a system of one's own that no load moves, such as the position of a boat in a current."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from visadapt.effects.base import DynamicsEffect, Parameter
from visadapt.effects.own.extended import with_drift
from visadapt.effects.own.statement import Made
from visadapt.systems import System
from visadapt.systems.contract import inputs


class Drift(DynamicsEffect):
    """A state changes at a constant rate beside what the simulator says: a current carries a boat, a gyro turns."""

    source = "Fossen (2021), Handbook of Marine Craft Hydrodynamics and Motion Control, section 10.3, current"
    of_state: ClassVar[int]  # its column

    def alter(self, system: System) -> System:
        return with_drift(system, self.of_state, getattr(self, self.table[0].name))


def on_states(system: type[System]) -> Iterator[Made]:
    """A drift of each state that belongs to no joint."""
    fastest = system().derivative(*inputs(system())).abs().amax(0)
    for column in system.outside_joints():
        state, most = system.states[column], float(fastest[column])
        unit = f"{state.unit}2" if state.unit.endswith("/s") else f"{state.unit}/s"
        if most > 0:
            yield (
                f"{state.name}.drift",
                Drift,
                {
                    "of_state": column,
                    "equation": f"d({state.name})/dt = that of the source + rate",
                    "table": (Parameter("rate", unit, -most, most, 0.0),),
                },
            )

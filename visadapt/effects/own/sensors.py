"""Effects on the sensors of a system of one's own."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch

from visadapt.effects import late_sensors, sensing
from visadapt.effects.base import Parameter, Role
from visadapt.effects.own.statement import ALL_SENSORS, Made, delay_of_all, turns
from visadapt.effects.transmission import TransmissionCompliance
from visadapt.systems import System
from visadapt.systems.contract import ROUNDING, inputs


def on_sensors(system: type[System]) -> Iterator[Made]:
    """Offset, scale and delay of each sensor, and a delay of all. Velocities share scale and delay of their positions,
    as where both are read from one encoder; beside a tachometer or gyroscope, either may have a scale of its own."""
    rates = system.velocity_of()
    moving = {"positions": list(rates), "velocities": list(rates.values())}
    yield (
        f"{ALL_SENSORS}.measurement_delay",
        late_sensors.MeasurementDelay,
        {**moving, "late": list(range(len(system.states))), "indistinguishable_from": (delay_of_all(system),)},
    )
    yield from _transmissions(system)
    for column, state in enumerate(system.states):
        name, unit = state.name, state.unit
        most = 0.2 * state.largest
        yield (
            f"{name}.sensor_offset",
            sensing.SensorOffset,
            {
                "__doc__": f"A sensor of {name} whose zero is off.",
                "equation": f"{name} measured = {name} + offset",
                "table": (Parameter("offset", unit, -most, most, 0.0, linear=True),),
                "sensor": column,
                "order": sensing.AngleOffset.order,
            },
        )
        if column in rates.values():
            yield _scale(f"{name}.sensor_scale", system, [column])
            continue
        scaled = [column, rates[column]] if column in rates else [column]
        both = ", ".join(system.states[one].name for one in scaled)
        if len(scaled) < len(system.states):
            yield (
                f"{name}.sensor_delay",
                late_sensors.LateSensors,
                {
                    **moving,
                    "__doc__": f"A sensor of {name} that is late against the others, as when its clock is another.",
                    "equation": f"({both}) measured(t) = ({both})(max(t - delay, 0))",
                    "late": scaled,
                },
            )
        if column in rates and turns(state):
            yield (
                f"{name}.sensor_eccentricity",
                sensing.SensorEccentricity,
                {
                    "equation": f"{name} measured = {name} + amplitude cos(waves {name} + phase)",
                    "table": (
                        Parameter("amplitude", "rad", 0.0, LARGEST_ECCENTRICITY, 0.0, linear=True),
                        Parameter("waves", "1", 0.5, 4.0, None, role=Role.WAVES),
                        Parameter("phase", "rad", -math.pi, math.pi, None, role=Role.PHASE),
                    ),
                    "columns": scaled,
                    "order": sensing.SensorScale.order - 5,
                },
            )
        yield _scale(f"{name}.sensor_scale", system, scaled)
        if len(scaled) > 1:
            yield _scale(f"{name}.position_scale", system, [column])


def _scale(name: str, system: type[System], columns: list[int]) -> Made:
    """A sensor that reads the states in these columns, whose counts per unit differ from those assumed."""
    read = ", ".join(system.states[column].name for column in columns)
    read = read if len(columns) == 1 else f"({read})"
    return (
        name,
        sensing.SensorGain,
        {
            "equation": f"{read} measured = scale {read}",
            "table": (Parameter("scale", "1", 0.5, 2.0, 1.0, linear=True),),
            "columns": columns,
            "order": sensing.SensorScale.order,
        },
    )


LARGEST_ECCENTRICITY = 0.1  # rad, of the error of an angle sensor within a turn

LARGEST_TWIST = 0.02
"""Share of a joint's range that its transmission is searched to give under its largest load."""


def _transmissions(system: type[System]) -> Iterator[Made]:
    """The transmission of each joint that a motor moves."""
    example, largest = system(), torch.tensor([load.largest for load in system.loads])
    state, command, _ = inputs(example)
    moved = example.motor_loads(state, command).abs() > ROUNDING * largest
    for joint, (load, (column, rate)) in enumerate(zip(system.loads, system.coordinates, strict=True)):
        if column is not None and bool(moved[:, joint].any()):
            position, velocity = system.states[column], system.states[rate]
            per = f"({load.unit})" if " " in load.unit else load.unit
            most = LARGEST_TWIST * position.largest / load.largest
            yield (
                f"{load.name}.transmission_compliance",
                TransmissionCompliance,
                {
                    "equation": f"{position.name} measured = {position.name} + compliance Q, {velocity.name} measured "
                    f"= {velocity.name} + compliance dQ/dt, with the motor's load Q on the {load.name}",
                    "table": (Parameter("compliance", f"{position.unit}/{per}", 0.0, most, 0.0, linear=True),),
                    "joint": joint,
                },
            )

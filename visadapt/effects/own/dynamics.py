"""Effects on the joints and on the parameters of a system of one's own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from visadapt.effects import laws
from visadapt.effects.base import Parameter, Role
from visadapt.effects.own.added_inertia import AddedInertia, inertia_of
from visadapt.effects.own.statement import Made, slides, turns
from visadapt.effects.parameters import ParameterScale
from visadapt.systems import System, Variable
from visadapt.systems.base import parameters


def on_joints(system: type[System]) -> Iterator[Made]:
    """The effects on each joint: loads, and added inertia."""
    for joint, (load, (position, velocity)) in enumerate(zip(system.loads, system.coordinates, strict=True)):
        kinds = _laws(load, None if position is None else system.states[position], system.states[velocity])
        for kind, (law, equation, table) in kinds.items():
            yield f"{load.name}.{kind}", law, {"joint": joint, "equation": equation, "table": table}
        most = 5 * inertia_of(system(), joint)
        per_rate = replace(system.states[velocity], unit=f"{system.states[velocity].unit}/s")
        unit = {"N": "kg", "N m": "kg m2"}.get(load.unit, _per(load, per_rate))
        yield (
            f"{load.name}.added_inertia",
            AddedInertia,
            {
                "joint": joint,
                "equation": f"Q = -inertia d({system.states[velocity].name})/dt",
                "table": (Parameter("inertia", unit, 0.0, most, 0.0),),
            },
        )


def _per(load: Variable, variable: Variable, power: int = 1) -> str:
    """The unit of a load over a position, or over a power of a velocity."""
    unit, _, over = variable.unit.partition("/")
    times = f" {over}{power if power > 1 else ''}" if over else ""
    return f"{load.unit}{times}/{unit}{power if power > 1 else ''}"


_Laws = dict[str, tuple[type[laws.JointEffect], str, tuple[Parameter, ...]]]
"""Of each effect of a joint: its law, its equation, and its parameters"""


def _laws(load: Variable, position: Variable | None, velocity: Variable) -> _Laws:
    most, fastest = load.largest, velocity.largest
    size = "torque" if load.unit == "N m" else "force"
    v, unit = velocity.name, load.unit

    def linear(name: str, low: float, unit: str = unit, high: float = most) -> Parameter:
        return Parameter(name, unit, low, high, 0.0, linear=True)

    # A coefficient is searched up to the one with which a third of the range of motion makes the largest load.
    per_velocity = 3 * most / fastest
    by_position: _Laws = {}
    if position is not None:
        by_position["spring"] = (
            laws.SpringLaw,
            f"Q = -stiffness ({position.name} - rest)",
            (
                linear("stiffness", 0.0, _per(load, position), 3 * most / position.largest),
                Parameter("rest", position.unit, position.low, position.high, None),
            ),
        )
    if position is not None and turns(position):
        by_position["cogging"] = (
            laws.CoggingLaw,
            f"Q = torque cos(waves {position.name} + phase)",
            (
                linear("torque", 0.0),
                Parameter("waves", "1", 0.5, 24.0, None, role=Role.WAVES),
                Parameter("phase", "rad", -math.pi, math.pi, None, role=Role.PHASE),
            ),
        )
    return {
        "viscous_friction": (
            laws.ViscousLaw,
            f"Q = -coefficient {v}",
            (linear("coefficient", 0.0, _per(load, velocity), per_velocity),),
        ),
        "quadratic_drag": (
            laws.DragLaw,
            f"Q = -coefficient |{v}| {v}",
            (linear("coefficient", 0.0, _per(load, velocity, 2), 3 * per_velocity / fastest),),
        ),
        **(_dry_friction(size, most, unit, velocity) if slides(position, velocity) else {}),
        **by_position,
        "constant_load": (laws.ConstantLaw, f"Q = {size}", (linear(size, -most),)),
        "periodic_load": (
            laws.PeriodicLaw,
            "Q = amplitude cos(2 pi frequency t + phase) + offset",
            (
                linear("amplitude", 0.0),
                Parameter("frequency", "Hz", 0.02, 5.0, None, role=Role.FREQUENCY),
                Parameter("phase", "rad", -math.pi, math.pi, None, role=Role.PHASE),
                linear("offset", -most),
            ),
        ),
        "push": (
            laws.PulseLaw,
            f"Q = {size} for start <= t < end",
            (
                Parameter("start", "s", 0.0, 20.0, None, role=Role.START),
                Parameter("end", "s", 0.0, 20.0, None, role=Role.END),
                linear(size, -most),
            ),
        ),
    }


def _dry_friction(size: str, most: float, unit: str, velocity: Variable) -> _Laws:
    v, fastest = velocity.name, velocity.largest

    def friction(*names: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, unit, 0.0, most, 0.0) for name in names)

    return {
        "coulomb_friction": (
            laws.CoulombLaw,
            f"Q = -{size} sign({v}); at rest, what holds the joint, up to {size}",
            friction(size),
        ),
        "stribeck_friction": (
            laws.StribeckLaw,
            f"Q = -({size} + max(breakaway - {size}, 0) exp(-({v} / velocity)^2)) sign({v}); at rest, up to breakaway",
            (*friction(size, "breakaway"), Parameter("velocity", velocity.unit, fastest / 500, fastest / 5, None)),
        ),
        "directional_friction": (
            laws.DirectionalLaw,
            f"Q = -forward where {v} > 0, backward where {v} < 0; at rest, what holds the joint, up to these",
            friction("forward", "backward"),
        ),
        "load_dependent_friction": (
            laws.LoadDependentLaw,
            f"Q = -share |motor {size}| sign({v}); at rest, what holds the joint, up to share |motor {size}|",
            (Parameter("share", "1", 0.0, 0.8, 0.0),),
        ),
    }


def on_parameters(system: type[System]) -> Iterator[Made]:
    """A factor on each positive parameter but gravity."""
    for field in scalable(system()):
        low, high = (_accepted(system, field, factor) for factor in (0.2, 5.0))
        yield (
            f"{field}.scale",
            ParameterScale,
            {
                "__doc__": f"A machine whose {field} differs from the source's.",
                "equation": f"{field} = scale {field}_source",
                "source": f"the parameters of {system.name}",
                "table": (Parameter("scale", "1", low, high, 1.0),),
                "scaled": {"scale": field},
            },
        )


def _accepted(system: type[System], field: str, factor: float) -> float:
    """The factor on a parameter nearest to `factor` that the class takes beside its other parameters, to 1 %."""
    own: Any = system()

    def taken(one: float) -> bool:
        try:
            replace(own, **{field: one * getattr(own, field)})
        except ValueError:
            return False
        return True

    if taken(factor):
        return factor
    inner, outer = 1.0, factor
    while abs(math.log(outer / inner)) > 0.01:
        middle = math.sqrt(inner * outer)
        inner, outer = (middle, outer) if taken(middle) else (inner, middle)
    return inner


def scalable(system: System) -> list[str]:
    """The positive parameters but gravity."""
    return [name for name, value in parameters(system) if name != "gravity" and value > 0]

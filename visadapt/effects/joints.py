"""The effects of a system of one's own: those that make sense on any mechanism, joint by joint.

From what the class states of its states, actions, loads and coordinates, and from its fields, which are parameters,
this makes one effect for each joint, action, sensor and parameter and each kind. `shoulder.viscous_friction` is that
of the joint with the load `shoulder`. Units and ranges searched follow from those that the class states.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import fields, make_dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from visadapt.effects import actuation, laws, sensing
from visadapt.effects.base import EFFECTS, ActuationEffect, Effect, Parameter, Role
from visadapt.effects.parameters import ParameterScale
from visadapt.systems import SYSTEMS, System, Variable
from visadapt.systems.contract import equal, inputs
from visadapt.systems.integrators import Duration
from visadapt.systems.rigid_body import beside

ALL_COMMANDS, ALL_SENSORS = "commands", "sensors"
"""Before the dot in the name of an effect on all commands, or on all readings."""


def is_own(system: type[System]) -> bool:
    """Whether a system is the user's own: neither one of the library's nor derived from one of these."""
    return not issubclass(system, tuple(SYSTEMS.values()))


def own_effects(system: type[System]) -> list[type[Effect]]:
    """The effects of a system of one's own; they are then found by name in `EFFECTS`.

    >>> import visadapt as va
    >>> from tests.worlds import Mass
    >>> [effect.name for effect in own_effects(Mass)][:2]
    ['commands.actuator_delay', 'command.actuator_backlash']
    """
    made = _made(system)
    EFFECTS.update({effect.name: effect for effect in made})
    return list(made)


@cache
def _made(system: type[System]) -> tuple[type[Effect], ...]:
    every = (*_actuation(system), *_dynamics(system), *_parameters(system), *_sensing(system))
    alike: dict[str, tuple[str, ...]] = {}
    for one, other in _alike(system()):
        alike[one] = (*alike.get(one, ()), other)
        alike[other] = (*alike.get(other, ()), one)
    return tuple(_named(system, *each, alike.get(each[0], ())) for each in every)


def _alike(system: System) -> Iterator[tuple[str, str]]:
    """Pairs of effects that are the same, by name: they change every rate alike, with some other value."""
    state, command, load = inputs(system)
    rest = torch.zeros_like(load)
    free = system.derivative(state, command, rest)
    for a, action in enumerate(system.actions):
        unit = torch.eye(command.shape[1]).double()[a]
        by_command = system.derivative(state, command + unit, rest) - free
        for k, joint in enumerate(system.loads):
            by_load = system.derivative(state, command, rest + torch.eye(load.shape[1]).double()[k]) - free
            if bool(by_command.any()) and equal(
                by_load * (by_command * by_load).sum() / by_load.square().sum(), by_command
            ):
                yield f"{action.name}.actuator_bias", f"{joint.name}.constant_load"
        stronger = system.derivative(state, command * (1 + unit), rest)
        for field in _scalable(system):
            for factor in (2.0, 0.5):
                scaled: Any = replace(system, **{field: factor * getattr(system, field)})  # type: ignore[type-var]
                if equal(scaled.derivative(state, command, rest), stronger):
                    yield f"{action.name}.actuator_gain", f"{field}.scale"


Made = tuple[str, type[Effect], dict[str, Any]]
"""An effect's name, the class it derives from, and its attributes."""


def _named(
    system: type[System], name: str, base: type[Effect], attributes: dict[str, Any], alike: tuple[str, ...]
) -> type[Effect]:
    # The effects of two systems may have the same name: the later ones then take it.
    own = {"__module__": system.__module__, "__qualname__": name, "name": name, "systems": (system,)}
    settled = {other: _MOTOR_OFF for other in alike if other.endswith(".constant_load")}
    return type(name, (base,), {"indistinguishable_from": alike, "settled_by": settled, **own, **attributes})


_MOTOR_OFF = (
    "switch the motor off and measure the load on the joint with a balance: a constant load is still there, an "
    "actuator's bias is gone"
)


def largest(variable: Variable) -> float:
    """The largest size in a variable's range."""
    return max(abs(variable.low), abs(variable.high))


def _per(load: Variable, variable: Variable, power: int = 1) -> str:
    """The unit of a load over a position, or over a power of a velocity."""
    unit, _, over = variable.unit.partition("/")
    times = f" {over}{power if power > 1 else ''}" if over else ""
    return f"{load.unit}{times}/{unit}{power if power > 1 else ''}"


def _dynamics(system: type[System]) -> Iterator[Made]:
    for joint, (load, (position, velocity)) in enumerate(zip(system.loads, system.coordinates, strict=True)):
        kinds = _laws(load, system.states[position], system.states[velocity])
        for kind, (law, equation, table) in kinds.items():
            yield f"{load.name}.{kind}", law, {"joint": joint, "equation": equation, "table": table}
        most = 5 * _inertia_of(system(), joint)
        unit = {"N": "kg", "N m": "kg m2"}.get(load.unit, _per(load, system.states[velocity]))
        yield (
            f"{load.name}.added_inertia",
            AddedInertia,
            {
                "joint": joint,
                "equation": f"Q = -inertia d({system.states[velocity].name})/dt",
                "table": (Parameter("inertia", unit, 0.0, most, 0.0),),
            },
        )


def _laws(
    load: Variable, position: Variable, velocity: Variable
) -> dict[str, tuple[type[laws.JointEffect], str, tuple[Parameter, ...]]]:
    most, fastest, farthest = (largest(variable) for variable in (load, velocity, position))
    size = "torque" if load.unit == "N m" else "force"
    q, v, unit = position.name, velocity.name, load.unit

    def linear(name: str, low: float, unit: str = unit, high: float = most) -> Parameter:
        return Parameter(name, unit, low, high, 0.0, linear=True)

    def friction(*names: str) -> tuple[Parameter, ...]:
        return tuple(Parameter(name, unit, 0.0, most, 0.0) for name in names)

    # A coefficient is searched up to where a third of the range of motion takes the largest load.
    per_velocity, per_position = 3 * most / fastest, 3 * most / farthest
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
        "coulomb_friction": (
            laws.CoulombLaw,
            f"Q = -{size} sign({v}); at rest, what holds the joint, up to {size}",
            friction(size),
        ),
        "stribeck_friction": (
            laws.StribeckLaw,
            f"Q = -({size} + (breakaway - {size}) exp(-({v} / velocity)^2)) sign({v}); at rest, up to breakaway",
            (*friction(size, "breakaway"), Parameter("velocity", velocity.unit, fastest / 500, fastest / 5, None)),
        ),
        "directional_friction": (
            laws.DirectionalLaw,
            f"Q = -forward where {v} > 0, backward where {v} < 0; at rest, what holds the joint, up to these",
            friction("forward", "backward"),
        ),
        "spring": (
            laws.SpringLaw,
            f"Q = -stiffness ({q} - rest)",
            (
                linear("stiffness", 0.0, _per(load, position), per_position),
                Parameter("rest", position.unit, position.low, position.high, None),
            ),
        ),
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


class AddedInertia(laws.JointEffect):
    """A body fixed to the joint that adds inertia and no weight, such as a flywheel or a rotor behind a gear."""

    source = "Newton's second law"

    def alter(self, system: System) -> System:
        values = {f"{_ADDED}{self.joint}": getattr(self, self.table[0].name)}
        if isinstance(system, Inertial):
            return replace(system, **values)  # type: ignore[type-var]  # a dataclass
        kept = {field.name: getattr(system, field.name) for field in fields(system)}  # type: ignore[arg-type]
        altered: System = _inertial(type(system))(**kept, **values)
        return altered


_ADDED = "added_inertia_"  # ... and the joint: fields of systems with added inertia


class Inertial(System):
    """A system of one's own with inertia added to its joints: exact, since accelerations are linear in the loads."""

    def check_parameters(self, either_sign: Collection[str] = (), may_be_zero: Collection[str] = ()) -> None:
        added = [f"{_ADDED}{joint}" for joint in range(len(self.loads))]
        super().check_parameters(either_sign, (*may_be_zero, *added))

    def derivative(self, state: Tensor, command: Tensor, load: Tensor) -> Tensor:
        free = super().derivative(state, command, load)  # type: ignore[safe-super]
        inertia = [getattr(self, f"{_ADDED}{joint}") for joint in range(len(self.loads))]
        joints = [joint for joint, value in enumerate(inertia) if isinstance(value, Tensor) or value]
        own = [self.coordinates[joint][1] for joint in joints]
        units = load[None] + torch.eye(load.shape[1]).to(load)[joints, None]
        gain = torch.stack([super(Inertial, self).derivative(state, command, unit) - free for unit in units], -1)  # type: ignore[safe-super]
        added = beside([inertia[joint] for joint in joints], load)
        # The added inertia's reaction to the joints' accelerations, which it changes: a = free + gain (-inertia a).
        matrix = torch.eye(len(joints)).to(load) + gain[:, own] * added[..., None, :]
        acceleration = torch.linalg.solve(matrix, free[:, own])
        return free - (gain @ (added * acceleration)[..., None])[..., 0]


@cache
def _inertial(system: type[System]) -> type[Any]:
    added = [(f"{_ADDED}{joint}", Any, 0.0) for joint in range(len(system.loads))]
    return make_dataclass(system.__name__, added, bases=(Inertial, system), frozen=True)


def _inertia_of(system: System, joint: int) -> float:
    """The joint's own inertia in the middle of the states' ranges."""
    state, command, load = (
        torch.tensor([[(one.low + one.high) / 2 for one in variables]], dtype=torch.float64)
        for variables in (system.states, system.actions, system.loads)
    )
    unit = torch.eye(load.shape[1], dtype=torch.float64)[joint, None]
    gain = system.derivative(state, command, load + unit) - system.derivative(state, command, load)
    return 1 / float(gain[0, system.coordinates[joint][1]])


def _parameters(system: type[System]) -> Iterator[Made]:
    for field in _scalable(system()):
        yield (
            f"{field}.scale",
            ParameterScale,
            {
                "__doc__": f"A machine whose {field} differs from the source's.",
                "equation": f"{field} = scale {field}_source",
                "source": f"the parameters of {system.name}",
                "table": (Parameter("scale", "1", 0.2, 5.0, 1.0),),
                "scaled": {"scale": field},
            },
        )


def _scalable(system: System) -> list[str]:
    """The positive parameters but gravity."""
    names = [field.name for field in fields(system)]  # type: ignore[arg-type]  # subclasses are dataclasses
    return [name for name in names if name != "gravity" and getattr(system, name) > 0]


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


def _actuation(system: type[System]) -> Iterator[Made]:
    delays = {"indistinguishable_from": (f"{ALL_SENSORS}.measurement_delay",)}
    settled = {f"{ALL_SENSORS}.measurement_delay": actuation.ActuatorDelay.settled_by["measurement_delay"]}
    alone = len(system.actions) == 1
    if not alone:
        yield f"{ALL_COMMANDS}.actuator_delay", actuation.ActuatorDelay, {**delays, "settled_by": settled}
    for index, action in enumerate(system.actions):
        most = largest(action)
        for base in (
            actuation.ActuatorDelay,
            actuation.ActuatorBacklash,
            actuation.ActuatorDeadzone,
            actuation.ActuatorSaturation,
            actuation.ActuatorGain,
            actuation.ActuatorBias,
            actuation.ActuatorLag,
        ):
            table = tuple(_in_units_of(parameter, action, most) for parameter in base.table)
            says = _SAYS.get(base, (base.__doc__ or "").partition("\n\n")[0])
            attributes = {"table": table, "action": index, "__doc__": says}
            if alone and base is actuation.ActuatorDelay:
                attributes |= {**delays, "settled_by": settled}
            kind = type(base.__name__, (OneCommand, base), {})
            yield f"{action.name}.{base.name}", kind, attributes


_SAYS: dict[type[Effect], str] = {
    actuation.ActuatorSaturation: "A limit on the command that the motor follows, of its supply or its current.",
    actuation.ActuatorBias: "A constant added to every command.",
}
"""What an effect does, where the library's words are of a cart-pole."""


def _in_units_of(parameter: Parameter, action: Variable, most: float) -> Parameter:
    """A parameter in units of the command, in those of an action; a scale and a time stay as they are."""
    if parameter.unit != "1" or parameter.name == "scale":
        return parameter
    neutral = None if parameter.neutral is None else parameter.neutral * most
    return Parameter(
        parameter.name,
        action.unit,
        parameter.low * most,
        parameter.high * most,
        neutral,
        parameter.linear,
        parameter.role,
    )


def _sensing(system: type[System]) -> Iterator[Made]:
    rates = dict(system.coordinates)
    delayed = f"{ALL_COMMANDS}.actuator_delay"
    if len(system.actions) == 1:
        delayed = f"{system.actions[0].name}.actuator_delay"
    yield (
        f"{ALL_SENSORS}.measurement_delay",
        sensing.MeasurementDelay,
        {
            "positions": list(rates),
            "velocities": list(rates.values()),
            "indistinguishable_from": (delayed,),
        },
    )
    for column, state in enumerate(system.states):
        name, unit = state.name, state.unit
        most = 0.2 * largest(state)
        yield (
            f"{name}.sensor_offset",
            sensing.SensorOffset,
            {
                "__doc__": f"A sensor of {name} whose zero is off.",
                "equation": f"{name} measured = {name} + offset",
                "table": (Parameter("offset", unit, -most, most, 0.0, linear=True),),
                "sensor": column,
            },
        )
        if column in rates.values():
            continue
        scaled = [column, rates[column]] if column in rates else [column]
        both = ", ".join(system.states[one].name for one in scaled)
        yield (
            f"{name}.sensor_scale",
            sensing.SensorGain,
            {
                "equation": f"({both}) measured = scale ({both})",
                "table": (Parameter("scale", "1", 0.5, 2.0, 1.0, linear=True),),
                "columns": scaled,
            },
        )

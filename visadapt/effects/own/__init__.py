"""The effects of a system of one's own: those that make sense on any mechanism, joint by joint.

They are made from the states, actions, loads and coordinates that the class states, and from its fields, which are its
parameters: one effect of each kind for each joint, action, sensor and parameter. `shoulder.viscous_friction` is that of
the joint with the load `shoulder`. Units and searched ranges follow from those that the class states.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import Any

import torch

from visadapt.effects.base import EFFECTS, Effect, Parameter
from visadapt.effects.own.added_inertia import inertia_of
from visadapt.effects.own.commands import on_commands
from visadapt.effects.own.drift import on_states
from visadapt.effects.own.dynamics import on_joints, on_parameters, scalable
from visadapt.effects.own.extended import with_inertia
from visadapt.effects.own.sensors import on_sensors
from visadapt.systems import SYSTEMS, System
from visadapt.systems.contract import equal, inputs
from visadapt.systems.rigid_body import RigidBody


def is_own(system: type[System]) -> bool:
    """Whether a system is a mechanism of the user's own: no rigid body, no other system of the library, and not derived
    from one of these."""
    return not issubclass(system, (RigidBody, *SYSTEMS.values()))


def own_effects(system: type[System]) -> list[type[Effect]]:
    """The effects of a system of one's own; they are then found by name in `EFFECTS`."""
    made = _made(system)
    _GENERATED.update(made)
    EFFECTS.update({effect.name: effect for effect in made})
    return list(made)


def is_generated(effect: type[Effect]) -> bool:
    """Whether `own_effects` made it for some system: systems derived from that one have effects of their own."""
    return effect in _GENERATED


_GENERATED: set[type[Effect]] = set()


@cache
def _made(system: type[System]) -> tuple[type[Effect], ...]:
    example = system()
    makers = on_commands, on_joints, on_states, on_parameters, on_sensors
    every = [one for maker in makers for one in maker(system)]
    alike, by_measuring = list(_alike(example)), [*_imitating(example), *_in_ratio(example)]
    either_way = [*alike, *((other, one) for one, other in alike)]
    return tuple(_named(system, *each, _others(each[0], either_way), _others(each[0], by_measuring)) for each in every)


def _others(name: str, pairs: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """The second ones of the pairs of which `name` is the first."""
    return tuple(other for one, other in pairs if one == name)


def _alike(system: System) -> Iterator[tuple[str, str]]:
    """Pairs of names of equivalent effects: with suitable values both change every derivative alike."""
    state, command, load = inputs(system)
    rest = torch.zeros_like(load)
    free, by_loads = system.rates_per_load(state, command, rest, range(load.shape[1]))
    for a, action in enumerate(system.actions):
        unit = torch.eye(command.shape[1]).double()[a]
        by_command = system.derivative(state, command + unit, rest) - free
        for joint, by_load in zip(system.loads, by_loads, strict=True):
            if bool(by_command.any()) and equal(
                by_load * (by_command * by_load).sum() / by_load.square().sum(), by_command
            ):
                yield f"{action.name}.actuator_bias", f"{joint.name}.constant_load"
        for column in system.outside_joints():
            moved = torch.eye(state.shape[1]).double()[column]
            if bool(by_command.any()) and equal(by_command[0] * moved, by_command):
                yield f"{action.name}.actuator_bias", f"{system.states[column].name}.drift"
        stronger = system.derivative(state, command * (1 + unit), rest)
        for field in scalable(system):
            for factor in (2.0, 0.5):
                scaled = _scaled(system, field, factor)
                if scaled is not None and equal(scaled.derivative(state, command, rest), stronger):
                    yield f"{action.name}.actuator_gain", f"{field}.scale"


def _imitating(system: System) -> Iterator[tuple[str, str]]:
    """Pairs of effects of which the first, scaling a parameter by more than 1, does what the second does: added inertia
    or viscous friction. They are not equivalent: a parameter may be smaller too, these are not negative."""
    state, command, load = inputs(system)
    free, by_loads = system.rates_per_load(state, command, load, range(load.shape[1]))
    for field in scalable(system):
        scaled = _scaled(system, field, 2.0)
        if scaled is None:
            continue
        rates = scaled.derivative(state, command, load)
        for joint, (one, by_load) in enumerate(zip(system.loads, by_loads, strict=True)):
            added = inertia_of(scaled, joint) - inertia_of(system, joint)
            if added > 0 and equal(with_inertia(system, joint, added).derivative(state, command, load), rates):
                yield f"{field}.scale", f"{one.name}.added_inertia"
            damped = -by_load * state[:, system.coordinates[joint][1], None]
            size = float((damped * (rates - free)).sum() / damped.square().sum())
            if size > 0 and equal(free + size * damped, rates):
                yield f"{field}.scale", f"{one.name}.viscous_friction"


def _in_ratio(system: System) -> Iterator[tuple[str, str]]:
    """Pairs of parameters of which only the ratio, or the product, acts, unless there are loads."""
    state, command, load = inputs(system)
    fields, rest = scalable(system), torch.zeros_like(load)
    free = system.derivative(state, command, rest)
    rates = {
        (field, factor): scaled.derivative(state, command, rest)
        for field in fields
        for factor in (2.0, 0.5)
        if (scaled := _scaled(system, field, factor)) is not None
    }
    for one, other in combinations(fields, 2):
        doubled = rates.get((one, 2.0))
        if doubled is None or equal(doubled, free):
            continue
        if any(equal(rates[other, factor], doubled) for factor in (2.0, 0.5) if (other, factor) in rates):
            yield f"{one}.scale", f"{other}.scale"


def _scaled(system: System, field: str, factor: float) -> System | None:
    """The system with a factor on a parameter; None where it has no such value beside the others."""
    itself: Any = system
    try:
        scaled: System = replace(itself, **{field: factor * getattr(system, field)})
    except ValueError:
        return None
    return scaled


def _in_time(parameter: Parameter, system: type[System]) -> Parameter:
    """A parameter whose range, if it is a time or a frequency, is that for the prediction time of a system."""
    slower = system.prediction_time / System.prediction_time
    factor = {"s": slower, "Hz": 1 / slower}.get(parameter.unit, 1.0)
    return replace(parameter, low=factor * parameter.low, high=factor * parameter.high)


def _named(
    system: type[System],
    name: str,
    base: type[Effect],
    attributes: dict[str, Any],
    alike: tuple[str, ...],
    by_measuring: tuple[str, ...],
) -> type[Effect]:
    # Where effects of two systems have the same name, the later ones replace the earlier in `EFFECTS`.
    own = {"__module__": system.__module__, "__qualname__": name, "name": name, "systems": (system,)}
    attributes = {**attributes, "table": tuple(_in_time(p, system) for p in attributes.get("table", base.table))}
    settled = {other: _MOTOR_OFF for other in alike if other.endswith(".constant_load")}
    settled |= {other: _COMMANDS_OFF for other in alike if other.endswith(".drift")}
    settled |= {other: _measured(other, "an actuator's gain") for other in alike if other.endswith(".scale")}
    settled |= {other: _measured(name, _other_cause(other)) for other in by_measuring}
    joint, _, kind = name.partition(".")
    if (alone := EFFECTS.get(kind)) is not None:  # what settles the library's own effects of the kind settles these
        settled |= {f"{joint}.{other}": text for other, text in alone.settled_by.items()}
    return type(name, (base,), {"indistinguishable_from": alike, "settled_by": settled, **own, **attributes})


def _other_cause(name: str) -> str:
    """An effect in words: "another mass", "viscous friction of shoulder"."""
    joint, _, kind = name.partition(".")
    if kind == "scale":
        return f"another {joint}"
    return f"{kind.replace('_', ' ')} of {joint}"


def _measured(scale: str, other: str) -> str:
    field = scale.removesuffix(".scale")
    return f"no motion tells another {field} from {other}: measure {field} by itself"


_COMMANDS_OFF = "switch the actuator off: a drift is still there, an actuator's bias is gone"

_MOTOR_OFF = (
    "switch the motor off and measure the load on the joint with a balance: a constant load is still there, an "
    "actuator's bias is gone"
)

"""What a system must keep to, so that worlds, effects and diagnoses may rely on it: the test of a class."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from dataclasses import fields, replace
from difflib import get_close_matches
from math import inf, isfinite
from typing import Any

import torch
from torch import Tensor

from visadapt.systems import SYSTEMS
from visadapt.systems.base import System, Variable, parameters
from visadapt.systems.rigid_body import RigidBody

ROWS = 5  # States that the derivative is tried in, drawn from the states' ranges
MANY_ROWS = 1000  # States in which only the rates are looked at
TOLERANCE = 1e-4  # Largest error of an automatic derivative, as a share of max(1, the largest)
STEP = 1e-6  # Finite difference, as a share of a variable's range
ROUNDING = 1e-9  # Share by which numbers may differ that ought to be equal
CHANGE = 1.02  # Factor by which a parameter is changed to see whether it acts
SMALLEST = 0.01  # Least value that a state has to reach, in its unit: fits take steps and noises of 1e-6 and more


def complaints(system: type[System]) -> list[str]:
    """What the class of a system lacks or does wrong, a line each; empty where nothing is wrong.

    >>> import visadapt as va
    >>> complaints(va.CartPole)
    []
    """
    for check in (_form, _variables):
        if found := list(check(system)):
            return found
    try:
        example = system()
    except Exception as error:
        return [f"{system.__name__}() raises {error_line(error)}; every field needs a default that its check accepts"]
    try:
        if wrong := list(_shape(example)):
            return wrong
        return [*_gradients(example), *_loads(example), *_coordinates(example), *_batches(example)]
    except Exception as error:
        return [f"derivative raises {error_line(error)}"]


def _form(system: type[System]) -> Iterator[str]:
    itself: Any = system
    made = vars(system).get("__dataclass_params__")
    if made is None or not made.frozen:
        yield f"{system.__name__} is no frozen dataclass: write @dataclass(frozen=True) above it"
        return
    if getattr(system.derivative, "__isabstractmethod__", False):
        yield f"{system.__name__} has no derivative(self, state, command, load)"
    for name in ("name", "states", "actions", "loads"):
        if not hasattr(system, name):
            yield f"{system.__name__} has no {name}: {_EXAMPLES[name]} would be right"
    for field in fields(itself):
        if field.name in ("name", "states", "actions", "loads", "coordinates", "prediction_time"):
            yield f"{field.name} is a field, which is a parameter: write it without an annotation, or as a ClassVar"
    for name in vars(system):
        for meant in get_close_matches(name, OPTIONAL, 1, ALIKE):
            if name != meant:
                yield f"{name} is nothing that visadapt reads; {meant} is: is that meant?"


OPTIONAL = ("coordinates", "prediction_time", "longest_step")  # What a class may state and need not
ALIKE = 0.85  # Similarity of two names, 1 if equal, beyond which one is taken for the other, misspelt

_EXAMPLES = {
    "name": 'name = "my_rig"',
    "states": 'states = (Variable("angle", "rad", -3.0, 3.0), ...)',
    "actions": 'actions = (Variable("torque", "N m", -1.0, 1.0),)',
    "loads": 'loads = (Variable("joint", "N m", -1.0, 1.0),)',
}


def _variables(system: type[System]) -> Iterator[str]:
    if not isinstance(system.name, str) or not system.name.isidentifier():
        yield f"name is {system.name!r}; a word such as {_EXAMPLES['name']} would be right"
    elif system not in SYSTEMS.values() and system.name in SYSTEMS:
        yield f"name is {system.name!r}, a system of visadapt's own; another word would be right"
    seconds = system.prediction_time
    if not isinstance(seconds, int | float) or not 0 < seconds < inf:
        yield f"prediction_time is {seconds!r}; a positive number of s, such as prediction_time = 0.5, would be right"
    names: dict[str, list[Any]] = {}
    for kind in ("states", "actions", "loads"):
        every = getattr(system, kind)
        if not isinstance(every, tuple) or not every:
            yield f"{kind} is {every!r}; a tuple of at least one, {_EXAMPLES[kind]}, would be right"
            continue
        for variable in every:
            if not isinstance(variable, Variable):
                yield f"{kind} holds {variable!r}; {_EXAMPLES[kind]} would be right"
            else:
                yield from _variable(kind, variable)
        own = names[kind] = [getattr(variable, "name", None) for variable in every]
        yield from (f"{kind} has {name!r} twice" for name in dict.fromkeys(own) if own.count(name) > 1)
    for name in names.get("states", ()):
        if name in names.get("actions", ()):
            yield f"{name!r} is a state and an action, which are columns of one file: call one otherwise"


def _variable(kind: str, variable: Variable) -> Iterator[str]:
    name, unit, low, high = variable.name, variable.unit, variable.low, variable.high
    if not isinstance(name, str) or not name.isidentifier() or name in ("time", "episode"):
        yield f"{kind}: the name {name!r} is not a word of its own, such as angle (time and episode are taken)"
    if not isinstance(unit, str) or not unit.strip():
        yield f"{kind}: {name} has no unit; an SI unit such as m, rad/s or N m, or 1 for a number, would be right"
    numbers = isinstance(low, int | float) and isinstance(high, int | float)
    if not numbers or not isfinite(low) or not isfinite(high) or low >= high:
        yield f"{kind}: {name} goes from {low!r} to {high!r}; two finite numbers, the lower first, would be right"
    elif kind == "states" and variable.largest < SMALLEST:
        yield (
            f"{kind}: {name} reaches {variable.largest:g} {unit}; in another unit, such as mm, would be right: fits "
            f"need numbers that reach {SMALLEST:g}"
        )


def inputs(system: System, rows: int = ROWS) -> list[Tensor]:
    """States, commands and loads (rows, ...) drawn from their ranges, in float64."""
    generator = torch.Generator().manual_seed(0)
    out = []
    for variables in (system.states, system.actions, system.loads):
        low, high = torch.tensor([(one.low, one.high) for one in variables], dtype=torch.float64).T
        out.append(low + (high - low) * torch.rand(rows, len(variables), dtype=torch.float64, generator=generator))
    return out


def _shape(system: System) -> Iterator[str]:
    """Complaints of what the derivative returns, after which nothing else can be tried."""
    given = inputs(system)
    called = ", ".join(
        f"{name} {tuple(each.shape)}" for name, each in zip(("state", "command", "load"), given, strict=True)
    )
    try:
        rates = system.derivative(*given)
    except Exception as error:
        yield f"derivative of {called} raises {error_line(error)}"
        return
    right = (len(given[0]), len(system.states))
    if not isinstance(rates, Tensor) or rates.shape != right:
        shape = f"the shape {tuple(rates.shape)}" if isinstance(rates, Tensor) else f"a {type(rates).__name__}"
        yield f"derivative of {called} has {shape}; a tensor {right}, the rate of each state, would be right"
        return
    many = inputs(system, MANY_ROWS)
    for states, found in ((given[0], rates), (many[0], system.derivative(*many))):
        bad = ~found.isfinite()
        if bad.any():
            row, column = bad.nonzero()[0].tolist()
            of, at = system.states[column].name, _at(system, states[row])
            yield f"derivative: the rate of {of} is {found[row, column]} at {at}, within the ranges"
            return
    if rates.dtype != given[0].dtype:
        yield f"derivative turns {given[0].dtype} into {rates.dtype}: make new tensors with state.new_tensor"
    alone = torch.cat([system.derivative(*(each[k : k + 1] for each in given)) for k in range(ROWS)])
    if not equal(rates, alone):
        yield "derivative mixes rows: each row of a batch (B, n) is a machine of its own"


def _gradients(system: System) -> Iterator[str]:
    given = inputs(system)
    with torch.inference_mode(False), torch.enable_grad():
        tracked = [each.clone().requires_grad_() for each in given]
        rates = system.derivative(*tracked)
        if not rates.requires_grad:
            yield (
                "derivative is not differentiable: compute it from the tensors with torch alone, without numpy, item() "
                "or detach()"
            )
            return
        by_column = [torch.autograd.grad(r, tracked, retain_graph=True, allow_unused=True) for r in rates.sum(0)]
        rest = [each.requires_grad_() for each in _at_rest(system)]
        at_zero = system.derivative(*rest).sum()
        slopes = torch.autograd.grad(at_zero, rest, allow_unused=True)
    # The rates of a rigid body are no numbers there: its quaternion is not 0.
    if at_zero.isfinite() and not all(slope is None or slope.isfinite().all() for slope in slopes):
        yield (
            f"derivative is not differentiable at {_at(system, rest[0][0])}, command and load 0: a root, a norm or a "
            "power has no slope at 0; x * abs(x), or sqrt(x**2 + 1e-12), has one"
        )
    for k, (kind, variables) in enumerate(
        (("state", system.states), ("command", system.actions), ("load", system.loads))
    ):
        for column, variable in enumerate(variables):
            step = STEP * (variable.high - variable.low)
            moved = [each.clone() for each in given], [each.clone() for each in given]
            moved[0][k][:, column] -= step
            moved[1][k][:, column] += step
            expected = (system.derivative(*moved[1]) - system.derivative(*moved[0])) / (2 * step)
            found = torch.stack([torch.zeros(ROWS).double() if g[k] is None else g[k][:, column] for g in by_column], 1)
            if float((found - expected).abs().max()) > TOLERANCE * max(1.0, float(expected.abs().max())):
                yield (
                    f"derivative by the {kind} {variable.name} is not what torch differentiates: compute it from the "
                    "tensors with torch alone, without numpy, item(), detach() or rounding"
                )


def _loads(system: System) -> Iterator[str]:
    state, command, load = inputs(system)
    free, whole = system.derivative(state, command, torch.zeros_like(load)), system.derivative(state, command, load)
    if not equal(free + 2 * (whole - free), system.derivative(state, command, 2 * load)):
        yield "derivative is not linear in the load: a load is a force or a torque that adds to the others"


def _coordinates(system: System) -> Iterator[str]:
    if isinstance(system, RigidBody):  # its attitude is no coordinate
        return
    pairs, states, loads = system.coordinates, system.states, system.loads
    right = "a pair (column of the position, column of the velocity) for each load, as in ((0, 1), (2, 3)),"
    no_position = "a velocity that is the rate of no state has the position None"
    if not isinstance(pairs, tuple) or len(pairs) != len(loads):
        yield f"coordinates is {pairs!r}; {right} would be right: there are {len(loads)} loads"
        return
    for pair in pairs:
        columns = range(len(states))
        if not isinstance(pair, tuple) or len(pair) != 2 or pair[0] not in (None, *columns) or pair[1] not in columns:
            yield f"coordinates holds {pair!r}; {right} would be right: there are {len(states)} states"
            return
    state, command, load = inputs(system)
    free = system.derivative(state, command, torch.zeros_like(load))
    for k, (position, velocity) in enumerate(pairs):
        name = states[velocity].name
        if position is not None and not equal(free[:, position], state[:, velocity]):
            of = states[position].name
            yield f"coordinates: {name} is not the rate of {of} that derivative returns; {no_position}"
        unit = torch.zeros_like(load)
        unit[:, k] = 1
        gain = (system.derivative(state, command, unit) - free)[:, velocity]
        if not bool((gain > 0).all()):
            yield f"loads: {loads[k].name} does not accelerate {name}: its coordinates, or its sign, are wrong"


def _batches(system: System) -> Iterator[str]:
    """A parameter may be one for each row: effects scale it, and fits try many values in one batch."""
    given = inputs(system)
    itself: Any = system
    for name, value in parameters(system):
        values = value * torch.linspace(1.0, CHANGE, ROWS, dtype=torch.float64)
        try:
            together = replace(itself, **{name: values}).derivative(*given)
        except Exception as error:
            yield f"{name} as a tensor, one value for each row ({ROWS},), raises {error_line(error)}"
            continue
        if together.shape != given[0].shape:
            yield (
                f"{name} as a tensor, one value for each row ({ROWS},), gives rates {tuple(together.shape)}; "
                f"{tuple(given[0].shape)} are right: take columns by state[:, 0], which has one number for each row too"
            )
            continue
        rows = [
            replace(itself, **{name: float(one)}).derivative(*(each[k : k + 1] for each in given))
            for k, one in enumerate(values)
        ]
        if not equal(together, torch.cat(rows)):
            yield f"{name} as a tensor, one value for each row ({ROWS},), gives other rates than row by row"


def _at_rest(system: System) -> list[Tensor]:
    """State, command and load (1, ...) of 0, or of what is next to 0 in their ranges, in float64."""
    every = (system.states, system.actions, system.loads)
    return [torch.tensor([[min(max(0.0, one.low), one.high) for one in each]], dtype=torch.float64) for each in every]


def _at(system: System, state: Tensor) -> str:
    """A state (n_state,), in words."""
    return ", ".join(f"{of.name} {value:.3g}" for of, value in zip(system.states, state.tolist(), strict=True))


def unused_commands(system: System) -> list[str]:
    """Commands that change no rate, in states drawn from the ranges.

    >>> import visadapt as va
    >>> unused_commands(va.CartPole())
    []
    """
    state, command, load = inputs(system, MANY_ROWS)
    rates = system.derivative(state, command, load)
    return [
        action.name
        for action, unit in zip(system.actions, torch.eye(command.shape[1]).to(command), strict=True)
        if torch.equal(rates, system.derivative(state, command + (CHANGE - 1) * action.largest * unit, load))
    ]


def unused_parameters(system: System) -> list[str]:
    """Parameters that change no rate, in states drawn from the ranges.

    >>> import visadapt as va
    >>> unused_parameters(va.CartPole())
    []
    """
    given = inputs(system, MANY_ROWS)
    itself: Any = system
    rates = system.derivative(*given)
    return [
        name
        for name, value in parameters(system)
        if torch.equal(rates, replace(itself, **{name: CHANGE * value}).derivative(*given))
    ]


def equal(one: Tensor, other: Tensor) -> bool:
    """Whether rates are the same up to rounding."""
    return torch.allclose(one, other, rtol=ROUNDING, atol=ROUNDING * float(other.abs().max()))


def error_line(error: Exception) -> str:
    """An exception in one line, with the line of the file that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "/torch/" not in frame.filename and frame.filename != __file__]
    where = f" ({own[-1].filename}, line {own[-1].lineno})" if own else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}{where}"

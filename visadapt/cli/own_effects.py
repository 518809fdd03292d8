"""What an effect must keep to, so that worlds and diagnoses may rely on it: the test of a class of the user's own."""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import isfinite

import torch
from torch import Tensor

from visadapt.effects.base import ActuationEffect, DynamicsEffect, Effect, Parameter, SensingEffect
from visadapt.systems import System
from visadapt.systems.contract import ROWS, error_line, inputs
from visadapt.world import World

STAGES = (ActuationEffect, DynamicsEffect, SensingEffect)

PERIOD = 0.05  # s between the commands and readings with which an effect is tried


def effect_complaints(effect: type[Effect], system: System) -> list[str]:
    """What the class of an effect lacks or does wrong on a system that it acts on, a line each.

    >>> import visadapt as va
    >>> effect_complaints(va.effects.ViscousFriction, va.CartPole())
    []
    """
    if wrong := [*_form(effect), *_table(effect)]:
        return wrong
    try:
        return list(_tried(effect, system))
    except Exception as error:
        return [f"raises {error_line(error)}"]


def _form(effect: type[Effect]) -> Iterator[str]:
    if not issubclass(effect, STAGES):
        yield f"acts nowhere: derive it from {', '.join(stage.__name__ for stage in STAGES[:2])} or SensingEffect"
    if not isinstance(effect.name, str) or not re.fullmatch(r"[A-Za-z]\w*(\.\w+)*", effect.name, re.ASCII):
        yield f"name is {effect.name!r}; a word such as magnet_force is right"
    for name in ("equation", "source"):
        if not isinstance(found := getattr(effect, name, None), str) or not found.strip():
            yield f"has no {name}: a line that the catalogue shows is right"


def _table(effect: type[Effect]) -> Iterator[str]:
    table = effect.table
    right = 'table = (Parameter("strength", "N", 0.0, 5.0, neutral=0.0),) would be right'
    if not isinstance(table, tuple) or not table or not all(isinstance(each, Parameter) for each in table):
        yield f"table is {table!r:.80}; {right}"
        return
    names = [each.name for each in table]
    yield from (f"table has {name!r} twice" for name in dict.fromkeys(names) if names.count(name) > 1)
    for each in table:
        if not isfinite(each.low) or not isfinite(each.high) or each.low >= each.high:
            yield f"{each.name} goes from {each.low} to {each.high}; two finite numbers, the lower first, are right"
        elif each.neutral is not None and not each.low <= each.neutral <= each.high:
            yield f"{each.name} is neutral at {each.neutral}; a value from {each.low} to {each.high} is right"


def _tried(effect: type[Effect], system: System) -> Iterator[str]:
    """Complaints of what it does in states and under commands drawn from their ranges, with values from its ranges."""
    state, command, _ = inputs(system)
    shares = torch.linspace(0.3, 0.7, ROWS, dtype=torch.float64)
    values = torch.stack([each.low + (each.high - each.low) * shares for each in effect.table], 1)
    made = effect(**{each.name: 0.5 * (each.low + each.high) for each in effect.table}).with_values(values)
    method, shape, returned = "apply_to", tuple(state.shape), object()
    if isinstance(made, DynamicsEffect):
        method, shape, returned = "load", (ROWS, len(system.loads)), made.load(shares, state, made.alter(system))
    elif isinstance(made, ActuationEffect):
        commands = command[:, None].expand(-1, 3, -1)
        bound, shape = made.acting_on(system), tuple(commands.shape)
        returned = bound.apply_to(commands, bound.memory(commands[:, :1], PERIOD), PERIOD)[0]
    elif isinstance(made, SensingEffect):
        returned = made.apply_to(state, made.memory(state, PERIOD), PERIOD, torch.Generator().manual_seed(0))[0]
    if not isinstance(returned, Tensor) or returned.shape != shape:
        kind = f"the shape {tuple(returned.shape)}" if isinstance(returned, Tensor) else f"a {type(returned).__name__}"
        yield f"{method} returns {kind}; a tensor {shape} is right"
    elif returned.dtype != state.dtype:
        yield f"{method} turns {state.dtype} into {returned.dtype}: make new tensors with state.new_tensor"
    elif not bool(returned.isfinite().all()):
        yield f"{method} gives a number that is not finite in states within the ranges"
    else:
        world = World(system, [made])
        after = world.measure(world.step(world.start(state), command), torch.Generator().manual_seed(0))[0]
        if not bool(after.isfinite().all()):
            yield "a step with it gives a state that is not finite, from states within the ranges"

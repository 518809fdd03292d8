"""The catalogue of effects: which act on a system, which of them data cannot tell apart, and its text."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import replace

from visadapt.effects.base import (
    EFFECTS,
    ActuationEffect,
    DynamicsEffect,
    Effect,
    Parameter,
    SensingEffect,
    with_table,
)
from visadapt.effects.camera import CameraEffect
from visadapt.effects.own import is_generated, is_own, own_effects
from visadapt.systems import SYSTEMS, System


def catalogue(system: System | None = None) -> list[type[Effect]]:
    """The named effects on commands, dynamics, readings and frames that act on a system; without one, all of them.

    On a system of one's own the library's effects act joint by joint, command by command and sensor by sensor.

    >>> import visadapt as va
    >>> "viscous_friction" in [effect.name for effect in va.catalogue(va.CartPole())]
    True
    """
    stages = (ActuationEffect, DynamicsEffect, SensingEffect, CameraEffect)
    named: list[type[Effect]] = [effect for effect in EFFECTS.values() if issubclass(effect, stages)]
    if system is None:
        return named
    own = own_effects(type(system)) if is_own(type(system)) else []
    on_all = [effect for effect in named if isinstance(system, effect.systems) and not is_generated(effect)]
    on_all = [effect for effect in on_all if not any(issubclass(one, effect) for one in own)]
    return own + [sized(effect, system) for effect in on_all]


def sized(effect: type[Effect], system: System) -> type[Effect]:
    """The effect with ranges of its forces and torques that suit a system larger than the default of its kind.

    >>> import visadapt as va
    >>> from visadapt.effects.catalogue import sized
    >>> sized(va.effects.CoulombFriction, va.CartPole(cart_mass=2.1)).table[0].high
    30.0
    """
    if EFFECTS.get(getattr(effect, "name", "")) is not effect:
        return effect
    scales = [system.load_scale(parameter.unit) for parameter in effect.table]
    table = [replace(p, low=scale * p.low, high=scale * p.high) for p, scale in zip(effect.table, scales, strict=True)]
    return with_table(effect.name, tuple(table))


def separable(one: type[Effect], other: type[Effect], system: System) -> bool:
    """Whether passive data of this system separate two effects that those of other systems do not."""
    return other.name in one.indistinguishable_from and isinstance(system, (*one.separable_on, *other.separable_on))


def twins(effect: type[Effect], effects: Iterable[type[Effect]], system: System) -> list[type[Effect]]:
    """Those among `effects` that passive data of the system cannot separate from this one."""
    return [
        other
        for other in effects
        if other.name in effect.indistinguishable_from and not separable(effect, other, system)
    ]


def catalogue_text(system: System | None = None) -> str:
    """The catalogue for a terminal: a paragraph per effect, in the order of the chain."""
    return "\n\n".join("\n".join(_lines(effect, system)) for effect in _sorted(system))


def catalogue_markdown() -> str:
    """The library's own effects in Markdown: a section per stage, a subsection per effect, a table of parameters."""
    lines: list[str] = []
    stage = None
    for effect in _sorted(None):
        if not effect.__module__.startswith("visadapt."):
            continue
        if effect.stage is not stage:
            stage = effect.stage
            lines += [f"## {stage.value.capitalize()}", ""]
        lines += [f"### {effect.name}", "", _summary(effect), "", f"    {effect.equation}", ""]
        lines += ["| parameter | unit | range searched | no effect at |", "|---|---|---|---|"]
        for parameter in effect.table:
            low, high, neutral = _numbers(parameter)
            lines.append(f"| {parameter.name} | {parameter.unit} | {low} to {high} | {neutral} |")
        lines += ["", *(f"- {name}: {value}" for name, value in _facts(effect).items()), ""]
    return "\n".join(lines).rstrip()


def _sorted(system: System | None) -> list[type[Effect]]:
    stages = ("actuation", "dynamics", "sensing", "camera")
    return sorted(catalogue(system), key=lambda effect: (stages.index(effect.stage), effect.order, effect.name))


def _lines(effect: type[Effect], system: System | None) -> list[str]:
    lines = [f"{effect.name} ({effect.stage})", f"  {_summary(effect)}", f"  {effect.equation}"]
    for parameter in effect.table:
        low, high, neutral = _numbers(parameter)
        off = f", no effect at {neutral}" if neutral else ""
        unit = "" if parameter.unit == "1" else f" {parameter.unit}"
        lines.append(f"  {parameter.name}: {low} to {high}{unit}{off}")
    facts = _facts(effect)
    if system is not None and is_own(type(system)):
        del facts["systems"]  # which the library's effects on every system do not name
    return [*lines, *(f"  {name}: {value}" for name, value in facts.items())]


def _summary(effect: type[Effect]) -> str:
    """The first paragraph of its docstring."""
    return " ".join((inspect.getdoc(effect) or "").split("\n\n")[0].split())


def _numbers(parameter: Parameter) -> tuple[str, str, str]:
    """Range and neutral value; empty where there is none."""
    return (
        f"{parameter.low:.4g}",
        f"{parameter.high:.4g}",
        "" if parameter.neutral is None else f"{parameter.neutral:g}",
    )


def _facts(effect: type[Effect]) -> dict[str, str]:
    facts = {"systems": _names(effect.systems)}
    if effect.indistinguishable_from:
        others = [EFFECTS[name] for name in effect.indistinguishable_from]
        apart = tuple(kind for each in (effect, *others) for kind in each.separable_on)
        but = f" (separable on {_names(apart)})" if apart else ""
        facts["indistinguishable from"] = ", ".join(effect.indistinguishable_from) + but
    return facts | {"source": effect.source}


def _names(kinds: tuple[type[System], ...]) -> str:
    return ", ".join([kind.name for kind in SYSTEMS.values() if issubclass(kind, kinds)] or [k.name for k in kinds])

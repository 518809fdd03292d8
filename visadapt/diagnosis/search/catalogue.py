"""Which effects a diagnosis looks for, and which of them are one and the same to passive data."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from visadapt.effects import EFFECTS, ActuationEffect, Dropout, DynamicsEffect, Effect, FrozenZone, SensingEffect
from visadapt.estimation.profiles import SystemProfile
from visadapt.systems import System

HOLDING: tuple[type[Effect], ...] = (Dropout, FrozenZone)
"""Effects that are read off repeated readings, before anything is fitted."""


def catalogue(system: System) -> list[type[Effect]]:
    """All named effects that act on the system, at the stages of a simulator without a camera."""
    stages = (ActuationEffect, DynamicsEffect, SensingEffect)
    return [e for e in EFFECTS.values() if issubclass(e, stages) and isinstance(system, e.systems)]


def searched(effects: Iterable[type[Effect]], profile: SystemProfile) -> list[type[Effect]]:
    """Those that are fitted: the first of each group of twins, and no sensor that remembers."""
    out: list[type[Effect]] = []
    for effect in effects:
        twin = bool(twins(effect, out, profile))
        if not twin and effect not in HOLDING and not _remembers(effect):
            out.append(effect)
    return out


def twins(effect: type[Effect], effects: Iterable[type[Effect]], profile: SystemProfile) -> list[type[Effect]]:
    """Effects among `effects` that passive data cannot tell from this one."""
    return [
        other
        for other in effects
        if other.name in effect.indistinguishable_from and frozenset({other.name, effect.name}) not in profile.separable
    ]


def _remembers(effect: type[Effect]) -> bool:
    if not issubclass(effect, SensingEffect):
        return False
    nothing = effect(**{p.name: p.low if p.neutral is None else p.neutral for p in effect.table})
    return nothing.memory(torch.zeros(1, 4), 1.0).numel() > 0

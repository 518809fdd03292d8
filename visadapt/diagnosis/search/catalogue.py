"""Which effects a diagnosis fits."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from visadapt.effects import Effect, SensingEffect
from visadapt.effects.catalogue import twins
from visadapt.systems import System


def searched(effects: Iterable[type[Effect]], system: System) -> list[type[Effect]]:
    """Those that are fitted: the first of each group of twins, and no sensor with a memory."""
    out: list[type[Effect]] = []
    for effect in effects:
        if not (twins(effect, out, system) or effect.repeats_readings or _remembers(effect)):
            out.append(effect)
    return out


def _remembers(effect: type[Effect]) -> bool:
    if not issubclass(effect, SensingEffect):
        return False
    neutral = effect(**{p.name: p.low if p.neutral is None else p.neutral for p in effect.table})
    return neutral.memory(torch.zeros(1, 4), 1.0).numel() > 0

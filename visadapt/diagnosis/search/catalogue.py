"""Which effects a diagnosis fits."""

from __future__ import annotations

from collections.abc import Iterable

from visadapt.effects import Effect
from visadapt.effects.catalogue import twins
from visadapt.estimation.effect_fit import remembers
from visadapt.systems import System


def searched(effects: Iterable[type[Effect]], system: System) -> list[type[Effect]]:
    """The first effect of each group of twins; without effects that repeat readings, which are found by another method,
    and without sensors with memory, which candidate models cannot linearise by the present state."""
    out: list[type[Effect]] = []
    for effect in effects:
        if not (twins(effect, out, system) or effect.repeats_readings or remembers(effect)):
            out.append(effect)
    return out

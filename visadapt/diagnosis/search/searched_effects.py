"""Which effects of a catalogue a recording can show, and which of these the search fits."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from visadapt.effects import Effect, Stage
from visadapt.effects.catalogue import twins
from visadapt.effects.late_sensors import LateSensors, MeasurementDelay
from visadapt.effects.sensing import SensorGain
from visadapt.estimation.effect_fit import remembers
from visadapt.systems import System


def searched(effects: Iterable[type[Effect]], system: System) -> list[type[Effect]]:
    """The effects that are searched: one of each group of twins. Left out are effects that repeat readings, which are
    found by another method; sensors with memory, which candidate models cannot linearise by the present state alone
    (late sensors are kept); and effects of a camera, which are fitted to pixels."""
    out: list[type[Effect]] = []
    # Late commands and late readings are twins. The readings are kept: commands then change only between rows, not
    # within a step, which is exact also where a joint stops.
    for effect in sorted(effects, key=lambda effect: not issubclass(effect, LateSensors)):
        fitted_here = not (effect.repeats_readings or remembers(effect, system) or effect.stage is Stage.CAMERA)
        if fitted_here and not twins(effect, out, system):
            out.append(effect)
    return out


def shown_by(effects: Sequence[type[Effect]], measured: set[int]) -> list[type[Effect]]:
    """The effects that readings of the columns `measured` can show.

    Left out are effects of a camera; a delay of sensors none of which was read; a delay of exactly the sensors that
    were read, if `MeasurementDelay`, which then does the same, is searched too; and all scales but one of the same
    sensors: the first, or the first whose position was read.
    """
    all_late = any(issubclass(effect, MeasurementDelay) for effect in effects)
    scales = [effect for effect in effects if issubclass(effect, SensorGain)]
    kept: dict[frozenset[int], type[Effect]] = {}
    for effect in sorted(scales, key=lambda effect: effect.columns[0] not in measured):
        if read := measured.intersection(effect.columns):
            kept.setdefault(frozenset(read), effect)

    def shows(effect: type[Effect]) -> bool:
        if issubclass(effect, SensorGain):
            return effect in kept.values()
        if not issubclass(effect, LateSensors) or issubclass(effect, MeasurementDelay):
            return effect.stage is not Stage.CAMERA
        late = measured & set(effect.late)
        return bool(late) and not (all_late and late == measured)

    return [effect for effect in effects if shows(effect)]

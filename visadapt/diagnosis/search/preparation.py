"""A recording made ready for fitting: windows of rows, without readings that are not measurements of the state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from visadapt.diagnosis.result import Push
from visadapt.diagnosis.search import angle_defect, sensor_checks, sign_conventions
from visadapt.diagnosis.search.command_times import with_commands_that_act
from visadapt.diagnosis.search.draft import Draft, PreparedRecording, Readings, with_unmeasured_in_both
from visadapt.diagnosis.search.held_joints import without_held_joints
from visadapt.diagnosis.search.motor_off import without_idle_ends
from visadapt.diagnosis.search.pushed_rows import pushed_rows
from visadapt.diagnosis.words import DERIVED, OPPOSITE
from visadapt.effects import Effect
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.repeated_readings import find_repeats, read_twice
from visadapt.estimation.segments import stretches_without
from visadapt.recordings import Recording
from visadapt.recordings.thinning import spread
from visadapt.systems import System
from visadapt.systems.rigid_body import continuous_quaternion

MIN_JITTER = 1e-3
"""Largest deviation of time stamps from even spacing, in periods, above which fits with the recorded and with evenly
spaced stamps decide whether the readings share the jitter."""

EVEN_LOG_ODDS = 5.0
"""Log likelihood that evenly spaced stamps must gain over those recorded: at rest, both fit alike."""

MEMORY = 2.0
"""Prediction times before a stretch of rows whose commands are used too: what is late, or lags, remembers them."""

MOST_SEARCHES, STRETCH_WINDOWS = 24, 4
"""Most rows of a recording that are used, as a multiple of `SystemProfile.search_rows`: so many give narrow intervals
already, and the time grows with the rows. Of a longer recording, stretches of STRETCH_WINDOWS windows are used."""


def limited(recording: Recording, system: System) -> Recording:
    """The recording without rows in which its commands do not act, or a joint is held; where it has more rows than a
    diagnosis uses, stretches that are spread evenly over it."""
    before = round(MEMORY * system.prediction_time / recording.period)
    recording = without_idle_ends(without_held_joints(recording, system, before), system)
    profile = profile_of(system)
    stretch = STRETCH_WINDOWS * max(profile.window_rows, round(system.prediction_time / recording.period))
    return spread(recording, MOST_SEARCHES * profile.search_rows, stretch, before)


def prepare(
    recording: Recording, system: System, catalogue: Sequence[type[Effect]] = (), pushes: Sequence[Push] = ()
) -> PreparedRecording:
    """Prepare a recording of some or all states, and the commands.

    Args:
        catalogue: the effects that may act.
        pushes: the rows within them are in no window.
    """
    draft = _on_its_clock(_read(recording, system, pushes))
    if not profile_of(system).check_sensors:
        draft = _without_derived_velocities(draft)
    else:
        first = draft.source or draft.source_fit()
        draft = _without_derived_velocities(_without_defective_angles(replace(draft, source=first), first))
        # After the velocities, since those that lag make the wrong sign likelier.
        draft = _in_signs_of_source(draft, first, catalogue)
    # Last, since a wrong sign makes another instant likelier.
    return with_commands_that_act(draft, catalogue).prepared()


def _read(recording: Recording, system: System, pushes: Sequence[Push]) -> Draft:
    """All of the recording; readings that are repeated or may not be used, and rows within pushes, are marked."""
    profile = profile_of(system)
    channels = tuple(system.index(name) for name in recording.measured)
    quaternion = [k for k, channel in enumerate(channels) if channel in profile.quaternion]
    states = [torch.tensor(np.asarray(e.state, dtype=np.float64)) for e in recording.episodes]
    for values in states:
        values[:, quaternion] = continuous_quaternion(values[:, quaternion])
    commands = [torch.tensor(np.asarray(e.action, dtype=np.float64)) for e in recording.episodes]
    stamps = [torch.tensor(np.asarray(e.time, dtype=np.float64)) for e in recording.episodes]
    usable = [torch.ones_like(values) for values in states]
    if recording.usable:
        usable = [torch.tensor(read).double() for read in recording.usable]
    repeats = find_repeats(states, channels, profile.angle_sensor, usable)
    if recording.usable:
        used = [a * b for a, b in zip(repeats.used, usable, strict=True)]
        seen = [read_twice(read).any(1) for read in usable]
        lost = [rows & kept for rows, kept in zip(repeats.lost, seen, strict=True)]
        repeats = replace(repeats, used=used, lost=lost, seen=seen)
    pushed = pushed_rows(pushes, stamps, system)
    return Readings(recording, system, channels, states, commands, stamps, repeats, usable, pushed).draft()


def _on_its_clock(draft: Draft) -> Draft:
    """With even stamps, where those recorded jitter and the readings do not."""
    readings = draft.readings
    even = [_evenly_spaced(each) for each in readings.stamps]
    most = MIN_JITTER * readings.recording.period
    if all(float((a - b).abs().max()) <= most for a, b in zip(readings.stamps, even, strict=True)):
        return draft
    steady = replace(readings, stamps=even).draft()
    steady = replace(steady, warnings=("the stamps jitter, the readings do not: they were taken to be evenly spaced",))
    # Without velocities whose positions are measured: they may be derived.
    positions, channels = profile_of(readings.system).position_of, readings.channels
    kept = [k for k, channel in enumerate(channels) if positions.get(channel) not in channels]
    fitted, other = (replace(each, rows=each.rows.with_channels(kept)).source_fit() for each in (draft, steady))
    chosen, fit = (steady, other) if other.likelihood[0] > fitted.likelihood[0] + EVEN_LOG_ODDS else (draft, fitted)
    return replace(chosen, source=fit if len(kept) == len(channels) else None)


def _without_defective_angles(draft: Draft, source: FitState) -> Draft:
    """Without readings of the angle where its sensor is defective; `source` is the source's fit to the draft's rows."""
    readings = draft.readings
    sensor = profile_of(readings.system).angle_sensor
    defect = angle_defect.defective_band(readings.system, draft.rows.select(draft.searched), source)
    if defect is None:
        return draft
    band, full_turns = defect
    angle, name = readings.channels.index(sensor[0]), readings.system.states[sensor[0]].name
    bad = [angle_defect.between(values[:, angle], *band) for values in readings.states]
    told = (
        f"{sum(int(b.sum()) for b in bad)} readings of {name} between {band[0]:.2f} and {band[1]:.2f} rad "
        "contradict those around them and the physics: the sensor is defective there; they were set aside"
    )
    left_out = [a | b for a, b in zip(bad, readings.pushed, strict=True)]
    stretches = stretches_without(left_out, [(k, 0, len(rows)) for k, rows in enumerate(left_out)])
    if full_turns and stretches:
        # A potentiometer's dead zone has an unknown width, so windows end at it, and the angle runs from one of its
        # edges to the other, so that an error of the sensor's scale is symmetric about upright.
        states = [angle_defect.on_one_turn(values, angle, 0.5 * (band[0] + band[1])) for values in readings.states]
        readings = replace(readings, states=states)
        turned = readings.draft(stretches)
        return replace(draft, readings=readings, defect=band).changed(turned.rows, turned.raw, told)
    rows = angle_defect.without_angles(draft.rows, sensor, *band)
    return replace(draft, defect=band).changed(rows, draft.raw, told)


def _without_derived_velocities(draft: Draft) -> Draft:
    """Without velocities that were derived from positions on the rig, or filtered."""
    system, channels = draft.readings.system, draft.readings.channels
    derived = sensor_checks.derived_velocities(system, draft.rows)
    if not derived:
        return draft
    kept = [k for k, channel in enumerate(channels) if system.states[channel].name not in derived]
    told = [f"{name} is {lag:.3g} s late against the slope of its position: {DERIVED}" for name, lag in derived.items()]
    return draft.changed(draft.rows.with_channels(kept), draft.raw.with_channels(kept), *told)


def _in_signs_of_source(draft: Draft, first: FitState, catalogue: Sequence[type[Effect]]) -> Draft:
    """In the signs in which the recording is likeliest; `first` is the source's fit before readings were left out."""
    system, band = draft.readings.system, draft.defect
    rows = draft.rows.select(draft.searched)
    convention = sign_conventions.opposite_signs(system, rows, catalogue, first, draft.source)
    if convention is None:
        return draft
    if band is not None and profile_of(system).angle_sensor[0] in convention.columns:
        band = (-band[1], -band[0])
    told = f"{convention.name}{OPPOSITE}; it was inverted"
    rows, raw = (sign_conventions.to_source(each, convention) for each in (draft.rows, draft.raw))
    rows, raw = with_unmeasured_in_both(rows, raw, system)
    return replace(draft, convention=convention, defect=band).changed(rows, raw, told)


def _evenly_spaced(stamps: Tensor) -> Tensor:
    """Stamps (T,), in s, of a steady clock that is closest to these."""
    if len(stamps) < 2:
        return stamps
    index = torch.arange(len(stamps), dtype=stamps.dtype)
    index = index - index.mean()
    return stamps.mean() + index * (index @ stamps) / (index @ index)

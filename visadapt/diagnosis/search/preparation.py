"""A recording made ready for fitting: windows of rows, without readings that are not measurements of the state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visadapt.diagnosis.result import Push
from visadapt.diagnosis.search import angle_defect, sensor_checks, sign_conventions
from visadapt.diagnosis.search.command_times import Move, a_row_earlier, earlier, mean_until_next, sent_until_next_row
from visadapt.diagnosis.search.held_joints import without_held_joints
from visadapt.diagnosis.search.motor_off import without_idle_ends
from visadapt.diagnosis.search.pushed_rows import pushed_rows
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.words import A_ROW_LATE, DERIVED, OPPOSITE, OWN_CLOCK, PART_LATE, number
from visadapt.effects import Effect
from visadapt.estimation.integration_step import with_longest_step
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import Convention, profile_of
from visadapt.estimation.repeated_readings import RepeatedReadings, find_repeats, read_twice
from visadapt.estimation.segments import Segments, Stretch, cut, smoothly_filled, stretches_without
from visadapt.estimation.unmeasured_states import with_unmeasured
from visadapt.recordings import Episode, Recording
from visadapt.recordings.command_clock import instants
from visadapt.recordings.runs import runs
from visadapt.recordings.thinning import spread
from visadapt.systems import System
from visadapt.systems.rigid_body import continuous_quaternion


@dataclass(frozen=True)
class PreparedRecording:
    """What is fitted, in the signs of the source."""

    rows: Segments  # without repeated or defective readings
    raw: Segments  # the same windows with repeated readings as they were read
    whole: Recording | None
    """episodes from end to end, repeated readings filled in from those around, rows of many of them not usable; None
    where the angle is defective"""
    searched: Tensor  # indices of the windows that the search uses, spread evenly where there are many
    repeats: RepeatedReadings
    defect: tuple[float, float] | None  # rad, between which the angle sensor is defective
    coarse: tuple[sensor_checks.CoarseSteps, ...]  # positions whose steps are coarse for the motion
    warnings: tuple[str, ...]
    source: FitState | None = None  # the fit of the source to the windows searched, if a check needed it


MIN_JITTER = 1e-3
"""Largest deviation of time stamps from even spacing, in periods, above which fits with the recorded and with evenly
spaced stamps decide whether the readings share the jitter."""

EVEN_LOG_ODDS = 5.0
"""Log likelihood that evenly spaced stamps must gain over those recorded: at rest, both fit alike."""

EARLIER_LOG_ODDS = 20.0
"""Log likelihood that commands moved in time must gain: no machine answers before it is asked."""

MIN_PART = 0.02  # Share of a row by which commands must act early to be moved

MOST_BESIDE_LATE = 2
"""Most effects that are fitted beside the lateness of commands that have stamps of their own, which often are late.
None are fitted beside that of others, which is rare."""

MOST_FILLED = 2
"""Rows in a row whose readings are filled in by cubics: the acceleration in more of them would be made up."""

LEAST_READ = 0.8
"""Share of the rows in which a sensor is read, below which it gives the rows in which pushes are looked for."""

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
    if profile_of(system).check_sensors:
        first = draft.source or draft.source_fit()
        draft = _without_derived_velocities(_without_defective_angles(replace(draft, source=first), first))
        # After the velocities, since those that lag make the wrong sign likelier.
        draft = _in_signs_of_source(draft, first, catalogue)
    # Last, since a wrong sign makes another instant likelier.
    return _with_commands_that_act(draft, catalogue).prepared()


@dataclass(frozen=True)
class _Readings:
    """A recording in tensors, one for each episode."""

    recording: Recording
    system: System
    channels: tuple[int, ...]  # the m columns of the state that were measured
    states: list[Tensor]  # (T, m)
    commands: list[Tensor]  # (T, n_action)
    stamps: list[Tensor]  # (T,) s
    repeats: RepeatedReadings
    usable: list[Tensor]  # (T, m) 1 where the recording may be used
    pushed: list[Tensor]  # (T,) whether the row is within a push

    def draft(self, stretches: Sequence[Stretch] | None = None) -> _Draft:
        """Windows of the episodes from their first usable row on, outside of pushes; or of stretches of these."""
        period = self.recording.period
        if stretches is None:
            stretches = [(k, first, len(self.states[k])) for k, first in enumerate(self.first_usable)]
            stretches = stretches_without(self.pushed, stretches)
        # A window holds predictions from half of its rows, however fast these follow each other.
        least = round(2 * self.system.prediction_time / period)
        longest = max(profile_of(self.system).window_rows, least)
        if len(self.states) == 1:  # of which a part is held out
            longest = min(longest, max(least, -(-len(self.states[0]) // 2)))
        rows, raw = (
            cut(self.states, valid, self.commands, self.stamps, self.channels, period, longest, stretches)
            for valid in (self.repeats.used, self.usable)
        )
        if resolution := self.recording.resolution:
            rows, raw = (replace(each, resolution=resolution) for each in (rows, raw))
        rows, raw = _with_unmeasured(rows, raw, self.system)
        rows = with_longest_step(rows, self.system)
        return _Draft(self, rows, replace(raw, longest_step=rows.longest_step))

    @property
    def first_usable(self) -> list[int]:
        """The first row of each episode of which a reading may be used."""
        return [int(rows.any(1).int().argmax()) for rows in self.usable]

    def whole(self, convention: Convention | None) -> Recording:
        """Episodes from their first usable row on, in the signs of the source. Repeated and missing readings are filled
        in; rows of longer runs of these are marked as not usable. Rows between the readings of a sensor slower than the
        rows are left out: a command is its mean until the next row."""
        convention = convention or Convention("", ())
        sign = sign_conventions.signs(convention.columns, self.channels)
        command_sign = sign_conventions.signs(convention.commands, range(len(self.system.actions)))
        share = torch.cat(self.usable).mean(0)
        slowest = None if float(share.min()) > LEAST_READ else int(share.argmin())
        parts = zip(self.stamps, self.commands, self.states, self.repeats.used, strict=True)
        episodes, usable = [], []
        for rows, first in zip(parts, self.first_usable, strict=True):
            time, command, state, used = (values[first:] for values in rows)
            action, filled = command_sign * command, sign * smoothly_filled(state, used, time)
            kept = _without_long_runs((used > 0).all(1).numpy())
            read = None if slowest is None else used[:, slowest].nonzero()[:, 0]
            if read is not None and len(read) > 1:
                time, action, filled = time[read], mean_until_next(action, time, read), filled[read]
                kept = np.ones(len(read), bool)
            episodes.append(Episode(time.numpy(), action.numpy(), filled.numpy()))
            usable.append(np.repeat(kept[:, None], len(self.channels), 1))
        whole = replace(self.recording, episodes=tuple(episodes), usable=tuple(usable))
        if slowest is None:
            return whole
        steps = torch.cat([torch.from_numpy(episode.time).diff() for episode in episodes])
        return replace(whole, period=float(steps.median()))


def _with_unmeasured(rows: Segments, raw: Segments, system: System) -> tuple[Segments, Segments]:
    """Both with the same estimates of the states that were not measured."""
    rows = with_unmeasured(rows, system)
    return rows, replace(raw, estimated=rows.estimated)


def _without_long_runs(measured: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """False in the rows (T,) of runs of more than MOST_FILLED that were not `measured` (T,)."""
    out = np.ones(len(measured), bool)
    for start, end in runs(measured):
        out[start:end] = measured[start] or end - start <= MOST_FILLED
    return out


@dataclass(frozen=True)
class _Draft:
    """A recording on its way to being prepared."""

    readings: _Readings
    rows: Segments
    raw: Segments
    source: FitState | None = None  # of `rows`, where a check needed it
    defect: tuple[float, float] | None = None
    convention: Convention | None = None  # where it is not the source's
    warnings: tuple[str, ...] = ()

    @property
    def searched(self) -> Tensor:
        """Indices of the windows that the search uses."""
        return self.rows.spread(profile_of(self.readings.system).search_rows)

    def source_fit(self) -> FitState:
        """The source's fit to the windows searched."""
        return Search(self.readings.system, self.rows.select(self.searched), ()).source.fits

    def changed(self, rows: Segments, raw: Segments, *told: str) -> _Draft:
        """With other rows, to which no fit is known."""
        return replace(self, rows=rows, raw=raw, source=None, warnings=(*self.warnings, *told))

    def prepared(self) -> PreparedRecording:
        """The recording as it stands."""
        whole = self.readings.whole(self.convention) if self.defect is None else None
        coarse = sensor_checks.coarse_steps(self.readings.system, self.rows)
        warnings = (*self.warnings, *map(str, coarse))
        about = self.searched, self.readings.repeats, self.defect, coarse, warnings, self.source
        return PreparedRecording(self.rows, self.raw, whole, *about)


def _read(recording: Recording, system: System, pushes: Sequence[Push]) -> _Draft:
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
    return _Readings(recording, system, channels, states, commands, stamps, repeats, usable, pushed).draft()


def _on_its_clock(draft: _Draft) -> _Draft:
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


def _without_defective_angles(draft: _Draft, source: FitState) -> _Draft:
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


def _without_derived_velocities(draft: _Draft) -> _Draft:
    """Without velocities that were derived from positions on the rig."""
    system, channels = draft.readings.system, draft.readings.channels
    derived = sensor_checks.derived_velocities(system, draft.rows)
    if not derived:
        return draft
    kept = [k for k, channel in enumerate(channels) if system.states[channel].name not in derived]
    told = [f"{name} is {lag:.3g} s late against the slope of its position: {DERIVED}" for name, lag in derived.items()]
    return draft.changed(draft.rows.with_channels(kept), draft.raw.with_channels(kept), *told)


def _in_signs_of_source(draft: _Draft, first: FitState, catalogue: Sequence[type[Effect]]) -> _Draft:
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
    rows, raw = _with_unmeasured(rows, raw, system)
    return replace(draft, convention=convention, defect=band).changed(rows, raw, told)


def _with_commands_that_act(draft: _Draft, catalogue: Sequence[type[Effect]]) -> _Draft:
    """With the commands when they act: by their controller's clock, where that is not the rows'; earlier by a row,
    where the recording has each beside the readings that it led to; or earlier by part of a row."""
    given = _MovedCommands.of(draft, catalogue, None)
    stamped = draft.readings.recording.stamped_commands
    if not stamped and (period := _controllers_period(draft.readings)) is not None:
        by_clock = _MovedCommands.of(draft, catalogue, sent_until_next_row)
        if sign_conventions.stays_ahead(by_clock.search, given.search, EARLIER_LOG_ODDS):
            draft = by_clock.told(f"commands change every {number(period)} s, {OWN_CLOCK}")
            given, stamped = replace(by_clock, draft=draft), True
    a_row = _MovedCommands.of(draft, catalogue, a_row_earlier)
    # Commands that are late by less than a row are, a row earlier, those of a machine with a delay.
    if not stamped and sign_conventions.stays_ahead(
        a_row.search, given.search, EARLIER_LOG_ODDS, a_row.search.fit_delays
    ):
        return a_row.told(f"each command is recorded a row late, beside the readings that it led to: {A_ROW_LATE}")
    late = draft.rows.period - a_row.delay(MOST_BESIDE_LATE if stamped else 0)
    if late > MIN_PART * draft.rows.period:
        part = _MovedCommands.of(draft, catalogue, partial(earlier, by=late))
        if sign_conventions.stays_ahead(part.search, given.search, EARLIER_LOG_ODDS):
            return part.told(f"the commands act {number(late, 2)} s before the rows that they are in: {PART_LATE}")
    return replace(draft, source=given.search.source.fits)


def _controllers_period(readings: _Readings) -> float | None:
    """The median period, in s, of the controller's clock in each episode; None, if one shows no clock but the rows'."""
    periods = []
    for stamps, command in zip(readings.stamps, readings.commands, strict=True):
        sent = instants(stamps.numpy(), command.numpy())
        if sent is None:
            return None
        periods.append(float(np.diff(sent).mean()))
    return median(periods)


@dataclass(frozen=True)
class _MovedCommands:
    """A draft whose commands are moved in time."""

    draft: _Draft
    move: Move | None
    rows: Segments
    raw: Segments
    search: Search

    @classmethod
    def of(cls, draft: _Draft, catalogue: Sequence[type[Effect]], move: Move | None) -> _MovedCommands:
        """The draft with its commands moved; without `move`, as they are."""
        system, rows, raw = draft.readings.system, draft.rows, draft.raw
        if move is not None:
            command = rows.command.clone()
            for episode, stamps in enumerate(draft.readings.stamps):
                command[episode, : len(stamps)] = move(command[episode, : len(stamps)], stamps)
            rows, raw = (replace(one, command=command) for one in (rows, raw))
            rows, raw = _with_unmeasured(rows, raw, system)
        source = draft.source if move is None else None
        return cls(draft, move, rows, raw, Search(system, rows.select(draft.searched), catalogue, source))

    def delay(self, beside: int) -> float:
        """The machine's delay, in s, that fits best, with up to so many other effects `beside` it; a row, where no
        delay is among the effects searched."""
        sets = self.search.fit_late_commands()
        if not sets:
            return self.rows.period
        best, before = sets[0], None
        delay = best.effects[0]
        while best is not before and len(best.effects) <= beside:
            before = best
            grown = self.search.extend([best], sign_conventions.LEADS)
            best = max((best, *grown), key=lambda one: one.log_odds)
        return float(best.by_effect(best.fits.theta[0])[delay])

    def told(self, warning: str) -> _Draft:
        """The draft with its commands moved, and a warning of it."""
        assert self.move is not None
        readings = self.draft.readings
        commands = [self.move(each, stamps) for each, stamps in zip(readings.commands, readings.stamps, strict=True)]
        moved = replace(self.draft, readings=replace(readings, commands=commands))
        return moved.changed(self.rows, self.raw, warning)


def _evenly_spaced(stamps: Tensor) -> Tensor:
    """Stamps (T,), in s, of a steady clock that is closest to these."""
    if len(stamps) < 2:
        return stamps
    index = torch.arange(len(stamps), dtype=stamps.dtype)
    index = index - index.mean()
    return stamps.mean() + index * (index @ stamps) / (index @ index)

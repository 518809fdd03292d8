"""A recording made ready for fitting: windows of rows, without readings that are not measurements of the state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from visadapt.diagnosis.search import sensor_checks
from visadapt.diagnosis.search.heldout import PREDICTION_TIME
from visadapt.diagnosis.search.search import Search
from visadapt.effects import Effect
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import Convention, profile_of
from visadapt.estimation.repeated_readings import RepeatedReadings, find_repeats
from visadapt.estimation.segments import Segments, cut
from visadapt.recordings import Recording
from visadapt.recordings.thinning import spread
from visadapt.systems import System


@dataclass(frozen=True)
class PreparedRecording:
    """What is fitted, in the signs of the source."""

    rows: Segments  # without repeated or defective readings
    raw: Segments  # the same windows with repeated readings as they were read
    whole: Recording | None
    """episodes from end to end, repeated readings filled in from those around; None where the angle is defective"""
    searched: Tensor  # indices of the windows that the search uses, spread evenly where there are many
    repeats: RepeatedReadings
    defect: tuple[float, float] | None  # rad, between which the angle sensor is defective
    warnings: tuple[str, ...]
    source: FitState | None = None  # the fit of the source to the windows searched, if a check needed it


AS_SOURCE = Convention("nothing", ())

MIN_JITTER = 1e-3
"""Deviation of stamps from even spacing, in periods, above which a fit decides whether the readings share it."""


def _evenly_spaced(stamps: Tensor) -> Tensor:
    """Stamps (T,), in s, of a steady clock that is closest to these."""
    index = torch.arange(len(stamps), dtype=stamps.dtype)
    index = index - index.mean()
    return stamps.mean() + index * (index @ stamps) / (index @ index)


def _filled(values: Tensor, used: Tensor, stamps: Tensor) -> Tensor:
    """Readings (T, m); those that are not used are interpolated linearly between those that are."""
    columns = [
        np.interp(stamps, stamps[kept], column[kept]) if kept.any() else column
        for column, kept in zip(values.numpy().T, used.numpy().T > 0, strict=True)
    ]
    return torch.tensor(np.stack(columns, 1))


MOST_SEARCHES, STRETCH_WINDOWS = 24, 4
"""Most rows of a recording that are used, as a multiple of those that the search uses, and windows in a stretch of
them: the intervals from so many rows are narrow already, and the time grows with the rows."""


def limited(recording: Recording, system: System) -> Recording:
    """The recording; where it has more rows than a diagnosis uses, stretches that are spread evenly over it."""
    profile = profile_of(system)
    stretch = STRETCH_WINDOWS * max(profile.window_rows, round(PREDICTION_TIME / recording.period))
    return spread(recording, MOST_SEARCHES * profile.search_rows, stretch)


def prepare(recording: Recording, system: System, catalogue: Sequence[type[Effect]] = ()) -> PreparedRecording:
    """Prepare a recording of some or all states, and the commands; `catalogue` are the effects that may act."""
    profile = profile_of(system)
    channels = tuple(system.index(name) for name in recording.measured)
    quaternion = [k for k, channel in enumerate(channels) if channel in profile.quaternion]
    states = [torch.tensor(np.asarray(e.state, dtype=np.float64)) for e in recording.episodes]
    states = [sensor_checks.continuous_quaternion(values, quaternion) for values in states]
    commands = [torch.tensor(np.asarray(e.action, dtype=np.float64)) for e in recording.episodes]
    stamps = [torch.tensor(np.asarray(e.time, dtype=np.float64)) for e in recording.episodes]
    repeats = find_repeats(states, channels, profile.angle_sensor)
    usable = [torch.ones_like(values) for values in states]
    if recording.usable:
        usable = [every * torch.tensor(rows)[:, None] for every, rows in zip(usable, recording.usable, strict=True)]
        used = [a * b for a, b in zip(repeats.used, usable, strict=True)]
        lost = [rows & torch.tensor(kept) for rows, kept in zip(repeats.lost, recording.usable, strict=True)]
        repeats = replace(repeats, used=used, lost=lost)

    # A window holds predictions from half of its rows, however fast these follow each other.
    least = round(2 * PREDICTION_TIME / recording.period)
    longest = max(profile.window_rows, least)
    if len(states) == 1:  # of which a part is held out
        longest = min(longest, max(least, -(-len(states[0]) // 2)))

    def windows(
        measured: Sequence[Tensor], clock: Sequence[Tensor], stretches: Sequence[tuple[int, int, int]] | None = None
    ) -> tuple[Segments, Segments]:
        """`rows` and `raw` of episodes or stretches of these."""
        rows, raw = (
            cut(measured, valid, commands, clock, channels, recording.period, longest, stretches)
            for valid in (repeats.used, usable)
        )
        if recording.resolution:
            rows, raw = (replace(each, resolution=recording.resolution) for each in (rows, raw))
        return rows, raw

    def searched(rows: Segments) -> Tensor:
        return rows.spread(profile.search_rows)

    def source_fit(rows: Segments) -> FitState:
        return Search(system, rows.select(searched(rows)), ()).source.fits

    rows, raw = windows(states, stamps)
    source: FitState | None = None
    warnings: list[str] = []
    even = [_evenly_spaced(each) for each in stamps]
    if any(float((a - b).abs().max()) > MIN_JITTER * recording.period for a, b in zip(stamps, even, strict=True)):
        # Without velocities whose positions are measured: they may be derived.
        kept = [k for k, channel in enumerate(channels) if profile.position_of.get(channel) not in channels]
        steady, steady_raw = windows(states, even)
        fitted, other = (source_fit(each.with_channels(kept)) for each in (rows, steady))
        if other.likelihood[0] > fitted.likelihood[0]:
            rows, raw, stamps, fitted = steady, steady_raw, even, other
            warnings.append("the stamps jitter, the readings do not: they were taken to be evenly spaced")
        source = fitted if len(kept) == len(channels) else None

    def whole(convention: Convention) -> Recording:
        sign = sensor_checks.signs(convention, channels)
        parts = zip(recording.episodes, stamps, commands, states, repeats.used, strict=True)
        episodes = []
        for episode, time, command, state, used in parts:
            action, filled = (convention.command * command).numpy(), (sign * _filled(state, used, time)).numpy()
            episodes.append(replace(episode, time=time.numpy(), action=action, state=filled))
        return replace(recording, episodes=tuple(episodes))

    if not profile.check_sensors:
        return PreparedRecording(rows, raw, whole(AS_SOURCE), searched(rows), repeats, None, tuple(warnings), source)
    unchecked, first = rows, source or source_fit(rows)
    defect = sensor_checks.angle_defect(system, rows.select(searched(rows)), first)
    band = None
    if defect is not None:
        band, full_turns = defect
        angle = channels.index(profile.angle_sensor[0])
        bad = [sensor_checks.between(values[:, angle], *band) for values in states]
        stretches = sensor_checks.stretches_without(bad)
        if full_turns and stretches:
            # A potentiometer's dead zone has an unknown width, so windows end at it, and the angle runs from one of its
            # edges to the other, so that an error of the sensor's scale is symmetric about upright.
            states = [sensor_checks.on_one_turn(values, angle, 0.5 * (band[0] + band[1])) for values in states]
            rows, raw = windows(states, stamps, stretches)
        else:
            rows = sensor_checks.without_angles(rows, profile.angle_sensor, *band)
        warnings.append(
            f"{sum(int(b.sum()) for b in bad)} readings of theta between {band[0]:.2f} and {band[1]:.2f} rad "
            "contradict those around them and the physics: the sensor is defective there; they were set aside"
        )
    derived = sensor_checks.derived_velocities(system, rows)
    if derived:
        kept = [k for k, channel in enumerate(channels) if system.states[channel].name not in derived]
        warnings += [
            f"{name} is {lag:.3g} s late against the slope of its position: derived on the rig, not measured; left out"
            for name, lag in derived.items()
        ]
        rows, raw = rows.with_channels(kept), raw.with_channels(kept)
    # After the velocities, since those that lag make the wrong sign likelier.
    source = first if rows is unchecked else None
    convention = sensor_checks.opposite_signs(system, rows.select(searched(rows)), catalogue, first, source)
    if convention is not None:
        rows, raw = (sensor_checks.to_source(each, convention) for each in (rows, raw))
        source = None
        if band is not None and profile.angle_sensor[0] in convention.columns:
            band = (-band[1], -band[0])
        warnings.append(f"{convention.name} has the opposite sign of the source's; it was inverted")
    intact = None if defect is not None else whole(convention or AS_SOURCE)
    return PreparedRecording(rows, raw, intact, searched(rows), repeats, band, tuple(warnings), source)

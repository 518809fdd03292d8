"""A recording on its way to being prepared for fitting, and as it is then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visadapt.diagnosis.search import sensor_checks, sign_conventions
from visadapt.diagnosis.search.search import Search
from visadapt.estimation.integration_step import with_longest_step
from visadapt.estimation.likelihood import FitState
from visadapt.estimation.profiles import Convention, profile_of
from visadapt.estimation.repeated_readings import RepeatedReadings
from visadapt.estimation.segments import Segments, Stretch, cut, smoothly_filled, stretches_without
from visadapt.estimation.unmeasured_states import with_unmeasured
from visadapt.recordings import Episode, Recording
from visadapt.recordings.command_clock import means_until_next
from visadapt.recordings.runs import runs
from visadapt.systems import System

MOST_FILLED = 2
"""Rows in a row whose readings are filled in by cubics: the acceleration in more of them would be made up."""

LEAST_READ = 0.8
"""Share of the rows in which a sensor is read, below which it is slower than the rows: it gives those in which pushes
are looked for, and commands between the rows are not estimated from it."""


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


@dataclass(frozen=True)
class Readings:
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

    def draft(self, stretches: Sequence[Stretch] | None = None) -> Draft:
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
        rows, raw = with_unmeasured_in_both(rows, raw, self.system)
        rows = with_longest_step(rows, self.system)
        return Draft(self, rows, replace(raw, longest_step=rows.longest_step))

    @property
    def first_usable(self) -> list[int]:
        """The first row of each episode of which a reading may be used."""
        return [int(rows.any(1).int().argmax()) for rows in self.usable]

    def whole(self, convention: Convention | None) -> Recording:
        """Whole episodes, in the signs of the source. Repeated and missing readings are filled in; rows of longer runs
        of these, and those before the first usable row, are marked as not usable. Rows between the readings of a sensor
        slower than the rows are left out: a command is its mean until the next row."""
        convention = convention or Convention("", ())
        sign = sign_conventions.signs(convention.columns, self.channels)
        command_sign = sign_conventions.signs(convention.commands, range(len(self.system.actions)))
        share = torch.cat(self.usable).mean(0)
        slowest = None if float(share.min()) > LEAST_READ else int(share.argmin())
        parts = zip(self.stamps, self.commands, self.states, self.repeats.used, strict=True)
        episodes, usable = [], []
        for (time, command, state, used), first in zip(parts, self.first_usable, strict=True):
            action, filled = command_sign * command, sign * smoothly_filled(state, used, time)
            kept = _without_long_runs((used > 0).all(1).numpy())
            kept[:first] = False
            read = None if slowest is None else used[:, slowest].nonzero()[:, 0]
            if read is not None and len(read) > 1:
                means = [means_until_next(time[read].numpy(), time.numpy(), each) for each in action.T.numpy()]
                time, action, filled = time[read], torch.from_numpy(np.column_stack(means)), filled[read]
                kept = read.numpy() >= first
            episodes.append(Episode(time.numpy(), action.numpy(), filled.numpy()))
            usable.append(np.repeat(kept[:, None], len(self.channels), 1))
        whole = replace(self.recording, episodes=tuple(episodes), usable=tuple(usable))
        if slowest is None:
            return whole
        steps = torch.cat([torch.from_numpy(episode.time).diff() for episode in episodes])
        return replace(whole, period=float(steps.median()))


@dataclass(frozen=True)
class Draft:
    """A recording on its way to being prepared."""

    readings: Readings
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

    def changed(self, rows: Segments, raw: Segments, *told: str) -> Draft:
        """With other rows, to which no fit is known."""
        return replace(self, rows=rows, raw=raw, source=None, warnings=(*self.warnings, *told))

    def prepared(self) -> PreparedRecording:
        """The recording as it stands."""
        whole = self.readings.whole(self.convention) if self.defect is None else None
        coarse = sensor_checks.coarse_steps(self.readings.system, self.rows)
        warnings = (*self.warnings, *map(str, coarse))
        about = self.searched, self.readings.repeats, self.defect, coarse, warnings, self.source
        return PreparedRecording(self.rows, self.raw, whole, *about)


def with_unmeasured_in_both(rows: Segments, raw: Segments, system: System) -> tuple[Segments, Segments]:
    """Both with the same estimates of the states that were not measured."""
    rows = with_unmeasured(rows, system)
    return rows, replace(raw, estimated=rows.estimated)


def _without_long_runs(measured: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """False in the rows (T,) of runs of more than MOST_FILLED that were not `measured` (T,)."""
    out = np.ones(len(measured), bool)
    for start, end in runs(measured):
        out[start:end] = measured[start] or end - start <= MOST_FILLED
    return out

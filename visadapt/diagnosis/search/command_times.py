"""Commands that are not in the rows in which they act, and where they do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median

import numpy as np
import torch
from torch import Tensor

from visadapt.diagnosis.search import sign_conventions
from visadapt.diagnosis.search.draft import LEAST_READ, Draft, Readings, with_unmeasured_in_both
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.words import A_ROW_LATE, BETWEEN_ROWS, OWN_CLOCK, PART_LATE, THINNED, number
from visadapt.effects import Effect
from visadapt.estimation.segments import Segments
from visadapt.recordings.command_clock import instants, sent_by_clock

EARLIER_LOG_ODDS = 20.0
"""Log likelihood that commands moved in time must gain: no machine answers before it is asked."""

MIN_PART = 0.02  # Share of a row by which commands must act early to be moved

THINNED_PARTS = (0.2, 0.6)
"""Range of the share of the time between logged commands by which these act early where their log keeps only some of
those that were sent: from a quarter, of every second one, to a half. Commands that act earlier, or less early, reached
their log late."""

MOST_BESIDE_LATE = 2
"""Most effects that are fitted beside the lateness of commands that have stamps of their own, which often are late.
None are fitted beside that of others, which is rare."""

EARLIER = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
"""Shares of a row by which commands that have stamps are moved earlier, in turn, until the source explains less."""

PARTS = (0.2, 0.1, 0.35, 0.5)
"""Parts of a row for which a controller that is faster than the rows may hold each command. The others are tried only
where the first alone is likelier than commands that are held for a row."""

FEWEST_ROWS = 4  # Of an episode, for each coefficient of the commands' regression on the readings

LEAST_NOISE = 0.5
"""Share of what of the commands is not linear in the readings that must be noise, new in each row, for a controller to
be faster than the rows."""

Move = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(commands (T, n) of an episode, each held until the next row; stamps (T,) of the rows, in s; readings (T, m)) to the
commands that act."""


def with_commands_that_act(draft: Draft, catalogue: Sequence[type[Effect]]) -> Draft:
    """With the commands when they act: by their controller's clock, where that is slower than the rows; earlier by a
    row, where the recording has each beside the readings that it led to; earlier by part of a row; or, where the
    controller is faster than the rows, with an estimate of what it sent between them."""
    given = _Moved.of(draft, catalogue, None)
    logged_every = draft.readings.recording.command_period
    stamped = logged_every is not None
    if not stamped and (period := _controllers_period(draft.readings)) is not None:
        by_clock = _Moved.of(draft, catalogue, _sent_until_next_row)
        if sign_conventions.stays_ahead(by_clock.search, given.search, EARLIER_LOG_ODDS):
            draft = by_clock.told(f"commands change every {number(period)} s, {OWN_CLOCK}")
            given, stamped = replace(by_clock, draft=draft), True
    a_row = _Moved.of(draft, catalogue, _a_row_earlier)
    # Commands that are late by less than a row are, a row earlier, those of a machine with a delay.
    if not stamped and sign_conventions.stays_ahead(
        a_row.search, given.search, EARLIER_LOG_ODDS, a_row.search.fit_delays
    ):
        return a_row.told(f"each command is recorded a row late, beside the readings that it led to: {A_ROW_LATE}")
    period = draft.rows.period
    late = period - a_row.delay(MOST_BESIDE_LATE if stamped else 0)
    likelier = given
    if late > MIN_PART * period:
        ways = [(late, _Moved.of(draft, catalogue, partial(_earlier, by=late)))]
        ways += [_likeliest(draft, catalogue, given)] if stamped else []
        for by, earlier in ways:
            stays = sign_conventions.stays_ahead(earlier.search, given.search, EARLIER_LOG_ODDS)
            if stays and (likelier is given or earlier.search.best.log_odds > likelier.search.best.log_odds):
                late, likelier = by, earlier
    if not stamped and (faster := _faster_than_rows(draft, catalogue, likelier)) is not None:
        return faster
    if likelier is not given:
        moved = f"the commands act {number(late, 2)} s before the rows that they are in: {PART_LATE}"
        least, most = THINNED_PARTS
        thinned = logged_every is not None and least < late / logged_every < most
        return likelier.told(moved, *([THINNED] if thinned else []))
    return replace(draft, source=given.search.source.fits)


def _likeliest(draft: Draft, catalogue: Sequence[type[Effect]], given: _Moved) -> tuple[float, _Moved]:
    """The s, up to a row, by which commands are late under the source alone, and the draft with them moved."""

    def moved(share: float) -> _Moved:
        return _Moved.of(draft, catalogue, partial(_earlier, by=share * draft.rows.period))

    tried = [(0.0, given)]
    for share in EARLIER:
        tried.append((share, moved(share)))
        if tried[-1][1].source_likelihood < tried[-2][1].source_likelihood:
            break
    if len(tried) > 2:
        # The top of the parabola through the last three, the middle one of which is the best, or the last of all.
        shares, likelihoods = np.array([(share, one.source_likelihood) for share, one in tried[-3:]]).T
        curvature, slope, _ = np.polyfit(shares, likelihoods, 2)
        if curvature < 0:
            top = float(np.clip(-slope / (2 * curvature), shares[0], shares[2]))
            tried.append((top, moved(top)))
    share, best = max(tried, key=lambda each: each[1].source_likelihood)
    return share * draft.rows.period, best


def _faster_than_rows(draft: Draft, catalogue: Sequence[type[Effect]], slower: _Moved) -> Draft | None:
    """With an estimate of what the controller sent between the rows, if that is likelier than `slower` commands."""
    readings = draft.readings
    if float(torch.cat(readings.repeats.used).mean(0).min()) < LEAST_READ:
        return None  # the controller may have other readings
    rest = torch.cat([a - _of_readings(a, at) for a, at in zip(readings.commands, readings.states, strict=True)])
    if not _noise(readings.commands).sum() > LEAST_NOISE * rest.square().mean(0).sum():
        return None  # commands that are held for rows, or change smoothly, act as they are recorded
    first, *others = (partial(_between_rows, part=part) for part in PARTS)
    best = _Moved.of(draft, catalogue, first)
    if best.source_likelihood < slower.source_likelihood + EARLIER_LOG_ODDS:
        return None
    best = max((best, *(_Moved.of(draft, catalogue, each) for each in others)), key=lambda one: one.source_likelihood)
    if not sign_conventions.stays_ahead(best.search, slower.search, EARLIER_LOG_ODDS):
        return None
    return best.told(BETWEEN_ROWS)


def _controllers_period(readings: Readings) -> float | None:
    """The median period, in s, of the controller's clock in each episode; None, if one shows no clock but the rows'."""
    periods = []
    for stamps, command in zip(readings.stamps, readings.commands, strict=True):
        sent = instants(stamps.numpy(), command.numpy())
        if sent is None:
            return None
        periods.append(float(np.median(np.diff(sent))))
    return median(periods)


@dataclass(frozen=True)
class _Moved:
    """A draft whose commands are moved in time."""

    draft: Draft
    move: Move | None
    rows: Segments
    raw: Segments
    search: Search

    @classmethod
    def of(cls, draft: Draft, catalogue: Sequence[type[Effect]], move: Move | None) -> _Moved:
        """The draft with its commands moved; without `move`, as they are."""
        system, rows, raw = draft.readings.system, draft.rows, draft.raw
        if move is not None:
            command = rows.command.clone()
            for episode, (stamps, states) in enumerate(zip(draft.readings.stamps, draft.readings.states, strict=True)):
                command[episode, : len(stamps)] = move(command[episode, : len(stamps)], stamps, states)
            rows, raw = (replace(one, command=command) for one in (rows, raw))
            rows, raw = with_unmeasured_in_both(rows, raw, system)
        source = draft.source if move is None else None
        return cls(draft, move, rows, raw, Search(system, rows.select(draft.searched), catalogue, source))

    @property
    def source_likelihood(self) -> float:
        """Log likelihood of the source's fit."""
        return float(self.search.source.fits.likelihood[0])

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

    def told(self, *warnings: str) -> Draft:
        """The draft with its commands moved, and warnings of it."""
        assert self.move is not None
        readings = self.draft.readings
        episodes = zip(readings.commands, readings.stamps, readings.states, strict=True)
        commands = [self.move(command, stamps, states) for command, stamps, states in episodes]
        moved = replace(self.draft, readings=replace(readings, commands=commands))
        return moved.changed(self.rows, self.raw, *warnings)


def _a_row_earlier(command: Tensor, stamps: Tensor, states: Tensor) -> Tensor:
    """The commands, each a row earlier; the last stays."""
    return torch.cat((command[1:], command[-1:]))


def _earlier(command: Tensor, stamps: Tensor, states: Tensor, by: float) -> Tensor:
    """The commands, each earlier by so many seconds, up to a row: a row then holds the mean of its own and the next."""
    share = (by / stamps.diff()).clamp(max=1)[:, None]
    return torch.cat((torch.lerp(command[:-1], command[1:], share), command[-1:]))


def _sent_until_next_row(command: Tensor, stamps: Tensor, states: Tensor) -> Tensor:
    """The mean of what a controller sent until the next row, by a clock that is not that of the rows."""
    return torch.from_numpy(sent_by_clock(stamps.numpy(), command.numpy()))


def _between_rows(command: Tensor, stamps: Tensor, states: Tensor, part: float) -> Tensor:
    """The mean command over each row, of a controller that holds each of its commands for this part of a row.

    The part of a recorded command that is linear in the readings around it is taken to change linearly until the next
    row. The rest, noise say, acts for as long as a command is held: the next command may have another.
    """
    of_readings = _of_readings(command, states)
    half_way = 0.5 * (1 - part) * float(stamps.diff().median())
    return _earlier(of_readings, stamps, states, half_way) + part * (command - of_readings)


def _of_readings(command: Tensor, states: Tensor) -> Tensor:
    """The part (T, n) of commands (T, n) that is linear in the readings (T, m) of the row, the one before and the one
    after; all of them in an episode too short to tell."""
    around = torch.cat((states[:1], states, states[-1:])).unfold(0, 3, 1).flatten(1)  # (T, 3 m), for the rates too
    if len(command) < FEWEST_ROWS * around.shape[1]:
        return command
    around = (around - around.mean(0)) / around.std(0).clamp(min=1e-300)
    known = torch.cat((torch.ones_like(around[:, :1]), around), 1)
    return known @ torch.linalg.lstsq(known, command).solution


def _noise(commands: Sequence[Tensor]) -> Tensor:
    """(n,) variances of what is new in each row of commands (T, n), from the medians of their third differences: 0 of
    commands that are held for rows, and nearly so of smooth ones."""
    third = torch.cat([each.diff(n=3, dim=0) for each in commands]).abs()
    if not len(third):
        return third.new_zeros(third.shape[1])
    # The squares of the coefficients 1, 3, 3 and 1 sum to 20; half of a normal distribution is within 0.6745.
    return (third.median(0).values / 0.6745).square() / 20

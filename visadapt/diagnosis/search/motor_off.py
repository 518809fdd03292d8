"""The end of an episode in which commands are logged that no longer act: the motor was switched off before the log.

The motion shows it: from there on, accelerations are those without a command, though the commands, as no motion answers
them, are large. A machine that is held, by a stop or a hand, looks the same, and tells as little.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from visadapt.diagnosis.search.inverse_dynamics import Motion
from visadapt.diagnosis.search.unexplained_load import bare_motions
from visadapt.recordings import Recording
from visadapt.systems import System

SHORTEST_OFF = 0.6  # Prediction times in which commands of such an end are stronger than usual, at least
LATEST_START = 0.97
"""Share of what the whole end speaks for a motor that is off, that the end from its first row on still does: before,
small commands say nothing."""
LEAST_SHARE = 0.5  # of the episode in which the motor is on
LARGEST_ERROR = 0.1
"""Squared error of the accelerations without commands, over that with them, up to which commands do not act."""
LEAST_ERROR = 2.0  # Squared error with commands, over the usual square of what commands do in the episode
MEAN_PER_MEDIAN = 2.2  # Mean over median of squares of normal numbers: a few large commands are not the usual ones
EARLIEST = 1.0
"""Prediction times by which the rows that are left out begin before the commands are seen not to act, at most: rows in
which small commands leave open whether they do."""
LEAST_RISE = 4.0
"""Mean square of what the commands at the end would do, over that before: smaller ones dry friction may hold."""


def without_idle_ends(recording: Recording, system: System) -> Recording:
    """The recording with each episode up to where its commands no longer act; a warning says of which."""
    motions = bare_motions(recording, system)
    if not motions:
        return recording
    episodes, usable, told = [], [], []
    parts = zip(recording.episodes, recording.sources, motions, strict=True)
    for number, (episode, source, motion) in enumerate(parts):
        off = None if motion is None else _off_from(motion)
        rows = slice(None if off is None else int(np.searchsorted(episode.time, off)))
        episodes.append(episode.part(rows))
        usable += [recording.usable[number][rows]] if recording.usable else []
        if off is not None:
            told.append(
                f"{source}: from {off:.3g} s on its commands do not act, as where a motor is switched off or the "
                "machine held: these rows were left out"
            )
    if not told:
        return recording
    warnings = (*recording.warnings, *told)
    return replace(recording, episodes=tuple(episodes), usable=tuple(usable), warnings=warnings)


def _off_from(motion: Motion) -> float | None:
    """Time, in s since the episode began, from which its commands no longer act; None where they do to the end."""
    idle = replace(motion, acting=torch.zeros_like(motion.acting)).by_world[0]
    by_command, moved = motion.smooth(motion.by_world[0] - idle), motion.smooth(motion.measured - idle)
    # Squares, over the usual one of what commands do.
    usual = MEAN_PER_MEDIAN * by_command.square().median(0).values.clamp(min=1e-300)
    strength, with_it, without = ((each.square() / usual).mean(1) for each in (by_command, moved - by_command, moved))
    gain = with_it / (1 + with_it) - without / (1 + without)  # a stop that is hit counts as one row, not as its force
    from_here = gain.flip(0).cumsum(0).flip(0)
    if not bool(from_here.max() > 0):
        return None
    first = int((from_here >= LATEST_START * from_here.max()).nonzero()[-1])
    unit = motion.world.system.prediction_time
    strong = (strength > 1) & (torch.arange(len(gain)) >= first)
    if first < LEAST_SHARE * len(gain) or int(strong.sum()) * motion.period < SHORTEST_OFF * unit:
        return None
    wrong = float(with_it[strong].median())
    stronger = float(strength[first:].mean()) > LEAST_RISE * float(strength[:first].mean())
    if not stronger or wrong < LEAST_ERROR or float(without[strong].median()) > LARGEST_ERROR * wrong:
        return None
    evident = strong & (without < LARGEST_ERROR * with_it)
    likeliest, surely = float(motion.time[from_here.argmax()]), float(motion.time[evident.nonzero()[0, 0]])
    return max(likeliest, surely - EARLIEST * unit)

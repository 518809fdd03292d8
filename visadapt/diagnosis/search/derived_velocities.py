"""Velocities in a recording that were differentiated from positions instead of measured."""

from __future__ import annotations

from visadapt.diagnosis.search.search import Search
from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments
from visadapt.systems import System

MAX_LAG = 0.2
"""Largest lag, in periods, of a measured velocity behind the slope of its position; backward differences lag by 0.5."""


def derived_velocities(system: System, rows: Segments) -> dict[str, float]:
    """Names of velocities that lag behind the slope of their position, with the lag in s.

    Differences of past positions lag, and filtered ones do more. Position and slope are those of the states that the
    source fits to the positions alone.
    """
    position_of = profile_of(system).position_of
    positions = [k for k, channel in enumerate(rows.channels) if channel not in position_of]
    velocities = [k for k, channel in enumerate(rows.channels) if position_of.get(channel) in rows.channels]
    if not velocities:
        return {}
    state = Search(system, rows.with_channels(positions), ()).source.fits.state[0]
    inside = rows.inside[:, 2:] * rows.inside[:, :-2]
    out = {}
    for k in velocities:
        velocity = state[..., rows.channels[k]]
        acceleration = (velocity[:, 2:] - velocity[:, :-2]) / (2 * rows.period)
        used = inside * rows.used[:, 1:-1, k]
        error = rows.measured[:, 1:-1, k] - velocity[:, 1:-1]
        # Least squares of error = -lag acceleration.
        lag = float(-(error * acceleration * used).sum() / (acceleration.square() * used).sum())
        if lag > MAX_LAG * rows.period:
            out[system.states[rows.channels[k]].name] = lag
    return out

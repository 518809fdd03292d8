"""The integration step that a recording needs: as short as its fastest motion asks for."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from visadapt.estimation.profiles import profile_of
from visadapt.estimation.segments import Segments, initial_states
from visadapt.systems import System
from visadapt.systems.integrators import steps_within
from visadapt.world import World

LARGEST_ERROR = 1e-5
"""Root mean square error of integration over a row, as a share of the state's scale: of half a turn, a fifteenth of the
error of an encoder of 4,096 counts."""

MOST_SUBSTEPS = 32  # In a row


def with_longest_step(rows: Segments, system: System) -> Segments:
    """The rows with the longest step in which Runge-Kutta follows the motion that they show.

    The profile's step is that of small motions. In large ones, products of velocities change faster; in its step, an
    effect that is integrated in shorter ones would look as if it acted.
    """
    longest = float(rows.held.max())
    usual = count = steps_within(longest, profile_of(system).longest_step)
    state = initial_states(rows, system)[:, :-1]
    used = (rows.inside[:, 1:] > 0).flatten()
    start = state.flatten(0, 1)[used]
    command, (time, duration) = rows.given[:, :-1].flatten(0, 1)[used], (each[used] for each in rows.clock)
    scale = torch.tensor([variable.scale for variable in system.states], dtype=torch.float64)

    def ahead(substeps: int) -> torch.Tensor:
        world = World(system, (), rows.period, "rk4", substeps)
        held = command[:, None].expand(-1, substeps, -1)
        return world.integrate(time, start, held, duration)

    with torch.inference_mode():
        coarse = ahead(count)
        while count < MOST_SUBSTEPS:
            fine = ahead(2 * count)
            error = ((fine - coarse) / scale).square().mean(0).sqrt()
            if not bool(error.isfinite().all()) or float(error.max()) < LARGEST_ERROR:
                break
            count, coarse = 2 * count, fine
    return replace(rows, longest_step=longest / count if count > usual else math.inf)

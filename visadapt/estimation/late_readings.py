"""Readings of late sensors from the present state: the motion is integrated back to the instant at which they read it.

So a reading depends on one state alone, as the Kalman filter needs it, while a simulated sensor remembers rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.batch import Batch
from visadapt.effects.late_sensors import LateSensors
from visadapt.world import World


@dataclass(frozen=True)
class Past(Batch):
    """What led to N states: the K periods before each, the latest first."""

    time: Tensor  # (N,) s since the episode began
    command: Tensor  # (N, K, n_action) that acted
    duration: Tensor  # (N, K) s; what is earlier than all K of them is taken to belong to the last one


def reading(world: World, state: Tensor, past: Past | None) -> Tensor:
    """What sensors read (N, n_state) of N states; without a past, as at the start of an episode."""
    seen = state
    for effect in world.effects:
        if isinstance(effect, LateSensors) and past is not None:
            earlier = _earlier(world, state, past, effect.value("delay", state))
            seen = seen.clone()
            seen[:, effect.late] = earlier[:, effect.late]
    return world.reading(seen)


def _earlier(world: World, state: Tensor, past: Past, delay: Tensor) -> Tensor:
    """The states (N, n_state) `delay` s, () or (N,), earlier.

    Before the episode its first command is taken to have acted: a log begins while the machine moves.
    """
    left, time = delay.expand_as(past.time), past.time
    last = past.command.shape[1] - 1
    for k, (command, duration) in enumerate(zip(past.command.unbind(1), past.duration.unbind(1), strict=True)):
        back = left if k == last else torch.minimum(left, duration)
        state = world.integrate(time, state, command[:, None].expand(-1, world.substeps, -1), -back)
        left, time = left - back, time - back
    return state

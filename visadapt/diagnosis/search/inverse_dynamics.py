"""The motion of an episode, at even instants, and the loads that it takes (inverse dynamics).

Readings of positions are smoothed and differentiated twice, those of velocities whose joint has no position once; these
accelerations, divided by the acceleration per unit of load, are loads (Khalil and Dombre 2002, Modeling, Identification
and Control of Robots, chapter 12).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv1d, pad

from visadapt.effects import Effect
from visadapt.recordings import Episode
from visadapt.world import World, WorldState

GAUSSIAN_REACH = 4  # Deviations at which a smoothing Gaussian is cut off

SMOOTHING = 0.13
"""Deviation of the Gaussian that smooths the load, as a share of the prediction time; one period if that is longer."""

DENSE = 5.0  # Instants within a deviation of the smoothing, from which on they are dense

SHORTEST = 25  # Length over the smoothing's deviation below which an episode tells nothing of pushes


@dataclass(frozen=True)
class Motion:
    """An episode at T instants, a period apart, and the world that is to explain it."""

    world: World
    period: float  # s
    smoothing: float  # s, deviation of the Gaussian that smooths its loads
    time: Tensor  # (T,) s since the episode began
    state: Tensor
    """(T, n) of positions slightly smoothed, and velocities that are their rates; of joints without a position, of
    velocities slightly smoothed"""
    acting: Tensor  # (T, n_action) commands as the world makes them act
    measured: Tensor  # (T, J) accelerations of the joints

    @property
    def velocities(self) -> list[int]:
        """The joints' columns of velocities."""
        return [velocity for _, velocity in self.world.system.coordinates]

    @cached_property
    def commanded(self) -> Tensor:
        """(T, n_action) commands that act, slightly smoothed."""
        return self.smooth(self.acting, 0.1)

    def smooth(self, values: Tensor, deviations: float = 1.0) -> Tensor:
        """Values (T, M) smoothed by a Gaussian of as many of the loads' smoothing deviations."""
        return smoothed(values, deviations * self.smoothing / self.period)

    def rate(self, values: Tensor) -> Tensor:
        """Derivative by time of values (T, ...): central differences of three instants, and where they are DENSE of
        five, but at the ends and next to them.

        Three lose 3 % of an oscillation at a fifteenth of the rate of the instants; the mean of its products, as in a
        centrifugal force, would then look like a push. Five are noisier, which matters where few are smoothed together.
        """
        out = torch.gradient(values, spacing=self.period, dim=0)[0]
        if self.smoothing > DENSE * self.period:
            near, far = values[3:-1] - values[1:-3], values[4:] - values[:-4]
            out[2:-2] = (8 * near - far) / (12 * self.period)
        return out

    def acceleration(self, state: Tensor, acting: Tensor) -> Tensor:
        """(T, J) accelerations of the joints by the world."""
        at = WorldState(self.time, state, ())
        return self.world.system_at(at).accelerations(state, acting, self.world.load(at))

    def without_dry_friction(self) -> Motion:
        """The same motion in a world without dry friction, whose load jumps where a joint turns round."""
        named = [effect for effect in self.world.effects if isinstance(effect, Effect)]
        kept = [effect for effect in named if not effect.rubs()]
        return replace(self, world=self.world.with_effects(kept))

    @cached_property
    def by_world(self) -> tuple[Tensor, Tensor]:
        """(T, J) accelerations of the joints by the world, and (T, J, J) their change per unit of each load."""
        at = WorldState(self.time, self.state, ())
        return self.world.system_at(at).response_to_loads(self.state, self.acting, self.world.load(at))

    def by_system(self, **parameters: Any) -> tuple[Tensor, Tensor]:
        """The same by the world's bare system under its loads, with other values of some `parameters`."""
        bare: Any = self.world.system
        load = self.world.load(WorldState(self.time, self.state, ()))
        return replace(bare, **parameters).response_to_loads(self.state, self.acting, load)

    def loads(self, acceleration: Tensor) -> Tensor:
        """Loads (T, J) that give the joints of the world an acceleration (T, J); not finite where none would."""
        return torch.linalg.solve_ex(self.by_world[1], acceleration[..., None])[0][..., 0]

    def dry_friction(self) -> Tensor:
        """(T, J) the dry friction of the world at rest: half of the jump of its load where a joint turns round."""
        columns = torch.tensor(self.velocities)
        forward, backward = (
            self.world.load(WorldState(self.time, self.state.index_fill(1, columns, speed), ()))
            for speed in (1e-9, -1e-9)
        )
        return (backward - forward).clamp(min=0) / 2


def acting_in(episode: Episode, world: World, period: float) -> Tensor:
    """(T, n_action) what acts after each row of an episode from its start on, the mean until the next row."""
    stamps, given = (torch.as_tensor(values, dtype=torch.float64) for values in (episode.time, episode.action))
    return world.actuate(given[None], _held(stamps, period)[None])[0].mean(1)


def motion_of(episode: Episode, acts: Tensor, world: World, measured: Sequence[int], period: float) -> Motion | None:
    """The motion of an episode, or a part of one, of readings of the columns `measured`, under what `acts`
    (T, n_action) in its rows; None of one that is too short."""
    stamps, readings = (torch.as_tensor(values, dtype=torch.float64) for values in (episode.time, episode.state))
    smoothing = max(SMOOTHING * world.system.prediction_time, period)
    stamps = stamps.contiguous()
    time = torch.arange(float(stamps[0]), float(stamps[-1]), period, dtype=torch.float64)
    if len(time) * period < SHORTEST * smoothing:
        return None
    state = torch.zeros(len(time), len(world.system.states), dtype=torch.float64)
    after = torch.searchsorted(stamps, time, right=True).clamp(1, len(stamps) - 1)
    share = (time - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
    for k, column in enumerate(measured):
        state[:, column] = torch.lerp(readings[after - 1, k], readings[after, k], share)
    acting = _mean_commands(acts, stamps, _held(stamps, period), time, period)
    motion = Motion(world, period, smoothing, time, state, acting, torch.zeros(0))
    read = [velocity if position is None else position for position, velocity in world.system.coordinates]
    once = motion.smooth(state[:, read], 0.1)
    # What smoothing takes from fast motion is given back: "twicing" (Tukey 1977, Exploratory Data Analysis, ch. 16).
    state[:, read] = once + motion.smooth(state[:, read] - once, 0.1)
    for position, velocity in world.system.coordinates:
        if position is not None:
            state[:, velocity] = motion.rate(state[:, position])
    return replace(motion, measured=motion.rate(state[:, motion.velocities]))


def _held(stamps: Tensor, period: float) -> Tensor:
    """(T,) s from each of the stamps (T,) to the next; a period after the last."""
    return torch.cat((stamps.diff(), stamps.new_tensor([period])))


def _mean_commands(acting: Tensor, stamps: Tensor, held: Tensor, time: Tensor, period: float) -> Tensor:
    """Means (N, n_action) over a period about each of N instants `time`, of what acts (T, n_action) for `held` (T,) s
    from `stamps` (T,) on.

    On an unsteady clock the command at the instant itself would jump by up to a period against the motion.
    """
    edges = torch.cat((stamps, stamps[-1:] + held[-1:]))
    total = pad((acting * held[:, None]).cumsum(0), (0, 0, 1, 0))
    ends = torch.stack((time - period / 2, time + period / 2)).clamp(edges[0], edges[-1])
    row = (torch.searchsorted(edges, ends, right=True) - 1).clamp(0, len(stamps) - 1)
    until = total[row] + acting[row] * (ends - edges[row])[..., None]
    return (until[1] - until[0]) / (ends[1] - ends[0])[:, None]


def smoothed(values: Tensor, deviation: float, edge: int = 0, stride: int = 1) -> Tensor:
    """Values (T, M) smoothed by a Gaussian of this deviation in rows; beyond the ends, point-reflected.

    Every `stride`-th row is given, without the first and the last `edge` rows.
    """
    half_width = math.ceil(GAUSSIAN_REACH * deviation)
    lags = torch.arange(-half_width, half_width + 1, dtype=values.dtype)
    kernel = torch.exp(-0.5 * (lags / max(deviation, 1e-6)).square())
    first, last = values[:1], values[-1:]
    before, beyond = 2 * first - values[1 : half_width + 1].flip(0), 2 * last - values[-half_width - 1 : -1].flip(0)
    padded = torch.cat((before, values, beyond))[edge : len(values) + 2 * half_width - edge].T[:, None]
    return conv1d(padded, (kernel / kernel.sum())[None, None], stride=stride)[:, 0].T

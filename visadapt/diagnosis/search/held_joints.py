"""Stretches in which a joint is held by what no model has, a stop, the bench or a hand, or in which its sensor is dead.

There the joint stands still, or its readings do, against a load that would move it, by the commands and gravity. Dry
friction holds it too, but brakes it wherever else it moves; what a stretch needs is therefore compared with the loads
in the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from visadapt.diagnosis.search.inverse_dynamics import Motion
from visadapt.diagnosis.search.unexplained_load import bare_motions
from visadapt.recordings import Episode, Recording
from visadapt.recordings.runs import runs
from visadapt.recordings.stretches import stretches_of
from visadapt.systems import System

SHORTEST, SHORTEST_AT_END = 1.5, 1.0
"""Prediction times that a joint stands still, at least; and where it does so to the end of its episode."""
SLOW = 0.3  # Acceleration of a joint that stands still, over that by the load that would hold it, at most
STILL = 0.1  # Prediction times in which that load would give it the speed that it has, at most
SLOWER = 0.3
"""Mean speed in a stretch over the median elsewhere, of what is not much slower, at most: a joint that balances another
body, whose mass is not the simulator's, keeps its usual speed."""
LONGEST_GAP = 0.2  # Prediction times for which a joint may look moved while it is held, as where its load passes zero
MUCH = 3.0
"""Load that holds a joint, over its dry friction and over what is left unexplained elsewhere, at least."""
LEAST_OTHER = 0.5  # Share of that load which is no function of its motion, as friction and a spring are, at least
DEAD = 4.0  # Prediction times for which a dead sensor repeats a reading, at least
LONGEST_RUN = 5.0  # That time over the longest other run of equal readings, at least: a frozen zone is entered often
VISIBLE = 20.0  # Way in half a squared prediction time by the load, over the noise of the readings, at least
HIT = 0.5  # Load beside a stretch, over that in it, from which on it belongs to it: hitting a stop, or being let go
LONGEST_HIT = 0.5  # Prediction times between two such loads, at most
AROUND = 2.0  # Prediction times on either side of a stretch with which it is not compared
MARGIN = 0.1  # Prediction times that are left out on either side with it
SHORTEST_REST = 2.0  # Prediction times of what is left between two stretches, at least


@dataclass(frozen=True)
class _Held:
    """A stretch in which a joint, or its reading, stands still."""

    first: int  # instant of its episode's motion
    last: int  # the one after the last
    repeats: bool = False  # whether the joint's readings are all equal


@dataclass(frozen=True)
class _Joint:
    """One joint's motion in an episode at T instants, and the load that it needs beyond the bare world."""

    motion: Motion
    episode: Episode
    index: int
    read: int  # column of the readings

    @property
    def unit(self) -> float:
        """The system's prediction time in s."""
        return self.motion.world.system.prediction_time

    @property
    def readings(self) -> NDArray[np.float64]:
        """(rows,) of its position, or where it has none of its velocity."""
        return np.asarray(self.episode.state, np.float64)[:, self.read]

    @cached_property
    def velocity(self) -> Tensor:
        """(T,) smoothed."""
        return self.motion.smooth(self.motion.state[:, self.motion.velocities])[:, self.index]

    @cached_property
    def needed(self) -> Tensor:
        """(T,) load beyond the world's, smoothed, in N or N m."""
        return self.motion.smooth(self.motion.loads(self.motion.measured - self.motion.by_world[0]))[:, self.index]

    @cached_property
    def by_motion(self) -> Tensor:
        """(T, 4) what the loads of friction and a spring are proportional to: the sign of its velocity, turned round,
        its velocity, its position, and a constant."""
        velocity, column = self.velocity, self.motion.world.system.coordinates[self.index][0]
        position = torch.zeros_like(velocity) if column is None else self.motion.state[:, column]
        return torch.stack((-velocity.sign(), velocity, position, torch.ones_like(velocity)), 1)

    def moving(self) -> Tensor:
        """(T,) whether it is known to be as fast as usual: what it needs while slower, friction may be."""
        return (self.velocity.abs() >= self.velocity.abs().nanmedian() / 2) & self.needed.isfinite()

    @cached_property
    def freed(self) -> Tensor:
        """(T,) amount of the acceleration that the joint would have without that load."""
        return (self.needed * self.motion.by_world[1][:, self.index, self.index]).abs()

    def still(self) -> Iterator[_Held]:
        """The stretches in which the joint stands still."""
        slow = self.motion.smooth(self.motion.measured)[:, self.index].abs() < SLOW * self.freed
        still = (slow & (self.velocity.abs() < STILL * self.unit * self.freed)).numpy()
        period = self.motion.period
        for first, last in list(runs(still)):
            inside = first > 0 and last < len(still)
            if not still[first] and inside and (last - first) * period < LONGEST_GAP * self.unit:
                still[first:last] = True
        for first, last in runs(still):
            at_end = len(still) - last < self.unit / period
            if still[first] and (last - first) * period >= (SHORTEST_AT_END if at_end else SHORTEST) * self.unit:
                yield _Held(first, len(still) if at_end else last)

    def repeated(self) -> Iterator[_Held]:
        """The run of equal readings of a dead sensor."""
        values = self.readings
        lasting = sorted(runs(values), key=lambda run: run[0] - run[1])
        first, last = lasting[0]
        second = lasting[1][1] - lasting[1][0] if len(lasting) > 1 else 0
        time = self.episode.time
        if last - first < LONGEST_RUN * second or time[last - 1] - time[first] < DEAD * self.unit:
            return
        rows = np.searchsorted(self.motion.time.numpy(), [time[first], time[last - 1]])
        held = _Held(int(rows[0]), min(int(rows[1]) + 1, len(self.needed)), repeats=True)
        way = float(self.freed[held.first : held.last].mean()) * self.unit**2 / 2
        departs = np.abs(np.diff(values, 2))
        noise = float(np.median(departs[departs > 0])) if (departs > 0).any() else 0.0
        if way > VISIBLE * noise:
            yield held

    def load(self, held: _Held) -> float:
        """Mean amount of the load in a stretch."""
        return float(self.needed[held.first : held.last].abs().mean())

    def apart_from(self, held: list[_Held]) -> Tensor:
        """(T,) whether an instant is far from these stretches."""
        out, reach = torch.ones(len(self.needed), dtype=torch.bool), round(AROUND * self.unit / self.motion.period)
        for each in held:
            out[max(0, each.first - reach) : each.last + reach] = False
        return out

    def left_out(self, held: _Held) -> NDArray[np.bool_]:
        """Rows of the episode within a stretch, or next to it under loads that belong to it."""
        time = self.motion.time
        if held.repeats:
            return (self.episode.time >= time[held.first].numpy()) & (self.episode.time <= time[held.last - 1].numpy())
        strong = time[self.needed.abs() > HIT * self.load(held)].tolist()
        start, end = float(time[held.first]), float(time[held.last - 1])
        for at in reversed(strong):
            if start - LONGEST_HIT * self.unit <= at < start:
                start = at
        for at in strong:
            if end < at <= end + LONGEST_HIT * self.unit:
                end = at
        if end > float(time[-1]) - self.unit:
            end = np.inf
        margin = MARGIN * self.unit
        return (self.episode.time >= start - margin) & (self.episode.time <= end + margin)

    def told(self, source: str, held: _Held) -> str:
        """The warning of a stretch."""
        system, time = self.motion.world.system, self.motion.time
        position, velocity = system.coordinates[self.index]
        state = system.states[velocity if position is None else position]
        reading = float(np.interp(float(time[held.first]), self.episode.time, self.readings))
        needed = f"though {self.load(held):.2g} {system.loads[self.index].unit} would move it"
        what = (
            f"reads {reading:.4g} {state.unit} in each row, {needed}: its sensor is dead, or it is held"
            if held.repeats
            else f"stands still at {reading:.3g} {state.unit}, {needed}, as on a stop or in a hand"
        )
        start, end = float(time[held.first]), float(time[held.last - 1])
        return f"{source}: from {start:.3g} to {end:.3g} s {state.name} {what}; these rows were left out"


def without_held_joints(recording: Recording, system: System, before: int) -> Recording:
    """The recording without the stretches in which a joint is held; a warning says of which.

    Args:
        before: rows before each stretch that is kept whose commands are still used.
    """
    motions = bare_motions(recording, system)
    bad, told = [np.zeros(len(episode.time), bool) for episode in recording.episodes], []
    for index, (position, velocity) in enumerate(system.coordinates):
        name = system.states[velocity if position is None else position].name
        joints = {
            number: _Joint(motion, recording.episodes[number], index, recording.measured.index(name))
            for number, motion in enumerate(motions)
            if motion is not None
        }
        for number, held in _held(joints):
            bad[number] |= joints[number].left_out(held)
            told.append(joints[number].told(recording.sources[number], held))
    if not told:
        return recording
    shortest = SHORTEST_REST * system.prediction_time / recording.period
    kept = [
        (number, slice(first, last))
        for number, rows in enumerate(bad)
        for first, last in runs(rows)
        if not rows[first] and last - first >= min(shortest, len(rows))
    ]
    return replace(stretches_of(recording, kept, before), warnings=(*recording.warnings, *told)) if kept else recording


def _held(joints: dict[int, _Joint]) -> list[tuple[int, _Held]]:
    """The stretches in which a joint is held, with the number of its episode, one of those of `joints`."""
    possible = {number: list(joint.repeated()) or list(joint.still()) for number, joint in joints.items()}
    apart = [joint.moving() & joint.apart_from(possible[number]) for number, joint in joints.items()]
    if not any(possible.values()) or not any(bool(rows.any()) for rows in apart):
        return []
    needed = torch.cat([joint.needed[rows] for joint, rows in zip(joints.values(), apart, strict=True)])
    by_motion = torch.cat([joint.by_motion[rows] for joint, rows in zip(joints.values(), apart, strict=True)])
    weights = torch.linalg.lstsq(by_motion, needed[:, None]).solution
    dry_friction, left = float(weights[0]), float(needed.square().mean().sqrt())
    usual = float(by_motion[:, 1].abs().median())
    found = []
    for number, held in ((number, held) for number, every in possible.items() for held in every):
        joint, load = joints[number], joints[number].load(held)
        rows = slice(held.first, held.last)
        other = float((joint.needed[rows] - (joint.by_motion[rows] @ weights)[:, 0]).mean().abs())
        # Equal readings have no noise, of which the loads elsewhere consist in part.
        least = MUCH * (dry_friction if held.repeats else max(dry_friction, left))
        stands = float(joint.velocity[rows].abs().nanmean()) < SLOWER * usual
        if load > least and (held.repeats or (stands and other > LEAST_OTHER * load)):
            found.append((number, held))
    return found

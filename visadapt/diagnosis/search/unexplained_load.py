"""The load that a motion takes beyond what a world explains, over whole episodes, and what else may explain it.

It is that of the inverse dynamics (inverse_dynamics.py) beyond the world's, smoothed; beside it stand the columns that
state and command may explain (load_columns.py), smoothed alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.diagnosis.search.inverse_dynamics import GAUSSIAN_REACH, Motion, acting_in, motion_of, smoothed
from visadapt.diagnosis.search.load_columns import SLOW, columns_of
from visadapt.diagnosis.search.unexplained import SmoothFunction
from visadapt.recordings import Episode, Recording
from visadapt.recordings.runs import runs
from visadapt.systems import System
from visadapt.world import World

EDGE = GAUSSIAN_REACH + 0.2
"""Deviations of the smoothing that are left out at either end, where it reaches beyond the recording; positions are
smoothed too."""

STEP = 0.08
"""Share of the prediction time between the instants at which the load is given; one period if that is longer."""

LONGEST = 300  # Instants in a part: what drifts is fitted part by part, and the work grows with its square

MOST_POWER = 9.0
"""Squared loads, over the square of their unit, that count when it is found: it is the size of a model's errors, and a
strong push must not make larger errors probable."""

SIZE_ROUNDS = 30  # in which the unit is found

KNOWN_SIZE = 3.0
"""Size of the columns of a function that is known to act: as large weights are as probable as small ones of others."""


@dataclass(frozen=True)
class LoadTrack:
    """The unexplained loads on J joints over an episode or a part of it, at N instants; all smoothed alike."""

    episode: int
    time: Tensor  # (N,) s since the episode began
    unit: Tensor  # (J,) usual size of each joint's load over the recording, in its own unit: N or N m
    load: Tensor  # (N, J) in these units
    columns: Tensor
    """(K, N, J) loads that state and command may explain, of unit root mean square over the recording; those of a
    function that is known to act, which are last, of KNOWN_SIZE"""
    reaction: Tensor
    """(K, N, J, J) change of the columns, which follow the modelled motion, per unit of load that nothing explains"""
    dry: tuple[int, ...]  # the column of each joint's dry friction
    friction: Tensor  # (N, J) dry friction that the world has, which the load may lack where a joint sticks
    at_rest: Tensor  # (N, J) from 0 to 1: whether a joint is so slow that it may stick
    activity: Tensor  # (N, F) logs of speeds, accelerations and changes of commands, with which errors grow
    smoothing: float  # s, deviation of the smoothing Gaussian

    def parts(self) -> list[LoadTrack]:
        """In parts of about LONGEST instants."""
        count = max(1, round(len(self.time) / LONGEST))
        edges = [round(k * len(self.time) / count) for k in range(count + 1)]
        return [
            replace(
                self,
                time=self.time[a:b],
                load=self.load[a:b],
                columns=self.columns[:, a:b],
                reaction=self.reaction[:, a:b],
                friction=self.friction[a:b],
                at_rest=self.at_rest[a:b],
                activity=self.activity[a:b],
            )
            for a, b in pairwise(edges)
        ]


def load_tracks(recording: Recording, worlds: Sequence[World], known: SmoothFunction | None = None) -> list[LoadTrack]:
    """The unexplained loads in each episode that is long enough; none where `unread_states` has any.

    Args:
        worlds: what explains each episode.
        known: a load that acts as a function of states, beyond those of the worlds.
    """
    system = worlds[0].system
    if not has_joints(system) or unread_states(recording, system):
        return []
    measured = [system.index(name) for name in recording.measured]
    found = [
        part
        for number, (episode, world) in enumerate(zip(recording.episodes, worlds, strict=True))
        for motion in _motions(episode, _measured(recording, number), world, measured, recording.period)
        for part in _track(number, motion, known)
    ]
    if not found:
        return []
    unit = _usual_size(torch.cat([track.load for track in found]))
    unit = torch.where(unit > 0, unit, 1.0)
    # Only over a unit of its own for each joint do the loads of a slide and a hinge compare.
    columns = [(track.columns / unit).square().flatten(1) for track in found]
    size = (torch.cat(columns, 1).mean(1).sqrt() + 1e-300)[:, None, None]
    if known is not None:
        size[-known.terms :] /= KNOWN_SIZE
    return [
        replace(
            track,
            unit=unit,
            load=track.load / unit,
            columns=track.columns / unit / size,
            reaction=track.reaction * unit / unit[:, None] / size[..., None],
            friction=track.friction / unit,
        )
        for track in found
    ]


def unread_states(recording: Recording, system: System) -> list[str]:
    """What the unexplained load needs and no sensor read: positions of joints, velocities of those that have no
    position, and states that belong to no joint."""
    if not has_joints(system):
        return []
    of_joints = [velocity if position is None else position for position, velocity in system.coordinates]
    needed = [system.states[column].name for column in (*of_joints, *system.outside_joints())]
    return [name for name in needed if name not in recording.measured]


def has_joints(system: System) -> bool:
    """Whether each load acts on a joint, as on no aircraft's body."""
    return len(system.coordinates) == len(system.loads)


def bare_motions(recording: Recording, system: System) -> list[Motion | None]:
    """The motion of each episode in the bare system's world, None of one that is too short; none where `unread_states`
    has any, or the system has no joints."""
    if not has_joints(system) or unread_states(recording, system):
        return []
    world, measured = World(system, (), recording.period).double(), [system.index(name) for name in recording.measured]
    period = recording.period
    return [motion_of(one, acting_in(one, world, period), world, measured, period) for one in recording.episodes]


def _usual_size(load: Tensor) -> Tensor:
    """(J,) root mean square of loads (N, J), of which larger ones count as MOST_POWER says."""
    power = load.square()
    usual = power.mean(0)
    for _ in range(SIZE_ROUNDS):
        usual = torch.minimum(power, MOST_POWER * usual).mean(0)
    return usual.sqrt()


def _measured(recording: Recording, number: int) -> Iterator[slice]:
    """The stretches of an episode whose readings are usable."""
    if not recording.usable:
        yield slice(None)
        return
    whole = np.logical_and.reduce(recording.usable[number], axis=1)
    for start, end in runs(whole):
        if whole[start] and end - start > 1:
            yield slice(start, end)


def _motions(
    episode: Episode, stretches: Iterable[slice], world: World, measured: Sequence[int], period: float
) -> Iterator[Motion]:
    """The motions in those stretches of an episode that are long enough."""
    acts = acting_in(episode, world, period)  # also of the commands before a stretch
    for rows in stretches:
        motion = motion_of(episode.part(rows), acts[rows], world, measured, period)
        if motion is not None:
            yield motion


def _track(number: int, motion: Motion, known: SmoothFunction | None) -> list[LoadTrack]:
    world, period = motion.world, motion.period
    found = columns_of(motion, known)
    fastest = torch.tensor([world.system.states[v].largest for v in motion.velocities], dtype=torch.float64)
    velocity = motion.state[:, motion.velocities]
    at_rest = motion.smooth((-(_slowest(velocity) / (SLOW * fastest)).square()).exp())
    edge, stride = round(EDGE * motion.smoothing / period), max(1, round(STEP * world.system.prediction_time / period))
    inner = slice(edge, len(motion.time) - edge, stride)
    both = torch.cat((found.load[:, None], found.columns), 1)
    smooth = smoothed(both.flatten(1), motion.smoothing / period, edge, stride).unflatten(1, both.shape[1:])
    whole = LoadTrack(
        number,
        motion.time[inner],
        torch.ones_like(smooth[0, 0]),
        smooth[:, 0],
        smooth[:, 1:].movedim(1, 0),
        found.reaction[inner].movedim(1, 0),
        found.dry,
        motion.dry_friction()[inner],
        at_rest[inner],
        _activity(motion, fastest)[inner],
        motion.smoothing,
    )
    return whole.parts()


def _activity(motion: Motion, fastest: Tensor) -> Tensor:
    """(T, F) logs of accelerations, of speeds over the `fastest` (J,), and of the changes of commands."""
    largest = torch.tensor([action.largest for action in motion.world.system.actions], dtype=torch.float64)
    stormy = motion.smooth(motion.measured.abs(), 2)
    speeds = motion.smooth(motion.state[:, motion.velocities].abs(), 2)
    changes = motion.smooth(motion.rate(motion.commanded).abs(), 2)
    return torch.cat(
        (
            (stormy / stormy.mean(0).clamp(min=1e-300) + 0.1).log(),
            (speeds / fastest + 0.03).log(),
            (changes / largest + 0.3).log(),
        ),
        1,
    )


def _slowest(velocity: Tensor) -> Tensor:
    """The least speeds (T, J) of each joint from the row before to the row after; 0 where it turns round."""
    three = pad(velocity.T[None], (1, 1), mode="replicate")[0].T.unfold(0, 3, 1)
    reverses = three.amin(-1) * three.amax(-1) <= 0
    return three.abs().amin(-1).masked_fill(reverses, 0.0)

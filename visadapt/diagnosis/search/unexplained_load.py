"""The load that a motion takes beyond what a world explains, over whole episodes, and what else may explain it.

Readings of positions are smoothed and differentiated twice. The accelerations less those of the world, divided by the
acceleration per unit of load, are the unexplained load (inverse dynamics; Khalil and Dombre 2002, chapter 12). It is
linear in the errors that a world may have: in friction, the commands' gain and delay, the parameters, the zero of a
sensor, a compliant drive. For each of these there is a column of loads. Columns follow the accelerations of the world,
not the measured ones: along these, a factor common to all columns could explain a push away.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv1d, pad

from visadapt.diagnosis.search.unexplained import SmoothFunction
from visadapt.effects import DynamicsEffect, Effect
from visadapt.effects.own.dynamics import scalable
from visadapt.recordings import Episode, Recording
from visadapt.recordings.runs import runs
from visadapt.systems import System
from visadapt.world import World, WorldState

GAUSSIAN_REACH = 4  # Deviations at which a smoothing Gaussian is cut off

SMOOTHING = 0.065  # s, deviation of the Gaussian that smooths the load, or one period if that is longer

EDGE = GAUSSIAN_REACH + 0.2
"""Deviations of the smoothing that are left out at either end, where it reaches beyond the recording; positions are
smoothed too."""

STEP = 0.04  # s between the instants at which the load is given, or one period if that is longer

SHORTEST = 25  # Length over the smoothing's deviation below which an episode tells nothing of pushes

LONGEST = 300  # Instants in a part: what drifts is fitted part by part, and the work grows with its square

SLOW = 0.01  # Speed over the largest of its range below which a joint may stick

SLACK = 0.1  # Command over the largest of its range at which the play of a drive is taken up

KNOWN_SIZE = 3.0
"""Size of the columns of a function that is known to act: as large weights are as probable as small ones of others."""

DIFFERENCE = 1e-4  # Finite difference of a state in its unit, and of the log of a parameter


@dataclass(frozen=True)
class LoadTrack:
    """The unexplained loads on J joints over an episode or a part of it, at N instants; all smoothed alike."""

    episode: int
    time: Tensor  # (N,) s since the episode began
    unit: Tensor  # (J,) root mean square of each joint's load over the recording, in its own unit: N or N m
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


def load_tracks(recording: Recording, world: World, known: SmoothFunction | None = None) -> list[LoadTrack]:
    """The unexplained loads in each episode that is long enough; none where a joint's position was not measured.

    `known` is a load that acts as a function of states, beyond the world's.
    """
    system = world.system
    measured = [system.index(name) for name in recording.measured]
    if not system.coordinates or len(system.coordinates) < len(system.loads):
        return []
    if any(position not in measured for position, _ in system.coordinates):
        return []
    if any(column not in measured for column in system.outside_joints()):
        return []
    found = [
        part
        for number, episode in enumerate(recording.episodes)
        for stretch in _measured(episode, recording.usable[number] if recording.usable else None)
        for part in _track(number, stretch, world, measured, recording.period, known)
    ]
    if not found:
        return []
    unit = torch.cat([track.load for track in found]).square().mean(0).sqrt()
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


def _measured(episode: Episode, usable: NDArray[np.bool_] | None) -> Iterator[Episode]:
    """The stretches of an episode whose rows are `usable` (T,); None: the whole episode."""
    if usable is None or usable.all():
        yield episode
        return
    for start, end in runs(usable):
        if usable[start] and end - start > 1:
            rows = slice(start, end)
            assert episode.state is not None
            yield Episode(episode.time[rows], episode.action[rows], episode.state[rows])


def _track(
    number: int,
    episode: Episode,
    world: World,
    measured: Sequence[int],
    period: float,
    known: SmoothFunction | None,
) -> list[LoadTrack]:
    system = world.system
    stamps, readings, given = (
        torch.as_tensor(values, dtype=torch.float64) for values in (episode.time, episode.state, episode.action)
    )
    smoothing = max(SMOOTHING, period)
    stamps = stamps.contiguous()
    time = torch.arange(float(stamps[0]), float(stamps[-1]), period, dtype=torch.float64)
    if len(time) * period < SHORTEST * smoothing:
        return []
    state = torch.zeros(len(time), len(system.states), dtype=torch.float64)
    after = torch.searchsorted(stamps, time, right=True).clamp(1, len(stamps) - 1)
    share = (time - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
    for k, column in enumerate(measured):
        state[:, column] = torch.lerp(readings[after - 1, k], readings[after, k], share)
    held = torch.cat((stamps.diff(), stamps.new_tensor([period])))
    acting = _mean_commands(world.actuate(given[None], held[None])[0].mean(1), stamps, held, time, period)

    def smooth(values: Tensor, deviation: float = smoothing) -> Tensor:
        return _smoothed(values, deviation / period)

    def rate(values: Tensor) -> Tensor:
        return torch.gradient(values, spacing=period, dim=0)[0]

    positions, velocities = (list(columns) for columns in zip(*system.coordinates, strict=True))
    state[:, positions] = smooth(state[:, positions], 0.1 * smoothing)
    state[:, velocities] = rate(state[:, positions])
    acceleration = rate(state[:, velocities])
    commanded = smooth(acting, 0.1 * smoothing)
    motion = _Motion(world, time, state, acting, acceleration)
    found = motion.loads(rate, commanded, known)
    largest = torch.tensor([action.largest for action in system.actions], dtype=torch.float64)
    fastest = torch.tensor([system.states[v].largest for v in velocities], dtype=torch.float64)
    stormy = smooth(acceleration.abs(), 2 * smoothing)
    activity = torch.cat(
        (
            (stormy / stormy.mean(0).clamp(min=1e-300) + 0.1).log(),
            (smooth(state[:, velocities].abs(), 2 * smoothing) / fastest + 0.03).log(),
            (smooth(rate(commanded).abs(), 2 * smoothing) / largest + 0.3).log(),
        ),
        1,
    )
    at_rest = smooth((-(_slowest(state[:, velocities]) / (SLOW * fastest)).square()).exp())
    edge, stride = round(EDGE * smoothing / period), max(1, round(STEP / period))
    inner = slice(edge, len(time) - edge, stride)
    both = torch.cat((found.load[:, None], found.columns), 1)
    smoothed = _smoothed(both.flatten(1), smoothing / period, edge, stride).unflatten(1, both.shape[1:])
    whole = LoadTrack(
        number,
        time[inner],
        torch.ones_like(smoothed[0, 0]),
        smoothed[:, 0],
        smoothed[:, 1:].movedim(1, 0),
        found.reaction[inner].movedim(1, 0),
        found.dry,
        motion.dry_friction()[inner],
        at_rest[inner],
        activity[inner],
        smoothing,
    )
    return whole.parts()


@dataclass(frozen=True)
class _Loads:
    """What `LoadTrack` has, at T instants and not smoothed."""

    load: Tensor  # (T, J)
    columns: Tensor  # (T, K, J)
    reaction: Tensor  # (T, K, J, J)
    dry: tuple[int, ...]


@dataclass(frozen=True)
class _Motion:
    """A world along the T instants of an episode, and the accelerations of the joints that were measured."""

    world: World
    time: Tensor  # (T,)
    state: Tensor  # (T, n)
    acting: Tensor  # (T, n_action)
    measured: Tensor  # (T, J)

    def acceleration(self, state: Tensor, acting: Tensor) -> Tensor:
        """(T, J) accelerations of the joints by the world."""
        at = WorldState(self.time, state, ())
        return self.world.system_at(at).accelerations(state, acting, self.world.load(at))

    def without_dry_friction(self) -> _Motion:
        """The same motion in a world without dry friction, whose load jumps where a joint turns round."""
        named = [effect for effect in self.world.effects if isinstance(effect, Effect)]
        kept = [effect for effect in named if not (isinstance(effect, DynamicsEffect) and effect.rubs())]
        return replace(self, world=self.world.with_effects(kept))

    def gain(self, bare: System | None = None) -> tuple[Tensor, Tensor]:
        """(T, J) accelerations of the joints by the world, or by the system `bare`, and (T, J, J) their change per
        unit of each load."""
        at = WorldState(self.time, self.state, ())
        system, load = self.world.system_at(at) if bare is None else bare, self.world.load(at)
        return system.response_to_loads(self.state, self.acting, load)

    def dry_friction(self) -> Tensor:
        """(T, J) the dry friction of the world at rest: half of the jump of its load where a joint turns round."""
        columns = [velocity for _, velocity in self.world.system.coordinates]
        forward, backward = (
            self.world.load(WorldState(self.time, self.state.index_fill(1, torch.tensor(columns), speed), ()))
            for speed in (1e-9, -1e-9)
        )
        return (backward - forward).clamp(min=0) / 2

    def loads(self, rate: Callable[[Tensor], Tensor], commanded: Tensor, known: SmoothFunction | None = None) -> _Loads:
        """The load in question and what may explain it.

        `rate` differentiates by time, `commanded` (T, n_action) are the commands that act, slightly smoothed, and
        `known` is a function of states that acts as a load.
        """
        system, state, acting = self.world.system, self.state, self.acting
        free, gain = self.gain()

        def load(acceleration: Tensor) -> Tensor:
            return torch.linalg.solve(gain, acceleration[..., None])[..., 0]

        joints = torch.eye(gain.shape[-1], dtype=state.dtype)
        sliding = self.without_dry_friction()
        slides = sliding.acceleration(state, acting)
        columns: list[Tensor] = []
        reactions: dict[int, Tensor] = {}
        dry: list[int] = []
        response = [
            load(self.acceleration(state, acting + unit) - free) for unit in torch.eye(acting.shape[1]).to(acting)
        ]
        for by_unit, command in zip(response, commanded.unbind(1), strict=True):
            columns += [by_unit * command[:, None], by_unit * rate(command)[:, None]]
        driven = (torch.stack(response, -1) * commanded[:, None]).sum(-1)
        largest = torch.tensor([action.largest for action in system.actions], dtype=state.dtype)
        slack = (commanded / (SLACK * largest)).tanh()
        for j, (position, velocity) in enumerate(system.velocity_of().items()):
            v = state[:, velocity]
            slip = v / (SLOW * system.states[velocity].largest)
            sign, near_rest = slip.tanh(), (-(0.2 * slip).square()).exp()
            friction = (sign, sign * near_rest, sign * driven[:, j].abs(), v, v * v.abs(), torch.ones_like(v))
            dry.append(len(columns))
            columns += [each[:, None] * joints[j] for each in friction]
            # Added inertia; then errors of the position: the sensor's zero, and a drive's compliance and play.
            reactions[len(columns)] = joints[j][:, None] * gain[:, j, None, :]
            columns.append(self.measured[:, j, None] * joints[j])
            moved = [_moved(state, column) for column in (position, velocity)]
            slopes = [(sliding.acceleration(each, acting) - slides) / DIFFERENCE for each in moved]
            for error in (torch.ones_like(v), *commanded.unbind(1), *slack.unbind(1)):
                first = rate(error)
                change = -slopes[0] * error[:, None] - slopes[1] * first[:, None] + rate(first)[:, None] * joints[j]
                columns.append(load(change))
        bare: Any = system
        plain = self.gain(bare)
        for name in scalable(system):
            scaled = self.gain(replace(bare, **{name: getattr(bare, name) * math.exp(DIFFERENCE)}))
            loads = [torch.linalg.solve(g, (self.measured - f)[..., None])[..., 0] for f, g in (plain, scaled)]
            reactions[len(columns)] = (joints - torch.linalg.solve(scaled[1], plain[1])) / DIFFERENCE
            columns.append((loads[0] - loads[1]) / DIFFERENCE)
        if known is not None and known.loads is not None and known.states is not None:
            columns += [each[:, None] * known.loads for each in known.basis(state @ known.states).unbind(-1)]
        reaction = state.new_zeros(len(state), len(columns), len(joints), len(joints))
        for k, each in reactions.items():
            reaction[:, k] = each
        return _Loads(load(self.measured - free), torch.stack(columns, 1), reaction, tuple(dry))


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


def _slowest(velocity: Tensor) -> Tensor:
    """The least speeds (T, J) of each joint from the row before to the row after; 0 where it turns round."""
    three = pad(velocity.T[None], (1, 1), mode="replicate")[0].T.unfold(0, 3, 1)
    turns = three.amin(-1) * three.amax(-1) <= 0
    return three.abs().amin(-1).masked_fill(turns, 0.0)


def _moved(state: Tensor, column: int) -> Tensor:
    """States (T, n) with one column a little larger."""
    out = state.clone()
    out[:, column] += DIFFERENCE
    return out


def _smoothed(values: Tensor, deviation: float, edge: int = 0, stride: int = 1) -> Tensor:
    """Values (T, M) smoothed by a Gaussian of this deviation in rows; beyond the ends, point-reflected.

    Every `stride`-th row is given, without the first and the last `edge` rows.
    """
    reach = math.ceil(GAUSSIAN_REACH * deviation)
    lags = torch.arange(-reach, reach + 1, dtype=values.dtype)
    kernel = torch.exp(-0.5 * (lags / max(deviation, 1e-6)).square())
    first, last = values[:1], values[-1:]
    before, beyond = 2 * first - values[1 : reach + 1].flip(0), 2 * last - values[-reach - 1 : -1].flip(0)
    padded = torch.cat((before, values, beyond))[edge : len(values) + 2 * reach - edge].T[:, None]
    return conv1d(padded, (kernel / kernel.sum())[None, None], stride=stride)[:, 0].T

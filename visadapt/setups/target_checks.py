"""What a target shows and takes, checked against the source before its samples are explained: signs, units, order."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from visadapt.diagnosis.words import OPPOSITE, listed
from visadapt.recordings import Episode, Recording, RecordingError, load_recording
from visadapt.recordings.clock import CONVERSION, LEAST_STEPS
from visadapt.recordings.episode import MisreadError
from visadapt.recordings.sensors import DEAD
from visadapt.targets.base import TargetError
from visadapt.world import World

MOST_SHORT = 0.5
"""Share of the samples in episodes that are too short beyond which the others are not diagnosed: where the policy falls
at once, what it does before says little."""

OPPOSITE_ERROR = 0.25
"""Mean square error of single steps with the opposite sign, over that with the source's, below which the target's sign
is the opposite one."""


def load_samples(recordings: Sequence[Path], source: World, frames: bool = False) -> Recording:
    """The recordings of a target, whose readings are converted where it is defined, not where they are read.

    Raises:
        TargetError: they cannot be used; raised from the RecordingError that says so of a file.
    """
    try:
        return load_recording(recordings, source.system, frames=frames)
    except RecordingError as error:
        problem = CONVERSION.sub("", str(error))
        raise TargetError(f"{problem}; mend it in the target, or its map, and begin in another folder") from error


def check_short(recordings: Sequence[Path], episodes: Sequence[Episode], source: World) -> None:
    """Raises TargetError where episodes that are too short for a diagnosis show a wrong unit or an opposite sign."""
    if turned := opposite_commands(episodes, source):
        raise _opposite(recordings[0], listed(turned))
    try:
        load_samples(recordings, source)
    except TargetError as error:
        if isinstance(error.__cause__, MisreadError):
            raise


def doubts(recordings: Sequence[Path], episodes: Sequence[Episode], source: World) -> list[str]:
    """What a target seems to show or take otherwise than the source: signs, units, exchanged or dead readings.

    A quick check, for where no diagnosis is asked for; in words. Of episodes that are too short for a diagnosis, units
    and signs are checked alone.
    """
    if turned := opposite_commands(episodes, source):
        return [f"{listed(turned)} of the target{OPPOSITE}, by single steps; --diagnose checks what it shows"]
    if source.period > source.system.prediction_time / LEAST_STEPS:
        return []  # too long for a diagnosis, by which readings are checked
    short, every = samples_in_short(episodes, source.system.prediction_time)
    try:
        return [warning for warning in load_samples(recordings, source).warnings if DEAD in warning]
    except TargetError as error:
        judged = short <= MOST_SHORT * every or isinstance(error.__cause__, MisreadError)
        return [str(error)] if judged else []


def samples_in_short(episodes: Sequence[Episode], shortest: float) -> tuple[int, int]:
    """Samples in episodes shorter than `shortest` s, and in all."""
    short = [one.samples for one in episodes if one.time[-1] - one.time[0] < shortest * (1 - 1e-6)]
    return sum(short), sum(one.samples for one in episodes)


def opposite_commands(episodes: Sequence[Episode], source: World) -> list[str]:
    """The commands that the target takes with the opposite sign: single steps say so of episodes that are too short for
    a diagnosis, as where the policy drives the target the wrong way."""
    rows = [(one.state, one.action[:-1]) for one in episodes if one.state is not None]
    if not rows:
        return []
    parts = [state[:-1] for state, _ in rows], [state[1:] for state, _ in rows], [action for _, action in rows]
    state, after, command = (torch.from_numpy(np.concatenate(part)).double() for part in parts)
    size, world = (after - state).square().mean(0).clamp(min=1e-300), copy.deepcopy(source).double()

    def error(signs: Tensor) -> float:
        """Mean square error of a step, over the changes of the states."""
        with torch.no_grad():
            stepped = world.step(world.start(state), signs * command).state
        return float(((stepped - after).square().mean(0) / size).mean())

    actions = source.system.actions
    each = 1 - 2 * torch.eye(len(actions), dtype=torch.float64)
    signs = min((*each, -torch.ones_like(each[0])), key=error)
    if not error(signs) < OPPOSITE_ERROR * error(torch.ones_like(signs)):
        return []
    return [action.name for action, sign in zip(actions, signs.tolist(), strict=True) if sign < 0]


def refuse_opposite_signs(path: Path, warnings: Sequence[str]) -> None:
    """Raises TargetError where a diagnosis, kept in `path`, warns that the target's sign of something is opposite."""
    for warning in warnings:
        name, opposite, _ = warning.partition(OPPOSITE)
        if opposite:
            raise _opposite(path, name)


def _opposite(path: Path, name: str) -> TargetError:
    return TargetError(
        f"{path}: {name} of the target{OPPOSITE}, so that the policy would drive it the wrong way: negate it in the "
        "target, by scale = -1.0 in a map, and begin in another folder"
    )

"""The gap explained by a diagnosis, round by round of an adaptation."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from visadapt.diagnosis import diagnose
from visadapt.diagnosis.planning import plan
from visadapt.diagnosis.result import AMBIGUOUS, IDENTIFIED, UNEXPLAINED
from visadapt.diagnosis.saved import load_explanations
from visadapt.diagnosis.verdict import CLOSES_BUT
from visadapt.diagnosis.words import DERIVED, OPPOSITE, listed
from visadapt.effects import Effect
from visadapt.learning.explanation import Explain, Explanation
from visadapt.policies import Policy
from visadapt.progress import Report, staged
from visadapt.recordings import Episode, Recording, RecordingError, load_recording
from visadapt.recordings.clock import CONVERSION, LEAST_STEPS
from visadapt.recordings.episode import MisreadError
from visadapt.recordings.hdf5 import read_stretches
from visadapt.recordings.sensors import DEAD
from visadapt.setups.nearest import keep_nearest, kept_nearest
from visadapt.storage.run_folder import read_json, write_json
from visadapt.targets.base import TargetError
from visadapt.world import World

MOST_SHORT = 0.5
"""Share of the samples in episodes that are too short beyond which the others are not diagnosed: where the policy falls
at once, what it does before says little."""

OPPOSITE_ERROR = 0.25
"""Mean square error of single steps with the opposite sign, over that with the source's, below which the target's sign
is the opposite one."""

WORTH_NAMING = 0.5  # Share of an unexplained gap from which on the effects that close it are named
MOST_NAMED = 3  # Effects; a longer list that leaves the gap unexplained says nothing of the machine


def explained(source: World, renderer: nn.Module | None = None, seed: int = 0, report: Report | None = None) -> Explain:
    """Diagnoses recordings from all their states or, given the renderer of their scene, from their frames alone.

    They are read and checked, and each diagnosis is written, as by `visadapt diagnose --json`. Where most samples
    are in episodes shorter than a prediction, there is no diagnosis. Where the recordings cannot tell causes apart,
    the likeliest is taken, by preference one in which no sensor is wrong, and, unless they are frames, an
    experiment is designed for the next round. Where causes leave something unexplained, a residual is to learn it;
    where the gap stays unexplained, all of it, beside the nearest effects where these close nearly all of it.

    Raises:
        ValueError: the source has effects, which a diagnosis would have to know.
        TargetError: from what is returned: the target's units, or the order of its states, are wrong, or it shows or
            takes something with the opposite sign, with which the policy would drive it the wrong way.
    """
    if len(source.effects):
        raise ValueError("a diagnosis starts from the bare system: give the source without effects")
    shortest = source.system.prediction_time

    def explain(recordings: Sequence[Path], path: Path) -> Explanation:
        episodes = [one for each in recordings for one in read_stretches(each, frames=False)[0].values()]
        short, every = _samples(episodes, shortest)
        if short > MOST_SHORT * every:
            if renderer is None:
                _check_short(recordings, episodes, source)
            verdict = f"{short} of {every} samples are in episodes shorter than {shortest:g} s, not diagnosed"
            return Explanation(verdict, [], complete=False)
        recording = _load(recordings, source, frames=renderer is not None)
        diagnosed = partial(diagnose, recording, source, seed=seed, progress=report, renderer=renderer)
        found = None
        if not path.exists():
            found = diagnosed()
            keep_nearest(found, path)
            write_json(path, found.to_json())
        content = read_json(path)
        _refuse_opposite_signs(path, content["warnings"])
        verdict = content["verdict"]
        slight = frozenset(cause["effect"] for cause in content["causes"] if cause["slight"])
        effects: list[Effect] = []
        others: list[list[Effect]] = []
        if verdict in (IDENTIFIED, AMBIGUOUS):
            effects, *others = _without_repeats(load_explanations(path, source.system), slight)
        elif verdict == UNEXPLAINED:
            effects = kept_nearest(path, source.system)

        def experiment(policy: Policy, steps: int) -> Tensor | None:
            """Commands (steps, n_action) to add that tell the causes apart, also written to plan.csv; or None."""
            try:
                planned = plan(found or diagnosed(), recording, source, policy, steps, progress=staged(report, "plan"))
            except ValueError:  # every excitation leaves the ranges, or the causes cannot be exchanged
                return None
            if not planned.settles:
                return None
            planned.write(path.with_name("plan.csv"))
            return torch.as_tensor(planned.added)

        # A policy that is shown derived velocities acts on what no effect in the world stands for.
        left = any(DERIVED in warning or warning.startswith(CLOSES_BUT) for warning in content["warnings"])
        complete = verdict != UNEXPLAINED and not left
        designs = experiment if verdict == AMBIGUOUS and renderer is None else None
        nearest = _nearest(content["ranking"]) if verdict == UNEXPLAINED and not effects else ""
        return Explanation(
            verdict, effects, complete, slight, others, nearest, tuple(content["warnings"]), experiment=designs
        )

    return explain


def _load(recordings: Sequence[Path], source: World, frames: bool = False) -> Recording:
    """The recordings of a target, whose readings are converted where it is defined, not where they are read.

    Raises:
        TargetError: they cannot be used; raised from the RecordingError that says so of a file.
    """
    try:
        return load_recording(recordings, source.system, frames=frames)
    except RecordingError as error:
        problem = CONVERSION.sub("", str(error))
        raise TargetError(f"{problem}; mend it in the target, or its map, and begin in another folder") from error


def _check_short(recordings: Sequence[Path], episodes: Sequence[Episode], source: World) -> None:
    """Raises TargetError where episodes that are too short for a diagnosis show a wrong unit or an opposite sign."""
    if turned := opposite_commands(episodes, source):
        raise _opposite(recordings[0], listed(turned))
    try:
        _load(recordings, source)
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
    short, every = _samples(episodes, source.system.prediction_time)
    try:
        return [warning for warning in _load(recordings, source).warnings if DEAD in warning]
    except TargetError as error:
        judged = short <= MOST_SHORT * every or isinstance(error.__cause__, MisreadError)
        return [str(error)] if judged else []


def _without_repeats(sets: Sequence[list[Effect]], slight: frozenset[str]) -> list[list[Effect]]:
    """The explanations without those that differ from an earlier one in effects alone that are slight."""
    kept: dict[frozenset[str], list[Effect]] = {}
    for each in sets:
        kept.setdefault(frozenset(effect.name for effect in each) - slight, each)
    return list(kept.values())


def _nearest(ranking: Sequence[Mapping[str, Any]]) -> str:
    """What the likeliest effects close of the gap, in words; nothing, where that is not known or little."""
    best = ranking[0] if ranking else {"effects": [], "gap_closed": None}
    closed = best["gap_closed"]
    if not 0 < len(best["effects"]) <= MOST_NAMED or closed is None or closed < WORTH_NAMING:
        return ""
    return f"{listed(best['effects'])} alone would close {closed:.1%} of it".replace("%", " %")


def steps_to_diagnose(source: World) -> int:
    """Samples of the shortest episode that can be diagnosed."""
    return math.ceil(source.system.prediction_time / source.period * (1 - 1e-6))


def check_diagnosable(source: World, longest: int) -> None:
    """Raises ValueError where episodes of at most `longest` samples are too short to be diagnosed."""
    if longest < (least := steps_to_diagnose(source)):
        raise ValueError(
            f"episodes of at most {longest} samples last {longest * source.period:.3g} s, and a diagnosis predicts "
            f"{source.system.prediction_time:g} s ahead: rounds, and episodes, of at least {least} samples are right; "
            "a system of your own that is fast states a shorter prediction_time"
        )


def _samples(episodes: Sequence[Episode], shortest: float) -> tuple[int, int]:
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


def _refuse_opposite_signs(path: Path, warnings: Sequence[str]) -> None:
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

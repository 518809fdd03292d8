"""The gap explained by a diagnosis, round by round of an adaptation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from visadapt.diagnosis import diagnose
from visadapt.diagnosis.planning import plan
from visadapt.diagnosis.result import AMBIGUOUS, IDENTIFIED, UNEXPLAINED
from visadapt.diagnosis.saved import load_explanations
from visadapt.diagnosis.verdict import CLOSES_BUT
from visadapt.diagnosis.words import DERIVED, listed
from visadapt.effects import Effect
from visadapt.effects.catalogue import twins
from visadapt.learning.explanation import Explain, Explanation
from visadapt.policies import Policy
from visadapt.progress import Report, staged
from visadapt.recordings.hdf5 import read_stretches
from visadapt.setups.nearest import keep_nearest, kept_nearest
from visadapt.setups.target_checks import (
    MOST_SHORT,
    check_short,
    load_samples,
    refuse_opposite_signs,
    samples_in_short,
)
from visadapt.storage.run_folder import read_json, write_json
from visadapt.systems import System
from visadapt.world import World

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
        short, every = samples_in_short(episodes, shortest)
        if short > MOST_SHORT * every:
            if renderer is None:
                check_short(recordings, episodes, source)
            verdict = f"{short} of {every} samples are in episodes shorter than {shortest:g} s, not diagnosed"
            return Explanation(verdict, [], complete=False)
        recording = load_samples(recordings, source, frames=renderer is not None)
        diagnosed = partial(diagnose, recording, source, seed=seed, progress=report, renderer=renderer)
        found = None
        if not path.exists():
            found = diagnosed()
            keep_nearest(found, path)
            write_json(path, found.to_json())
        content = read_json(path)
        refuse_opposite_signs(path, content["warnings"])
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
        separable = not all(_differ_by_twins(effects, each, source.system) for each in others)
        designs = experiment if verdict == AMBIGUOUS and renderer is None and separable else None
        nearest = _nearest(content["ranking"]) if verdict == UNEXPLAINED and not effects else ""
        return Explanation(
            verdict, effects, complete, slight, others, nearest, tuple(content["warnings"]), experiment=designs
        )

    return explain


def _differ_by_twins(one: Sequence[Effect], other: Sequence[Effect], system: System) -> bool:
    """Whether two explanations differ in effects alone that no data of the system tell apart."""
    left = [type(effect) for effect in one if all(effect.name != each.name for each in other)]
    right = [type(effect) for effect in other if all(effect.name != each.name for each in one)]
    return len(left) == len(right) and all(twins(effect, right, system) for effect in left)


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

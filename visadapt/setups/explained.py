"""The gap explained by a diagnosis, round by round of an adaptation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from visadapt.diagnosis import diagnose
from visadapt.diagnosis.planning import plan
from visadapt.diagnosis.result import AMBIGUOUS, IDENTIFIED, UNEXPLAINED
from visadapt.diagnosis.saved import load_effects
from visadapt.diagnosis.words import OPPOSITE
from visadapt.effects.catalogue import catalogue
from visadapt.learning.explanation import Explain, Explanation
from visadapt.policies import Policy
from visadapt.progress import Report, staged
from visadapt.recordings import Episode, Recording
from visadapt.storage.run_folder import read_json, write_json
from visadapt.targets.base import TargetError
from visadapt.world import World


def explained(source: World, renderer: nn.Module | None = None, seed: int = 0, report: Report | None = None) -> Explain:
    """Diagnoses episodes from all their states or, given the renderer of their scene, from their frames alone.

    Each diagnosis is written as by `visadapt diagnose --json`. Episodes shorter than a prediction are left out.
    Where the episodes cannot tell causes apart, the likeliest is taken and, unless they are frames, an experiment is
    designed for the next round. Where the gap stays unexplained, all of it is left to a residual.

    Raises:
        ValueError: the source has effects, which a diagnosis would have to know.
        TargetError: from what is returned: the target shows or takes something with the opposite sign, with which the
            policy would drive it the wrong way.
    """
    if len(source.effects):
        raise ValueError("a diagnosis starts from the bare system: give the source without effects")
    catalogue(source.system)  # makes the effects of a system of one's own known, by which a file names them
    measured = () if renderer else tuple(state.name for state in source.system.states)
    shortest = source.system.prediction_time

    def explain(episodes: Sequence[Episode], path: Path) -> Explanation:
        diagnosable = tuple(e for e in episodes if e.time[-1] - e.time[0] >= shortest)
        if not diagnosable:
            verdict = f"all {len(episodes)} episodes are shorter than {shortest:g} s, not diagnosed"
            return Explanation(verdict, [], complete=False)
        origins = tuple(f"episode {number}" for number in range(len(diagnosable)))
        recording = Recording(diagnosable, measured, source.period, origins)
        diagnosed = partial(diagnose, recording, source, seed=seed, progress=report, renderer=renderer)
        found = None
        if not path.exists():
            found = diagnosed()
            write_json(path, found.to_json())
        content = read_json(path)
        _refuse_opposite_signs(path, content["warnings"])
        verdict = content["verdict"]
        slight = frozenset(cause["effect"] for cause in content["causes"] if cause["slight"])
        effects = load_effects(path)[1] if verdict in (IDENTIFIED, AMBIGUOUS) else []

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

        designs = experiment if verdict == AMBIGUOUS and renderer is None else None
        return Explanation(verdict, effects, verdict != UNEXPLAINED, slight, designs)

    return explain


def _refuse_opposite_signs(path: Path, warnings: Sequence[str]) -> None:
    """Raises TargetError where a diagnosis, kept in `path`, warns that the target's sign of something is opposite."""
    for warning in warnings:
        name, opposite, _ = warning.partition(OPPOSITE)
        if opposite:
            raise TargetError(
                f"{path}: {name} of the target{OPPOSITE}, so that the policy would drive it the wrong way: negate it "
                "in the target, by scale = -1.0 in a map, and begin in another folder"
            )

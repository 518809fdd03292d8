"""Scores that are run once and kept as JSON, so that an interrupted script goes on after them."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar, overload

from visadapt.evaluation import SCORE_SEED, CartPoleScore, FlightScore, RegulationScore, score
from visadapt.policies import Policy, RegulatorPolicy
from visadapt.storage.run_folder import once, read_json
from visadapt.targets import FlightTarget, Target

Kind = TypeVar("Kind", CartPoleScore, FlightScore, RegulationScore)


@overload
def kept_score(  # type: ignore[overload-overlap]
    path: Path, policy: RegulatorPolicy, target: Target, episodes: int, steps: int | None = ..., seed: int = ...
) -> RegulationScore: ...
@overload
def kept_score(  # type: ignore[overload-overlap]
    path: Path, policy: Policy, target: FlightTarget, episodes: int, steps: int | None = ..., seed: int = ...
) -> FlightScore: ...
@overload
def kept_score(
    path: Path, policy: Policy, target: Target, episodes: int, steps: int | None = ..., seed: int = ...
) -> CartPoleScore: ...
def kept_score(
    path: Path, policy: Policy, target: Target, episodes: int, steps: int | None = None, seed: int = SCORE_SEED
) -> CartPoleScore | FlightScore | RegulationScore:
    """`score`, run only where it is not kept in the JSON file `path` yet."""
    once(path, lambda: asdict(score(policy, target, episodes, seed, steps)))
    if isinstance(policy, RegulatorPolicy):
        return read_score(path, RegulationScore)
    return read_score(path, FlightScore) if isinstance(target, FlightTarget) else read_score(path, CartPoleScore)


def read_score(path: Path, kind: type[Kind]) -> Kind:
    """A score that was kept."""
    found: dict[str, Any] = read_json(path)
    # JSON has no infinity: that of a flight that was not finite is null there.
    missing = {key: math.inf for key, value in found.items() if value is None and kind is FlightScore}
    return kind(**(found | missing))

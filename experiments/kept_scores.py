"""Scores that are run once and kept as JSON, so that an interrupted script goes on after them."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any, overload

from visadapt.evaluation import CartPoleScore, FlightScore, score
from visadapt.policies import Policy
from visadapt.storage.run_folder import once
from visadapt.targets import FlightTarget, Target


@overload
def kept_score(  # type: ignore[overload-overlap]
    path: Path, policy: Policy, target: FlightTarget, episodes: int = ..., steps: int | None = ...
) -> FlightScore: ...
@overload
def kept_score(
    path: Path, policy: Policy, target: Target, episodes: int = ..., steps: int | None = ...
) -> CartPoleScore: ...
def kept_score(
    path: Path, policy: Policy, target: Target, episodes: int = 100, steps: int | None = None
) -> CartPoleScore | FlightScore:
    """`score`, run only where it is not kept in the JSON file `path` yet."""
    found: dict[str, Any] = once(path, lambda: asdict(score(policy, target, episodes, steps=steps)))
    if not isinstance(target, FlightTarget):
        return CartPoleScore(**found)
    # JSON has no infinity: that of a flight that was not finite is null there.
    missing: dict[str, Any] = {key: math.inf for key, value in found.items() if value is None}
    return FlightScore(**(found | missing))

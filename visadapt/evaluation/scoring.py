"""The score of a policy on a target: one call for all of them."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any, overload

from visadapt.evaluation.cartpole_score import EPISODE_STEPS, CartPoleScore, score_cartpole
from visadapt.evaluation.flight_score import FlightScore, score_flights
from visadapt.policies import Policy
from visadapt.storage.run_folder import once
from visadapt.targets import FlightTarget, Target

SCORE_SEED = 2026
"""Of the starts and hidden effects that policies are scored on: never that of a training, which counts from 0."""


@overload
def score(  # type: ignore[overload-overlap]
    policy: Policy, target: FlightTarget, episodes: int = ..., seed: int = ..., steps: int | None = ...
) -> FlightScore: ...
@overload
def score(
    policy: Policy, target: Target, episodes: int = ..., seed: int = ..., steps: int | None = ...
) -> CartPoleScore: ...
def score(
    policy: Policy, target: Target, episodes: int = 100, seed: int = SCORE_SEED, steps: int | None = None
) -> CartPoleScore | FlightScore:
    """Run `policy` for `episodes` episodes on `target`: how well it does, and how many episodes failed.

    Flights are scored by their distance in m from their task's line, cart-poles by the cart's speed in m/s. The steps
    are those of an evaluation: no ledger counts them.

    Args:
        seed: of the starts and of the hidden effects.
        steps: of an episode; without it, those of the task, or 250.

    >>> import visadapt as va
    >>> found = va.score(va.load_policy(va.shipped("cartpole_states")), va.SyntheticTarget(), episodes=2, steps=20)
    >>> found.survived, found.mean_speed < 1.0  # print(found) says both
    (2, True)
    """
    if isinstance(target, FlightTarget):
        return score_flights(policy, target, episodes, seed, steps)
    return score_cartpole(policy, target, episodes, seed, steps or EPISODE_STEPS)


@overload
def kept_score(  # type: ignore[overload-overlap]
    path: Path, policy: Policy, target: FlightTarget, episodes: int = ...
) -> FlightScore: ...
@overload
def kept_score(path: Path, policy: Policy, target: Target, episodes: int = ...) -> CartPoleScore: ...
def kept_score(path: Path, policy: Policy, target: Target, episodes: int = 100) -> CartPoleScore | FlightScore:
    """`score`, run only where it is not kept in the JSON file `path` yet."""
    found: dict[str, Any] = once(path, lambda: asdict(score(policy, target, episodes)))
    if not isinstance(target, FlightTarget):
        return CartPoleScore(**found)
    # JSON has no infinity: that of a flight that was not finite is null there.
    missing: dict[str, Any] = {key: math.inf for key, value in found.items() if value is None}
    return FlightScore(**(found | missing))

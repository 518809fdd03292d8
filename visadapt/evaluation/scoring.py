"""Scores: a cart's speed and how far flights miss, failed episodes counted apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
import torch

from visadapt.policies import Policy, RegulatorPolicy
from visadapt.policies.base import check_policy
from visadapt.systems import CartPole
from visadapt.targets import Target, TaskTarget
from visadapt.targets.rollout import Run, check_period, run
from visadapt.tasks.base import EPISODE_STEPS
from visadapt.tasks.regulate import steps_in

SCORE_SEED = 2026
"""Seed of the starts and hidden effects that policies are scored on; seeds of trainings count from 0."""
FAR = 1.0
"""m, error above which a flight has failed."""


@dataclass(frozen=True)
class CartPoleScore:
    """Scores of a set of episodes. Speeds are over surviving episodes only; the fallen are counted apart."""

    episodes: int
    survived: int
    mean_speed: float | None
    """m/s, mean over surviving episodes of the mean |x_dot| over the episode; None where none survived"""
    std_speed: float | None
    """m/s, spread over surviving episodes"""
    mean_length: float
    """steps until the end, over all episodes"""

    def __str__(self) -> str:
        speed = f"{self.mean_speed:.3f} m/s" if self.mean_speed is not None else "no speed"
        return f"{speed}, {self.survived} of {self.episodes} episodes up"


@dataclass(frozen=True)
class FlightScore:
    """How far flights miss. The mean includes failed flights; it is infinite where a flight ended early: its state was
    not finite, or it was further off than its target allows."""

    flights: int
    failed: int
    """flights that were more than FAR off somewhere, or ended early"""
    mean: float
    """m, mean over flights of the mean error of each"""
    std: float
    """m, standard deviation over flights of these mean errors"""
    worst: float
    """m, the largest error of all"""

    def __str__(self) -> str:
        return f"{self.mean:.4f} +- {self.std:.4f} m, {self.flights - self.failed} of {self.flights} stayed near"


@dataclass(frozen=True)
class RegulationScore:
    """How far a system stays from its goal. The errors are over the second halves of surviving episodes, in which it
    should be at rest."""

    episodes: int
    survived: int
    errors: dict[str, float] | None
    """root mean square distances from the goal of the states that have a tolerance, by name and in the state's unit;
    None where no episode survived"""
    units: dict[str, str]
    """by the names of these states"""

    def __str__(self) -> str:
        errors = [f"{name} {error:.3g} {self.units[name]}" for name, error in (self.errors or {}).items()]
        return ", ".join((*errors, f"{self.survived} of {self.episodes} episodes survived"))


@overload
def score(  # type: ignore[overload-overlap]
    policy: RegulatorPolicy, target: Target, episodes: int = ..., seed: int = ..., steps: int | None = ...
) -> RegulationScore: ...
@overload
def score(  # type: ignore[overload-overlap]
    policy: Policy, target: TaskTarget, episodes: int = ..., seed: int = ..., steps: int | None = ...
) -> FlightScore: ...
@overload
def score(
    policy: Policy, target: Target, episodes: int = ..., seed: int = ..., steps: int | None = ...
) -> CartPoleScore: ...
def score(
    policy: Policy, target: Target, episodes: int = 100, seed: int = SCORE_SEED, steps: int | None = None
) -> CartPoleScore | FlightScore | RegulationScore:
    """Run `policy` for `episodes` episodes on `target`: how well it does, and how many episodes failed.

    Flights are scored by the errors in m that their task defines (`FlightTask.misses`), cart-poles by the cart's speed
    in m/s, and systems with a `Regulate` task by their distances from its goal; all by what the target shows as its
    state, so that a sensor that is off shows in them. The steps are those of an evaluation: no ledger counts them.

    Args:
        seed: of the starts and of the hidden effects.
        steps: of an episode; without it, those of the task, or 250.

    Raises:
        TypeError: something else in the place of a policy or a target.
        ValueError: more steps than the task of a flight has, no episode or step, a policy that was trained for another
            period or is shown a goal on a target that is no `TaskTarget`, or a target whose system is neither a
            vehicle nor a cart-pole, or that shows no cart speed.

    >>> import visadapt as va
    >>> found = va.score(va.load_policy(va.shipped("cartpole_states")), va.SyntheticTarget(), episodes=2, steps=20)
    >>> found.survived, found.mean_speed < 1.0  # print(found) says both
    (2, True)
    """
    check_policy(policy)
    if not isinstance(target, Target):
        raise TypeError(
            f"score: {target!r:.80} is no target; SyntheticTarget() is one, GymnasiumTarget(ID, map) another"
        )
    if episodes < 1 or (steps is not None and steps < 1):
        raise ValueError(f"{episodes} episodes of {steps} steps; at least one of each is right")
    check_period(policy, target)
    policy.eval()
    generator = torch.Generator().manual_seed(seed)
    if isinstance(policy, RegulatorPolicy):
        steps = steps or steps_in(policy.task["seconds"], target.period)
        return _score_regulation(run(target, policy, episodes, steps, generator, keep_frames=False), policy)
    if isinstance(target, TaskTarget):
        if steps is not None and steps > target.task.steps:
            raise ValueError(f"a flight of this task has {target.task.steps} steps, got steps = {steps}")
        runs = run(target, policy, episodes, steps or target.task.steps, generator, strict=False, keep_frames=False)
        return _score_flights(runs, target)
    if policy.shown == "state and goal":
        raise ValueError(f"{target.name}: flights are scored by their task: derive the target from TaskTarget")
    kind = target.system_class
    if kind is not None and not issubclass(kind, CartPole):
        raise ValueError(f"a score is that of a cart's speed or of a flight; {target.name} is a {kind.name}: use run")
    runs = run(target, policy, episodes, steps or EPISODE_STEPS, generator, keep_frames=False)
    state = runs[0].episode.state
    if state is None or state.shape[1] != len(CartPole.states):
        raise ValueError(
            f"{target.name}: shows no states of a cart-pole; a score is that of the cart's speed, the second of these: "
            "of another machine use run"
        )
    return score_runs(runs)


def score_runs(runs: Sequence[Run]) -> CartPoleScore:
    """Scores of episodes whose second state is the cart's velocity."""
    speeds = np.array(
        [np.abs(r.episode.state[:, 1]).mean() for r in runs if r.survived and r.episode.state is not None]
    )
    return CartPoleScore(
        episodes=len(runs),
        survived=len(speeds),
        mean_speed=float(speeds.mean()) if len(speeds) else None,
        std_speed=float(speeds.std()) if len(speeds) else None,
        mean_length=float(np.mean([r.episode.samples for r in runs])),
    )


def _score_regulation(runs: Sequence[Run], policy: RegulatorPolicy) -> RegulationScore:
    # A target need not know the limits of the task, beyond which an episode has failed.
    limit = np.array([policy.task["limits"].get(name, math.inf) for name in policy.states])
    goal = policy.goal.cpu().numpy()
    states = [
        state
        for run in runs
        if run.survived and (state := run.episode.state) is not None and (np.abs(state - goal) <= limit).all()
    ]
    units = {name: unit for name, unit in policy.states.items() if name in policy.task["tolerance"]}
    errors = None
    if states:
        later = np.concatenate([each[len(each) // 2 :] for each in states])
        apart = np.sqrt(np.square(later - goal).mean(0))
        errors = {name: float(apart[k]) for k, name in enumerate(policy.states) if name in units}
    return RegulationScore(len(runs), len(states), errors, units)


def _score_flights(runs: Sequence[Run], target: TaskTarget) -> FlightScore:
    misses = []
    for k, flown in enumerate(runs):
        if flown.survived:
            assert flown.episode.state is not None
            states = torch.as_tensor(flown.episode.state)[None]
            misses.append(target.task.misses(states, target.first[k : k + 1])[0].numpy())
        else:
            misses.append(np.array([np.inf]))
    means = np.array([miss.mean() for miss in misses])
    worst = np.array([miss.max() for miss in misses])
    mean = float(means.mean())
    std = float(means.std()) if math.isfinite(mean) else math.inf
    return FlightScore(len(runs), int((worst > FAR).sum()), mean, std, float(worst.max()))

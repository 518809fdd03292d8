"""The problems that every baseline is set, and what several baselines share.

A baseline is a module with `stages(problem, sizes, folder, seed)`, which yields the policies that are scored. What they
have in common: the paper's CartPole as source, the hidden effects, the cost (`COST` over a horizon of 10),
the starts, and a ledger that counts every step of the target.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from benchmarks.cartpole_states import CONSTANT, FORCE, SINE
from visadapt.effects import ActuatorDelay, ConstantForce, CoulombFriction, Effect, PeriodicForce, Residual
from visadapt.effects.base import Role
from visadapt.learning.grounding import ground, rescale
from visadapt.learning.ledger import Ledger
from visadapt.learning.rounds import collect
from visadapt.learning.transitions import Transitions
from visadapt.policies import Policy
from visadapt.recordings import Episode
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import REST_WEIGHTS, cartpole_states, from_states
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget, constant_force, sine_force
from visadapt.tasks.balance import Cost, RegulatorCost, cost_to_go
from visadapt.world import World

COST = RegulatorCost(REST_WEIGHTS, to_go=cost_to_go(World(CartPole()), REST_WEIGHTS, Cost.action))
"""What ours is tuned with: the distances from rest, and what coming to rest costs after the last planned state."""
TUNING_SEED = 100
"""Of whatever chooses a setting: neither that of a training, which counts from 0, nor that of the scores."""


@dataclass(frozen=True)
class Sizes:
    """How much is computed."""

    episodes: int = 100
    plans: tuple[tuple[int, int], ...] = ((50, 50), (1000, 100))
    """(budget, samples in a round)"""
    scored: tuple[int, ...] = (50, 100, 200, 500, 1000)
    """counted samples after which a policy is scored"""
    iterations: int = 3000
    """of the source policies"""
    tuning: int = 400
    """iterations of a round of ours"""
    source_steps: int = 200_000
    """of PPO in the source"""
    target_steps: int = 200_000
    """of PPO in the target, counted"""
    updates: int = 4000
    """of the source ensemble of PETS"""


SMOKE = Sizes(2, ((20, 20),), (20,), 3, 2, 4096, 4096, 20)
"""Enough to see that everything runs."""


@dataclass(frozen=True)
class Problem:
    """A CartPole from states under a hidden effect."""

    name: str
    hidden: Callable[[int, torch.Generator], Sequence[Effect]]
    kind: type[Effect]
    """what is hidden: told to those alone that need it, and the table says which"""
    with_history: bool
    """whether policies and models see 5 states and actions, or the last alone"""

    def setup(self, sizes: Sizes) -> Setup:
        """Ours: source, policy, residual and settings."""
        settings = from_states(World(CartPole())).shortened(sizes.iterations)
        settings = replace(settings, tuning=replace(settings.tuning, iterations=sizes.tuning))
        return cartpole_states(with_history=self.with_history, settings=settings)

    def target(self) -> SyntheticTarget:
        """A new target."""
        return SyntheticTarget(self.hidden)


def _friction(batch: int, generator: torch.Generator) -> Sequence[Effect]:
    return (CoulombFriction(force=4.0),)


def _delay(batch: int, generator: torch.Generator) -> Sequence[Effect]:
    return (ActuatorDelay(delay=0.08),)


PROBLEMS = {
    problem.name: problem
    for problem in (
        Problem(CONSTANT, constant_force(FORCE), ConstantForce, with_history=False),
        Problem(SINE, sine_force, PeriodicForce, with_history=True),
        Problem("CartPole, states, dry friction 4 N", _friction, CoulombFriction, with_history=True),
        Problem("CartPole, states, delay 0.08 s", _delay, ActuatorDelay, with_history=True),
    )
}


@dataclass(frozen=True)
class Stage:
    """A policy to be scored."""

    domain: str
    """source, target or adapted"""
    samples: int
    """of the target, counted"""
    policy: Policy


def score_path(folder: Path, stage: Stage) -> Path:
    """Where the score of a stage is kept in its job's folder."""
    return folder / f"score-{stage.domain}-{stage.samples}.json"


Learn = Callable[[Transitions, torch.Generator], Callable[[], Policy]]
"""All samples of the target so far to what makes the policy that has learnt from them, anew each time."""


def in_rounds(
    problem: Problem, sizes: Sizes, seed: int, begin: Callable[[], tuple[Callable[[], Policy], Learn]]
) -> Iterator[Stage]:
    """A baseline that collects its samples itself, round after round, and learns from all of them.

    `begin` gives, for each budget, what makes the policy of the first round, and how it learns.
    """
    longest = problem.setup(sizes).settings.longest_episode
    for budget, round_samples in sizes.plans:
        ledger, generator = Ledger(budget), torch.Generator().manual_seed(seed)
        made, learn = begin()
        episodes: list[Episode] = []
        while ledger.left:
            new = collect(made(), problem.target(), min(round_samples, ledger.left), longest, generator)
            ledger.count("data", sum(episode.samples for episode in new))
            episodes += new
            made = learn(Transitions.cut(episodes, "state"), generator)
            if ledger.used in sizes.scored:
                yield Stage("adapted", ledger.used, made())


def grounded(
    problem: Problem, sizes: Sizes, seed: int, planner: Callable[[Residual | None], Policy]
) -> Iterator[Stage]:
    """Of a planner on the source: as it is, then with the residual network of ours, on data that it collects itself."""
    yield Stage("source", 0, planner(None))
    yield Stage("target", 0, planner(None))
    setup = problem.setup(sizes)

    def begin() -> tuple[Callable[[], Policy], Learn]:
        torch.manual_seed(seed)
        residual = setup.residual(setup.policy(), setup.source)
        scaled = False

        def learn(transitions: Transitions, generator: torch.Generator) -> Callable[[], Policy]:
            nonlocal scaled
            if not scaled:
                rescale(residual, setup.source, transitions, setup.settings.ground.negligible)
                scaled = True
            ground(residual, setup.source, transitions, setup.settings.ground, generator)
            return partial(planner, residual)

        return partial(planner, None), learn

    yield from in_rounds(problem, sizes, seed, begin)


def drawn(kind: type[Effect], batch: int, generator: torch.Generator) -> Effect:
    """An effect with parameters (batch,) from the whole range of the catalogue: uniform, frequencies log-uniform."""
    values = {}
    for parameter in kind.table:
        share = torch.rand(batch, generator=generator)
        low, high = parameter.low, parameter.high
        if parameter.role is Role.FREQUENCY:
            values[parameter.name] = low * (high / low) ** share
        else:
            values[parameter.name] = low + (high - low) * share
    return kind(**values)


def source_policy(problem: Problem, sizes: Sizes, work: Path, seed: int) -> Policy:
    """The policy of ours in the source, trained once for all that begin with it."""
    folder = work / ("source-history" if problem.with_history else "source")
    return problem.setup(sizes).pretrain(folder / f"seed-{seed}.safetensors", seed)

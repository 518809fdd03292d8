"""The problems that every baseline is set, and what several baselines share.

A baseline is a module with `stages(problem, sizes, folder, seed)`, which yields the policies that are scored. What they
have in common: the source, the hidden effect, the cost of a plan, the starts, and a ledger that counts every step of
the target. The problems themselves are in `cartpole` and `flights`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch

from experiments.result_tables import Row
from visadapt.effects import Effect, Residual
from visadapt.effects.base import Role
from visadapt.learning.collection import collect
from visadapt.learning.grounding import ground, rescale
from visadapt.learning.ledger import Ledger
from visadapt.learning.transitions import Transitions
from visadapt.policies import Policy
from visadapt.recordings import Episode
from visadapt.setups.base import Setup
from visadapt.targets import Target
from visadapt.world import World

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
class Problem(ABC):
    """A system under a hidden effect."""

    name: str

    with_history: bool
    """whether policies and models see 5 states and actions, or the last alone"""

    baselines: ClassVar[tuple[str, ...]]
    """those that are written for it"""

    @abstractmethod
    def setup(self, sizes: Sizes) -> Setup:
        """Ours: source, policy, residual and settings."""

    @abstractmethod
    def target(self) -> Target:
        """A new target to learn from."""

    @abstractmethod
    def scored(self, domain: str) -> Target:
        """A new target to score a policy in; without the hidden effect where the domain is the source."""

    @abstractmethod
    def row(self, method: str, domain: str, samples: int, scores: Sequence[Path]) -> Row:
        """The table's row of the scores that the seeds have kept."""

    def watching(self, policy: Policy) -> Policy:
        """A policy on states, as it runs on these targets."""
        return policy

    def transitions(self, episodes: Sequence[Episode]) -> Transitions:
        """What is learnt from episodes of these targets."""
        return Transitions.cut(episodes)

    @property
    def sizes(self) -> Sizes:
        """How much is computed at full size."""
        return Sizes()


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
"""Learns from all samples of the target so far; returns a function, each call of which makes a new policy that has
learnt from them."""


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
            policy, samples = problem.watching(made()), min(round_samples, ledger.left)
            new = collect(policy, problem.target(), samples, longest, generator)
            ledger.count("data", sum(episode.samples for episode in new))
            episodes += new
            made = learn(problem.transitions(episodes), generator)
            if ledger.used in sizes.scored:
                yield Stage("adapted", ledger.used, problem.watching(made()))


def unadapted(problem: Problem, made: Callable[[], Policy]) -> Iterator[Stage]:
    """A policy before it has seen the target, in the source and in the target: what `made` gives for each."""
    for domain in ("source", "target"):
        yield Stage(domain, 0, problem.watching(made()))


def grounded(
    problem: Problem, sizes: Sizes, seed: int, planner: Callable[[Residual | None], Policy]
) -> Iterator[Stage]:
    """Of a planner on the source: as it is, then with the residual network of ours, on data that it collects itself."""
    yield from unadapted(problem, partial(planner, None))
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


def grounded_in_world(problem: Problem, sizes: Sizes, seed: int, planner: Callable[[World], Policy]) -> Iterator[Stage]:
    """The same of a planner that carries its plans out in a world."""
    source = problem.setup(sizes).source

    def planned(residual: Residual | None) -> Policy:
        return planner(source.with_effects([] if residual is None else [residual]))

    yield from grounded(problem, sizes, seed, planned)


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

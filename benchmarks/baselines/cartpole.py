"""The paper's CartPole from states under a hidden effect, as the baselines are set it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch

from benchmarks.baselines.problem import Problem, Sizes
from benchmarks.cartpole_states import CONSTANT, FORCE, SINE
from experiments.kept_scores import read_score
from experiments.result_tables import Row, speed_row
from visadapt.effects import ActuatorDelay, ConstantForce, CoulombFriction, Effect, PeriodicForce
from visadapt.evaluation import CartPoleScore
from visadapt.policies import Policy
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import REST_WEIGHTS, cartpole_states, from_states
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget, constant_force, sine_force
from visadapt.tasks.balance import Cost, RegulatorCost, cost_to_go
from visadapt.world import World

COST = RegulatorCost(REST_WEIGHTS, to_go=cost_to_go(World(CartPole()), REST_WEIGHTS, Cost.action))
"""What ours is tuned with: the distances from rest, and what coming to rest costs after the last planned state."""


@dataclass(frozen=True)
class CartPoleProblem(Problem):
    """A CartPole from states under a hidden effect."""

    hidden: Callable[[int, torch.Generator], Sequence[Effect]]

    kind: type[Effect]
    """what is hidden: told to those alone that need it, and the table says which"""

    baselines: ClassVar[tuple[str, ...]] = ("ours", "diagnosed", "mpc", "mppi", "pets", "ppo", "observer", "randomised")

    def setup(self, sizes: Sizes) -> Setup:
        settings = from_states(World(CartPole())).shortened(sizes.iterations)
        settings = settings.with_tuning(partial(replace, iterations=sizes.tuning))
        return cartpole_states(with_history=self.with_history, settings=settings)

    def target(self) -> SyntheticTarget:
        return SyntheticTarget(self.hidden)

    def scored(self, domain: str) -> SyntheticTarget:
        return SyntheticTarget() if domain == "source" else self.target()

    def row(self, method: str, domain: str, samples: int, scores: Sequence[Path]) -> Row:
        return speed_row(self.name, method, domain, samples, [read_score(path, CartPoleScore) for path in scores])


def _friction(batch: int, generator: torch.Generator) -> Sequence[Effect]:
    return (CoulombFriction(force=4.0),)


def _delay(batch: int, generator: torch.Generator) -> Sequence[Effect]:
    return (ActuatorDelay(delay=0.08),)


CARTPOLES = (
    CartPoleProblem(CONSTANT, False, constant_force(FORCE), ConstantForce),
    CartPoleProblem(SINE, True, sine_force, PeriodicForce),
    CartPoleProblem("CartPole, states, dry friction 4 N", True, _friction, CoulombFriction),
    CartPoleProblem("CartPole, states, delay 0.08 s", True, _delay, ActuatorDelay),
)


def source_policy(problem: CartPoleProblem, sizes: Sizes, work: Path, seed: int) -> Policy:
    """The policy of ours in the source, trained once for all that begin with it."""
    folder = work / ("source-history" if problem.with_history else "source")
    return problem.setup(sizes).pretrain(folder / f"seed-{seed}.safetensors", seed)

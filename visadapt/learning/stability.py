"""Whether a world that was learnt from few samples is stable under the policy that is about to be tuned in it.

A residual may be right one step ahead and yet, fed back through the policy that opposes its corrections, let the motion
grow from step to step. Streams that go on from plan to plan drift into that motion, and the gradient is of little else.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import count, islice

import torch

from visadapt.learning.transitions import Observe, Transitions
from visadapt.learning.tuning import TuneSettings, plans_of
from visadapt.policies import Policy
from visadapt.world import World

PLANS = 15
"""Plans of 10 steps that are imagined one after the other. Where a cart-pole's motion grew until a plan cost 1,000
times the first, the first 3 plans showed nothing, the fourth 5 times, the seventh 700 times."""

GROWTH = 3.0
"""Ratio of a plan's mean cost to that of the first beyond which a world counts as unstable. A policy that was tuned in
a world with 5.5 lost 35 of 40 episodes, with 1.6 none; in most worlds it is below 1."""


COMPARED = 5
"""Plans of 10 steps by which the cost of a policy in a world is compared with that of another."""


@torch.no_grad()
def stable(
    policy: Policy,
    world: World,
    observe: Observe | None,
    settings: TuneSettings,
    generator: torch.Generator,
    transitions: Transitions,
) -> bool:
    """Whether the policy, from where its tuning starts, keeps the cost of its plans in `world` near that of the first.

    The arguments are those of `learning.tuning.tune`.
    """
    costs = _costs(policy, world, observe, settings, generator, transitions)
    first = next(costs)
    # A cost that is not a number is not within the bound either.
    return first < math.inf and all(cost <= GROWTH * first for cost in islice(costs, PLANS - 1))


@torch.no_grad()
def cost_in(
    policy: Policy,
    world: World,
    observe: Observe | None,
    settings: TuneSettings,
    generator: torch.Generator,
    transitions: Transitions,
) -> float:
    """The mean cost of the policy's first COMPARED plans in `world`, from where its tuning would start.

    The arguments are those of `learning.tuning.tune`.
    """
    costs = _costs(policy, world, observe, settings, generator, transitions)
    return sum(islice(costs, COMPARED)) / COMPARED


def _costs(
    policy: Policy,
    world: World,
    observe: Observe | None,
    settings: TuneSettings,
    generator: torch.Generator,
    transitions: Transitions,
) -> Iterator[float]:
    """Mean costs of plans that are imagined one after the other."""
    plans = plans_of(policy, world, observe, settings, generator, transitions)
    plans.streams.start(1.0, generator)
    for number in count():
        yield float(plans.loss(number, 1.0))

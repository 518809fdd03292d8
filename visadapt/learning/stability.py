"""Whether a world that was learnt from few samples is stable under the policy that is about to be tuned in it.

A residual may be right one step ahead and yet, fed back through the policy that opposes its corrections, let the motion
grow from step to step. Streams that go on from plan to plan drift into that motion, and the gradient is of little else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import count, islice

import torch

from visadapt.learning.transitions import Observe, Transitions
from visadapt.learning.tuning import DivergedError, TuneSettings, plans_of
from visadapt.policies import Policy
from visadapt.world import World

CHECKED_PLANS = 15
"""Plans of 10 steps that are imagined one after the other. Where a cart-pole's motion grew until a plan cost 1,000
times the first, the first 3 plans showed nothing, the fourth 5 times, the seventh 700 times."""

MAX_GROWTH = 3.0
"""Ratio of a plan's mean cost to that of the first beyond which a world counts as unstable. A policy that was tuned in
a world with 5.5 lost 35 of 40 episodes, with 1.6 none; in most worlds it is below 1."""

COMPARED_PLANS = 5
"""Plans of 10 steps by whose cost a policy is compared with another in the same world."""

MAX_WORSE = 2.0
"""Ratio of a policy's cost after tuning to that before beyond which the weights from before are kept. That of a policy
that needed no tuning grew by 2 %; of a ball on a plate that came to rest beside its goal, by a factor of 4.7."""


def stable(costs: Iterator[float]) -> bool:
    """Whether the `plan_costs` of a policy, from where its tuning starts, stay near the first."""
    first = next(costs)
    # A cost that is not a number is not within the bound either.
    return first < math.inf and all(cost <= MAX_GROWTH * first for cost in islice(costs, CHECKED_PLANS - 1))


def early_cost(costs: Iterator[float]) -> float:
    """The sum of the first COMPARED_PLANS `plan_costs` of a policy, by which it is compared with another."""
    return sum(islice(costs, COMPARED_PLANS))


@torch.no_grad()
def plan_costs(
    policy: Policy,
    world: World,
    observe: Observe | None,
    settings: TuneSettings,
    generator: torch.Generator,
    transitions: Transitions | None,
) -> Iterator[float]:
    """Mean costs of the policy's plans, without end, imagined one after the other from where its tuning starts.

    The arguments are those of `learning.tuning.tune`.
    """
    plans = plans_of(policy, world, observe, settings, generator, transitions)
    plans.streams.start(1.0, generator)
    for number in count():
        yield float(plans.loss(number, 1.0))


def improved(
    policy: Policy, cost: float, costs: Callable[[], Iterator[float]], tuned: Callable[[], list[float]]
) -> list[float]:
    """Tune the policy in place, by `tuned`, unless its `early_cost`, now `cost`, then grows; the losses of `tuned`.

    `costs` gives its `plan_costs`. Where the cost grows, or tuning diverges, the policy gets back the weights that it
    had, and there are no losses.

    Raises:
        DivergedError: tuning diverges, and the policy's cost was not finite before either.
    """
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    try:
        losses = tuned()
        if early_cost(costs()) <= MAX_WORSE * cost:
            return losses
    except DivergedError:
        if not math.isfinite(cost):
            raise
    policy.load_state_dict(before)
    return []

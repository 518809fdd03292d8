"""Whether a world that was learnt from few samples is stable under the policy that is about to be tuned in it.

A residual may be right one step ahead and yet, fed back through the policy that opposes its corrections, let the motion
grow from step to step. Streams that go on from plan to plan drift into that motion, and the gradient is of little else.
"""

from __future__ import annotations

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
    plans = plans_of(policy, world, observe, settings, generator, transitions)
    plans.streams.start(1.0, generator)
    first = float(plans.loss(0, 1.0))
    # A cost that is not a number is not within the bound either.
    return first < float("inf") and all(float(plans.loss(number, 1.0)) <= GROWTH * first for number in range(1, PLANS))

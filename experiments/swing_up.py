"""The CartPole swing-up (the paper's A.5): where an episode starts, and when it has succeeded."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from visadapt.evaluation import SCORE_SEED
from visadapt.policies import Policy
from visadapt.targets import Start, SyntheticTarget
from visadapt.targets.rollout import run, see_within_a_turn
from visadapt.tasks.balance import within_a_turn

STEPS, SWING = 300, 100
"""steps of an episode, and steps that may pass before the pole must be up"""
UP = math.radians(10)
ANYWHERE = (0.5, 0.5, math.pi, 1.0)
"""half-widths of the uniform distribution of the first state: x, x_dot, theta, theta_dot, in m, m/s, rad, rad/s"""


@dataclass(frozen=True)
class Score:
    """How 100 episodes went; speeds and distances are over those that succeeded, in m/s and m."""

    succeeded: int
    speed: float
    """mean |x_dot| over the whole episode"""
    speed_held: float
    """mean |x_dot| once the pole is to be up"""
    distance: float
    """mean |x| once the pole is to be up"""


def score(policy: Policy, episodes: int) -> Score:
    """Run episodes from anywhere."""
    target = SyntheticTarget(start=Start(*ANYWHERE), angle_limit=math.inf)
    runs = run(target, policy, episodes, STEPS, torch.Generator().manual_seed(SCORE_SEED), see=see_within_a_turn)
    states = torch.stack([within_a_turn(torch.as_tensor(each.episode.state)) for each in runs])
    held = states[:, SWING + 1 :]
    good = (held[..., 2].abs() < UP).all(1)
    return Score(
        int(good.sum()),
        float(states[good, :, 1].abs().mean()),
        float(held[good][..., 1].abs().mean()),
        float(held[good][..., 0].abs().mean()),
    )

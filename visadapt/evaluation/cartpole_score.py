"""How fast the cart moves, and, apart, how many episodes survive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from visadapt.policies import Policy
from visadapt.targets import Target
from visadapt.targets.rollout import Run, run

EPISODE_STEPS = 250
"""Steps of an episode that is scored."""


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


def score_cartpole(
    policy: Policy, target: Target, episodes: int, seed: int, steps: int = EPISODE_STEPS
) -> CartPoleScore:
    """Run `episodes` episodes of `steps` steps that start as `seed` says; their steps are not counted."""
    policy.eval()
    return score_runs(run(target, policy, episodes, steps, torch.Generator().manual_seed(seed)))


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

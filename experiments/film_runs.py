"""The episodes that the experiments' films show."""

from __future__ import annotations

import torch

from visadapt.policies import Policy
from visadapt.targets import Target
from visadapt.targets.rollout import Run, run
from visadapt.tasks.base import EPISODE_STEPS

FILM_SEED = 12
"""Seed of these episodes: neither that of a training nor that of a score."""


def film_run(target: Target, policy: Policy) -> Run:
    """One episode, with a start and hidden effects that are neither those of a training nor of a score."""
    return run(target, policy.eval(), 1, EPISODE_STEPS, torch.Generator().manual_seed(FILM_SEED))[0]

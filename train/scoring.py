"""What the adaptations from pixels share: scores, and episodes for the film."""

from __future__ import annotations

from dataclasses import asdict

import torch

from visadapt.evaluation.cartpole_score import STEPS, evaluate
from visadapt.policies import Policy
from visadapt.targets import Target
from visadapt.targets.rollout import Run, run, see_frames

FILM_SEED, SCORE_SEED = 12, 2026
"""Starts and phases of the film and of the final evaluation: never those of training, which counts from 0."""


def score(target: Target, policy: Policy, episodes: int) -> dict[str, object]:
    """The Evaluation of a policy that sees frames, as JSON takes it."""
    return asdict(evaluate(target, policy, see_frames, SCORE_SEED, episodes)[0])


def filmed(target: Target, policy: Policy) -> Run:
    """The episode that is shown."""
    return run(target, policy, see_frames, 1, STEPS, torch.Generator().manual_seed(FILM_SEED))[0]

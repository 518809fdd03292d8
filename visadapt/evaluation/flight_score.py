"""How far a policy's flights miss."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from visadapt.policies import Policy
from visadapt.targets import FlightTarget
from visadapt.targets.rollout import run

FAR = 1.0
"""m off its task's line at which a flight has failed."""


@dataclass(frozen=True)
class FlightScore:
    """How far flights miss. The mean includes failed flights; it is infinite where a flight's state was not finite."""

    flights: int
    failed: int
    """flights that were more than FAR off somewhere, or not finite"""
    mean: float
    """m, over flights, of the mean over each"""
    std: float
    """m, over flights"""
    worst: float
    """m, the greatest distance of all"""

    def __str__(self) -> str:
        return f"{self.mean:.4f} +- {self.std:.4f} m, {self.flights - self.failed} of {self.flights} stayed near"


def score_flights(
    policy: Policy, target: FlightTarget, flights: int, seed: int, steps: int | None = None
) -> FlightScore:
    """Fly `flights` flights that start as `seed` says; their steps are not counted."""
    policy.eval()
    generator = torch.Generator().manual_seed(seed)
    runs = run(target, policy, flights, steps or target.task.steps, generator, strict=False)
    misses = []
    for k, flown in enumerate(runs):
        if flown.survived:
            assert flown.episode.state is not None
            states = torch.as_tensor(flown.episode.state)[None]
            misses.append(target.task.misses(states, target.first[k : k + 1])[0].numpy())
        else:
            misses.append(np.array([np.inf]))
    means = np.array([miss.mean() for miss in misses])
    worst = np.array([miss.max() for miss in misses])
    mean = float(means.mean())
    std = float(means.std()) if math.isfinite(mean) else math.inf
    return FlightScore(flights, int((worst > FAR).sum()), mean, std, float(worst.max()))

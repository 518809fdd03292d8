"""The noise under which measurements are most probable, where nothing else of a linear system is unknown.

x_{t+1} = A_t x_t + c_t + w_t,     w_t ~ N(0, sum_d q_d^2 Q_d)      y_t = H_t x_t + v_t,     v_t ~ N(0, s^2 I)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from visadapt.estimation.kalman import Filtered, Linear, forward, log_likelihood

PROCESS_PRIOR = (-1.0, 1.5)
"""Mean and standard deviation of the normal prior of log10 q."""

MEASUREMENT_PRIOR = (0.5, 0.5)
"""Those of log10 s, in stated deviations: neighbouring pixels err alike, so a fit understates its error."""

MOST_ROUNDS = 12
"""Rounds of the search at most; in each all neighbours of the best noise, a step away in every parameter, are tried."""

FIRST_STEP, REFINED_STEP, LAST_STEP = 0.8, 0.3, 0.15
"""Steps of the search in prior deviations: the first one, the first from a known guess, and the shortest tried."""


@dataclass(frozen=True)
class UnknownNoise:
    """One episode of T rows whose noise is to be found; all in float64."""

    system: Linear
    """of one system; its readings are in standard deviations as stated, uncorrelated"""
    used: Tensor
    """(1, T, m) 1 where something was measured"""
    shapes: Tensor
    """(D, n, n) Q"""

    def filtered(self, noise: Noise) -> Filtered:
        """The forward pass under K candidates of the noise."""
        count = len(noise.process)
        every = {f.name: getattr(self.system, f.name) for f in fields(self.system) if f.name != "spread"}
        system = replace(self.system, **{name: x.expand(count, *x.shape[1:]) for name, x in every.items()})
        process = torch.einsum("kd,dij->kij", noise.process.square(), self.shapes)
        measured = noise.measurement.square()[:, None].expand(-1, self.used.shape[-1])
        return forward(system, process, measured)


@dataclass(frozen=True)
class Noise:
    """K candidates: intensities q (K, D), and factors s (K,) on the stated deviations of the measurements."""

    process: Tensor
    measurement: Tensor


def most_probable_noise(episodes: Sequence[UnknownNoise], guess: Noise | None = None) -> Noise:
    """The one candidate of the largest posterior density over all episodes, by pattern search (Hooke and Jeeves 1961).

    Args:
        guess: one candidate to begin with; the centre of the prior without it.
    """
    width = len(episodes[0].shapes)
    middle, spread = torch.tensor([PROCESS_PRIOR] * width + [MEASUREMENT_PRIOR], dtype=torch.float64).T
    pattern = torch.cartesian_prod(*[torch.tensor([0.0, -1.0, 1.0], dtype=torch.float64)] * (width + 1))
    best = middle if guess is None else torch.cat((guess.process[0], guess.measurement)).log10()
    step = FIRST_STEP if guess is None else REFINED_STEP
    for _ in range(MOST_ROUNDS):
        # No further than 3 prior deviations: beyond, a noise is as good as none, and rounding decides.
        candidates = middle + ((best - middle) / spread + step * pattern).clamp(-3, 3) * spread
        score = -0.5 * ((candidates - middle) / spread).square().sum(1)
        noise = Noise(10 ** candidates[:, :-1], 10 ** candidates[:, -1])
        for episode in episodes:
            score = score + log_likelihood(episode.filtered(noise), episode.used)
        winner = int(score.nan_to_num(nan=-math.inf).argmax())
        best = candidates[winner]
        if winner == 0:
            step /= 2
        if step < LAST_STEP:
            break
    return Noise(10 ** best[None, :-1], 10 ** best[-1:])

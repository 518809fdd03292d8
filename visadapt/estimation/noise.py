"""Maximum a posteriori noise intensities of a linear system that is otherwise known.

x_{t+1} = A_t x_t + c_t + w_t,     w_t ~ N(0, sum_d q_d^2 Q_d)      y_t = H_t x_t + v_t,     v_t ~ N(0, s^2 I)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.estimation.kalman import Filtered, Linear, forward, log_likelihood

PROCESS_PRIOR = (-1.0, 1.5)  # Mean and standard deviation of the normal prior of log10 q

MEASUREMENT_PRIOR = (0.5, 0.5)
"""Mean and standard deviation of the normal prior of log10 s; s above 1 is likelier, since errors of neighbouring
pixels are correlated and a fit that assumes them independent understates its standard deviation."""

MAX_ROUNDS = 12  # Rounds of the pattern search; each tries all combinations of steps -1, 0, 1 in every parameter

FIRST_STEP, REFINED_STEP, LAST_STEP = 0.8, 0.3, 0.15
"""Step lengths in prior standard deviations: the first, the first when a guess is given, and the shortest."""


@dataclass(frozen=True)
class UnknownNoise:
    """One episode of T rows with unknown noise; float64."""

    system: Linear  # one system (N = 1); readings in units of their stated standard deviations, uncorrelated
    used: Tensor  # (1, T, m) 1 where something was measured
    shapes: Tensor  # (D, n, n) covariances Q_d for unit intensity

    def filtered(self, noise: Noise) -> Filtered:
        """The forward pass under K candidates of the noise."""
        process = torch.einsum("kd,dij->kij", noise.process.square(), self.shapes)
        measured = noise.measurement.square()[:, None].expand(-1, self.used.shape[-1])
        every = process[:, None].expand(-1, self.used.shape[1] - 1, -1, -1)
        return forward(self.system.repeat(len(noise.process)), every, measured)


@dataclass(frozen=True)
class Noise:
    """K candidates."""

    process: Tensor  # (K, D) intensities q
    measurement: Tensor  # (K,) factors s on the stated standard deviations of the measurements


def most_probable_noise(episodes: Sequence[UnknownNoise], guess: Noise | None = None) -> Noise:
    """The noise (K = 1) of largest posterior density over all episodes, by pattern search (Hooke and Jeeves 1961).

    It starts at `guess` (K = 1), by default at the mean of the prior.
    """
    width = len(episodes[0].shapes)
    middle, spread = torch.tensor([PROCESS_PRIOR] * width + [MEASUREMENT_PRIOR], dtype=torch.float64).T
    pattern = torch.cartesian_prod(*[torch.tensor([0.0, -1.0, 1.0], dtype=torch.float64)] * (width + 1))
    best = middle if guess is None else torch.cat((guess.process[0], guess.measurement)).log10()
    step = FIRST_STEP if guess is None else REFINED_STEP
    for _ in range(MAX_ROUNDS):
        # At most 3 prior deviations: beyond, the noise is negligible and rounding errors would decide.
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

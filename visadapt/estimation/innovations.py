"""The whitened innovations of a fitted set, which are white noise if it is right, and their response to inputs."""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.kalman import forward, respond
from visadapt.estimation.likelihood import FitState, linear_problem, variances


class Innovations:
    """Innovations over their standard deviations, of N readings in all, projected off the derivatives by the set's own
    parameters: what refitting those would explain is not attributed to anything new.

    Args:
        model: the set.
        fits: its fit (C = 1).
    """

    def __init__(self, model: CandidateModel, fits: FitState) -> None:
        rows = model.rows
        self.rows = rows
        self._problem = linear_problem([model], fits)
        self._filtered = forward(self._problem, *variances(model, fits.log_process, fits.log_noise))
        white = self._white(self._filtered.innovation)
        self._known, _ = torch.linalg.qr(white[:, 1:])
        self.error: Tensor = self._projected(white[:, :1])[:, 0]
        """(N,)"""

    def response(self, drive: Tensor, reading: Tensor) -> Tensor:
        """Change (N, M) of the innovations with M inputs: `drive` (W, T - 1, n, M) and `reading` (W, T, m, M)."""
        return self._projected(self._white(respond(self._problem, self._filtered, drive, reading)))

    def _white(self, innovation: Tensor) -> Tensor:
        white = innovation / self._filtered.variance.sqrt()[..., None] * self.rows.used[..., None]
        return white.reshape(-1, white.shape[-1])

    def _projected(self, white: Tensor) -> Tensor:
        return white - self._known @ (self._known.T @ white)

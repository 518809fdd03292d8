"""The whitened innovations of a fitted set: white noise where the set is right, and what would change them."""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.kalman import forward, respond
from visadapt.estimation.likelihood import FitState, linear_problem, variances


class Innovations:
    """Innovations over their deviations, N readings in all; what the set's own parameters can explain is taken out.

    Args:
        model: the set.
        fits: its fit, of one set alone.
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

    def answer(self, drive: Tensor, reading: Tensor) -> Tensor:
        """How they change (N, M) with inputs: drive (W, T - 1, n, M) to the states, and reading (W, T, m, M)."""
        return self._projected(self._white(respond(self._problem, self._filtered, drive, reading)))

    def _white(self, innovation: Tensor) -> Tensor:
        white = innovation / self._filtered.variance.sqrt()[..., None] * self.rows.used[..., None]
        return white.reshape(-1, white.shape[-1])

    def _projected(self, white: Tensor) -> Tensor:
        return white - self._known @ (self._known.T @ white)

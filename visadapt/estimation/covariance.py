"""The covariance of a fit's parameters, also where no model is right.

If the model is right its innovations are white, and the covariance is the inverse of Fisher's information I. What a
wrong model leaves unexplained lasts for several rows, so that these do not inform independently. The covariance is then
I^-1 J I^-1 with the long-run covariance J of the scores (Huber 1967, Proc. 5th Berkeley Symposium 1), here with the
weights of Newey and West (1987, Econometrica 55(3)).
"""

from __future__ import annotations

import torch
from torch import Tensor

from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.colour import whitened
from visadapt.estimation.fit_states import Effects, posterior
from visadapt.estimation.kalman import forward
from visadapt.estimation.likelihood import FitState, linear_problem, variances

VAGUE = 1e-4
"""Share of the prior's precision that is added to the information, so that it can be inverted where data show nothing.
The whole of it would be right for a maximum a posteriori estimate; those used here are of maximum likelihood."""


def inverse_information(effects: Effects, fits: FitState) -> Tensor:
    """Covariance (K, K) of the parameters of a fit (C = 1), if the model is right."""
    precision, _ = posterior(effects, fits)
    return torch.linalg.inv(fits.information[0] + VAGUE * torch.diag(precision))


def deviations(model: CandidateModel, fits: FitState) -> Tensor:
    """Standard deviations (K,) of the parameters of a fit (C = 1): the larger of both covariances' for each.

    The long-run covariance is estimated from the recording, and too small where that is short. Scores further apart
    than a prediction reaches are taken as independent.
    """
    rows = model.rows
    covariance = inverse_information(model.effects, fits)
    problem = linear_problem([model], fits)
    filtered = forward(problem, *variances(model, fits, problem))
    white = whitened(filtered.white, rows.colour)
    score = (white[..., :1] * white[..., 1:]).sum(2)
    length = score.shape[1]
    last = min(length - 1, round(model.system.prediction_time / rows.period))
    scores = torch.einsum("wtk,wtl->kl", score, score)
    for lag in range(1, last + 1):
        product = torch.einsum("wtk,wtl->kl", score[:, lag:], score[:, : length - lag])
        scores = scores + (1 - lag / (last + 1)) * (product + product.T)
    robust = covariance @ scores @ covariance
    return torch.maximum(covariance.diagonal(), robust.diagonal()).sqrt()

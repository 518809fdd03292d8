"""The disturbance estimate: the loads that act on a system in addition to what a set of effects explains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.diagnosis.search.unexplained import loads_of, variables_of
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.kalman import backward, forward
from visadapt.estimation.likelihood import FitState, linear_problem, variances


@dataclass(frozen=True)
class Disturbance:
    """Smoothed disturbance estimate over W windows of T rows."""

    load: Tensor
    """(W, T - 1, loads) in N or N m, constant over the period after a row"""
    valid: Tensor
    """(W, T - 1) 1 within the windows, 0 in their padding"""
    variables: Mapping[str, Tensor]
    """(W, T - 1) states, commands, time and episode by name"""

    @property
    def power(self) -> Tensor:
        """(W, T - 1) mean square of the loads, each divided by its own mean square over the valid rows."""
        square = self.load.square() * self.valid[..., None]
        mean = square.sum((0, 1)) / self.valid.sum()
        return (square / mean.clamp(min=1e-300)).mean(-1)


def disturbance(model: CandidateModel, fits: FitState, log_process: Tensor) -> Disturbance:
    """The loads with which a fitted set follows the recording, given log process noise variances (1, G)."""
    fits = replace(fits, log_process=log_process)
    driven = model.profile.driven_columns
    rows = model.rows
    problem = linear_problem([model], fits)
    process, noise = variances(model, fits.log_process, fits.log_noise)
    _, adjoint = backward(problem, forward(problem, process, noise))
    added = -(adjoint[..., 0] @ process)[:, 1:, driven]
    by_load = loads_of(model, fits)[:, :, driven]
    # The padding has no response to a load; any invertible matrix serves there.
    valid = rows.inside[:, 1:]
    by_load = torch.where(valid[..., None, None] > 0, by_load, torch.eye(len(driven), dtype=by_load.dtype))
    load = torch.linalg.solve(by_load, added[..., None])[..., 0] * valid[..., None]
    variables = {name: values[:, :-1] for name, values in variables_of(model, fits.state[0]).items()}
    variables["episode"] = rows.episode[:, None].double().expand_as(valid)
    return Disturbance(load, valid, variables)

"""The black box: the best that a flexible model predicts beside a fitted set of effects.

It is a Gaussian process of all variables together (states, commands, commands of the period before, time) for the load
on each degree of freedom, with a length for each variable. Loads pass through the fitted set's filter, as those of
`unexplained.py` do: so noisy and missing states are taken into account, and for given lengths and amplitudes the
posterior mean and the marginal likelihood, which they maximise, are exact. The process is approximated by a subset of
regressors (Quinonero-Candela and Rasmussen 2005, Journal of Machine Learning Research 6).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.diagnosis.search.unexplained import loads_of, variables_of
from visadapt.estimation.candidate import COARSE, CandidateModel, with_loads
from visadapt.estimation.kalman import forward, respond
from visadapt.estimation.likelihood import FitState, linear_problem, min_log_process, variances
from visadapt.world import World

POINTS = 50  # Rows of the recording at which the kernel's functions are centred

OPTIMISED_ROWS = 500  # Rows, about, to which lengths and amplitudes are fitted; the weights use every row

ITERATIONS, REFINING_ITERATIONS = 15, 7
"""Steps of the optimiser of lengths and amplitudes, and those after a change of the process noise."""

LOG_LENGTH = math.log(2.0)  # Prior mean of a log length, in standard deviations of the variable

LOG_SPREAD = 3.0  # Prior standard deviation of log lengths and log amplitudes

LOG_REACH = 12.0
"""Largest departure of log lengths and log amplitudes from their prior mean: at e^100, which a line search may try, no
matrix is positive definite in float64."""

MAX_DECADES = 4  # Most decades by which process noise is lowered beside the black box

MIN_GAIN = 3.0
"""Log likelihood that a black box with less process noise must gain on windows that it was not fitted to: it might
follow what does not repeat."""

JITTER = 1e-6  # Added to the kernel's diagonal, whose values are 1


@dataclass(frozen=True)
class BlackBox:
    """A black box fitted beside a set of effects; D variables, L loads."""

    model: CandidateModel  # the set with a constant load on each degree of freedom
    fits: FitState  # of the set alone, with the process noise that remains beside the black box
    centre: Tensor  # (D,)
    scale: Tensor  # (D,)
    points: Tensor  # (M, D)
    weights: Tensor  # (M, L) in the loads' units

    def loads(self, variables: Tensor) -> Tensor:
        """Loads (..., L) at variables (..., D), which are those of `inputs`."""
        return _kernel((variables - self.centre) / self.scale, self.points) @ self.weights

    def at(self, variables: Tensor, values: Tensor) -> World:
        """The world in which N states step with the loads at `variables` (N, D), held for a period; `values` (P,) or
        (N, P) are the parameters of the set's effects."""
        loads = self.loads(variables)
        return self.model.at(torch.cat((values.expand(len(loads), -1), loads), -1))


def inputs(model: CandidateModel, state: Tensor) -> Tensor:
    """The variables (W, T, D) along states (W, T, n): the states first, time last."""
    return torch.stack(list(variables_of(model, state).values()), -1)


def fit_black_box(model: CandidateModel, fits: FitState) -> BlackBox:
    """The black box of a fitted set, fitted to the model's rows."""
    here = model.rows.inside[:, 1:]
    values = inputs(model, fits.state[0])[:, :-1]
    centre, scale = values[here > 0].mean(0), values[here > 0].std(0).clamp(min=1e-9)
    values = (values - centre) / scale
    gains = loads_of(model, fits) * here[..., None, None]
    values = values * here[..., None]
    first = regression = _Regression.of(model, fits, gains, values, here)
    logs = regression.optimised(regression.start(), ITERATIONS)
    best = nominal = first.validated(regression, logs), fits, logs, regression
    for decade in range(1, 1 + MAX_DECADES):
        # What the black box explains is no longer process noise.
        lowered = (fits.log_process - decade * math.log(10)).clamp(min=min_log_process(model.rows.period))
        tried = replace(fits, log_process=lowered)
        regression = _Regression.of(model, tried, gains, values, here)
        logs = regression.optimised(logs, REFINING_ITERATIONS)
        gain = first.validated(regression, logs)
        if gain <= best[0]:
            break
        best = gain, tried, logs, regression
    _, remaining, logs, regression = best if best[0] > nominal[0] + MIN_GAIN else nominal
    lengths, weights = regression.weights(logs)
    return BlackBox(with_loads(model, COARSE), remaining, centre, scale * lengths, regression.points / lengths, weights)


@dataclass(frozen=True)
class _Regression:
    """Linear regression of the whitened innovations by the loads at every row of W windows of T rows."""

    values: Tensor  # (W, T - 1, D) variables, in standard deviations from their means
    here: Tensor  # (W, T - 1) 1 where a load acts
    points: Tensor  # (M, D)
    information: Tensor  # (W, L, L, T - 1, T - 1) of the loads
    gradient: Tensor  # (W, L, T - 1) of the log likelihood by the loads, at zero

    @classmethod
    def of(cls, model: CandidateModel, fits: FitState, gains: Tensor, values: Tensor, here: Tensor) -> _Regression:
        """The regression with the filter of `fits`.

        `gains` (W, T - 1, n, L) is the change of the states per unit of each load.
        """
        windows, steps, _, loads = gains.shape
        problem = linear_problem([model], fits).data()
        filtered = forward(problem, *variances(model, fits, problem))
        drive = torch.diag_embed(gains.permute(0, 2, 3, 1)).permute(0, 4, 1, 2, 3).flatten(3)
        response = respond(filtered, drive, torch.zeros_like(filtered.white)).flatten(1, 2)
        error = filtered.white.flatten(1, 2)
        information = (response.mT @ response).reshape(windows, loads, steps, loads, steps).transpose(2, 3)
        gradient = -(response.mT @ error).reshape(windows, loads, steps)
        chosen = torch.randperm(int(here.sum()), generator=torch.Generator().manual_seed(0))[:POINTS]
        return cls(values, here, values[here > 0][chosen], information, gradient)

    def start(self) -> Tensor:
        """Prior means (D + L,) of log lengths and log amplitudes: loads are as large as noise."""
        known = self.information.diagonal(dim1=1, dim2=2).diagonal(dim1=1, dim2=2).sum((0, 2)) / self.here.sum()
        return torch.cat((torch.full_like(self.values[0, 0], LOG_LENGTH), -0.5 * (known + 1e-300).log()))

    def optimised(self, start: Tensor, iterations: int) -> Tensor:
        """The most probable log lengths and amplitudes (D + L,), by L-BFGS from `start`."""
        stride = max(1, round(float(self.here.sum()) / OPTIMISED_ROWS))
        some = torch.nonzero(self.here.sum(1))[::stride, 0]
        # A diagnosis runs in inference mode, whose tensors have no gradients: copies made outside of it have.
        with torch.inference_mode(False), torch.enable_grad():
            part = _Regression(
                self.values[some].clone(),
                self.here[some].clone(),
                self.points.clone(),
                self.information[some].clone(),
                self.gradient[some].clone(),
            )
            prior = self.start().clone()
            free = (LOG_REACH * ((start.clone() - prior) / LOG_REACH).atanh()).requires_grad_()

            def bounded() -> Tensor:
                return prior + LOG_REACH * (free / LOG_REACH).tanh()

            optimiser = torch.optim.LBFGS(
                [free], max_iter=iterations, tolerance_change=1e-3, line_search_fn="strong_wolfe"
            )

            def loss() -> Tensor:
                optimiser.zero_grad()
                logs = bounded()
                value = 0.5 * ((logs - prior) / LOG_SPREAD).square().sum() - part.evidence(logs)[0]
                value.backward()
                return value

            optimiser.step(loss)
            return bounded().detach()

    def evidence(self, logs: Tensor) -> tuple[Tensor, Tensor]:
        """Log odds of the loads against none, for lengths and amplitudes, and the posterior mean weights (L M,)."""
        lengths, amplitudes = self._split(logs)
        factor = self._factor(lengths)
        at = _kernel(self.values / lengths, self.points / lengths)
        basis = torch.linalg.solve_triangular(factor, at.mT, upper=False).mT * self.here[..., None]
        size = amplitudes.repeat_interleave(len(self.points))
        normal = torch.einsum("wtm,wabtn->ambn", basis, self.information @ basis[:, None, None])
        normal = size[:, None] * normal.reshape(len(size), len(size)) * size
        gradient = size * torch.einsum("wtm,wat->am", basis, self.gradient).flatten()
        root = torch.linalg.cholesky(normal + torch.eye(len(size), dtype=normal.dtype))
        white = torch.linalg.solve_triangular(root, gradient[:, None], upper=False)
        value = 0.5 * white.square().sum() - root.diagonal().log().sum()
        return value, size * torch.linalg.solve_triangular(root.mT, white, upper=True)[:, 0]

    def validated(self, other: _Regression, logs: Tensor) -> float:
        """Log likelihood gained in each half of the windows by the loads that `other` finds in the other half."""
        gain = 0.0
        ordinal = self.here.amax(1).cumsum(0)
        for parity in (0, 1):
            half = (ordinal % 2 == parity).to(self.values.dtype)
            part = replace(
                other,
                information=other.information * half[:, None, None, None, None],
                gradient=other.gradient * half[:, None, None],
            )
            lengths, weights = part.weights(logs)
            loads = (_kernel(self.values / lengths, self.points / lengths) @ weights * self.here[..., None]).mT
            square = torch.einsum("wat,wabts,wbs->w", loads, self.information, loads)
            gain += float(((1 - half) * ((self.gradient * loads).sum((1, 2)) - 0.5 * square)).sum())
        return gain

    def weights(self, logs: Tensor) -> tuple[Tensor, Tensor]:
        """Lengths (D,), and weights (M, L) of the kernel's functions."""
        lengths, _ = self._split(logs)
        weights = self.evidence(logs)[1].reshape(-1, len(self.points)).mT
        return lengths, torch.linalg.solve_triangular(self._factor(lengths).mT, weights, upper=True)

    def _split(self, logs: Tensor) -> tuple[Tensor, Tensor]:
        variables = self.values.shape[-1]
        return logs[:variables].exp(), logs[variables:].exp()

    def _factor(self, lengths: Tensor) -> Tensor:
        points = self.points / lengths
        kernel = _kernel(points, points)
        return torch.linalg.cholesky(kernel + JITTER * torch.eye(len(points), dtype=kernel.dtype))


def _kernel(values: Tensor, points: Tensor) -> Tensor:
    """Squared exponential kernel (..., M) of values (..., D) with points (M, D), both in lengths."""
    square = values.square().sum(-1, keepdim=True) + points.square().sum(-1) - 2 * values @ points.mT
    return torch.exp(-0.5 * square.clamp(min=0))

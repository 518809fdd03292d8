"""The most probable states of a fitted set, where the model is strongly nonlinear.

Where dry friction stops a joint within a row, its next velocity does not depend on this one: one step of a linear
smoother may then lead to states that are on no trajectory of the model. So steps are damped, the model is linearised
anew where they lead, and those that lead to less probable states are rejected (Sarkka and Svensson 2020,
Levenberg-Marquardt and line-search extended Kalman smoothers, ICASSP).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from visadapt.batch import Batch
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.kalman import Linear, backward, forward
from visadapt.estimation.likelihood import FitState, linear_problem, variances

LARGEST_UNVERIFIED = 2.0
"""Decrease of a window's cost, -2 log probability, up to which a step is taken without a damped one first."""

MOST_STEPS = 40
FIRST_DAMPING, MAX_DAMPING = 1e2, 1e9
"""Damping of the first step, and that at which a window's states are kept as they are: one over the variance, in
squared scales of a state, with which a state is held where it was. It falls or grows tenfold after each step."""

AddLoads = Callable[[CandidateModel, FitState, Linear], Linear]
"""Adds loads that act beside a model's to its linear problem."""


def smoothed_states(model: CandidateModel, fits: FitState, add_loads: AddLoads | None = None) -> Tensor:
    """(W, T, n) the most probable states of a single fit (C = 1), from its own on."""
    at = _Linearised.along(model, fits, fits.state[0], add_loads)
    step, decrease = at.step()
    unsure = (decrease > LARGEST_UNVERIFIED).nonzero()[:, 0]
    state = fits.state[0] + step
    if len(unsure):
        state[unsure] = fits.state[0][unsure]
        _verify(model, fits, state, at[unsure], unsure, add_loads)
    return state


def _verify(
    model: CandidateModel,
    fits: FitState,
    state: Tensor,
    best: _Linearised,
    unsure: Tensor,
    add_loads: AddLoads | None,
) -> None:
    """Move the states (W, T, n) of the windows `unsure` (N,), which are those of `best`, in damped steps that are
    verified."""
    scale = state.new_tensor([one.scale for one in model.system.states])
    damping = torch.full_like(best.cost, FIRST_DAMPING)
    late = any(model.rows_later(fits.theta[0]))
    for _ in range(MOST_STEPS):
        step, _ = best.step(damping[:, None] / scale.square())
        if late:  # readings of a window are then in the rows of the next
            model.slopes = None
            tried = _Linearised.along(model, fits, state.index_copy(0, unsure, best.state + step), add_loads)[unsure]
        else:
            tried = _Linearised.along(model.on(unsure), fits.on(unsure), best.state + step, add_loads)
        better = tried.cost < best.cost
        best, damping = tried.where(better, best), torch.where(better, damping / 10, damping * 10)
        state[unsure] = best.state
        left = ((best.step()[1] > LARGEST_UNVERIFIED) & (damping < MAX_DAMPING)).nonzero()[:, 0]
        unsure, best, damping = unsure[left], best[left], damping[left]
        if not len(unsure):
            break


@dataclass(frozen=True)
class _Linearised(Batch):
    """A model along states, for W windows."""

    state: Tensor  # (W, T, n)
    problem: Linear
    process: Tensor  # (W, T - 1, n, n) covariances of the process noise
    noise: Tensor  # (W, m) variances of the readings
    cost: Tensor  # (W,) -2 log probability of the states, without its determinants

    @classmethod
    def along(cls, model: CandidateModel, fits: FitState, state: Tensor, add_loads: AddLoads | None) -> _Linearised:
        """A model along these states, with the parameters and the noise of a single fit."""
        fits = replace(fits, state=state[None])
        problem = linear_problem([model], fits).data()
        if add_loads is not None:
            problem = add_loads(model, fits, problem)
        process, noise = variances(model, fits, problem)
        drive, reading, start = problem.drive[..., 0], problem.reading[..., 0], problem.start[..., 0]
        weighed = torch.linalg.solve_ex(process, drive[..., None]).result[..., 0]
        of_drive, of_start = (drive * weighed).sum((1, 2)), (start.square() / problem.initial_variance).sum(1)
        cost = of_drive + of_start + (reading.square() / noise[:, None]).sum((1, 2))
        return cls(state, problem, process, noise, cost)

    def step(self, damping: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The smoother's step (W, T, n) from the states, and the decrease (W,) of the cost that the linear problem
        promises. `damping` (W, n) is one over the variance with which each state is held where it is."""
        problem, noise = self.problem, self.noise
        if damping is not None:
            windows, length, _, n = problem.sensing.shape
            held = torch.eye(n, dtype=noise.dtype, device=noise.device).expand(windows, length, n, n)
            sensing = torch.cat((problem.sensing, held), 2)
            reading = torch.cat((problem.reading, problem.reading.new_zeros(windows, length, n, 1)), 2)
            problem = replace(problem, sensing=sensing, reading=reading)
            noise = torch.cat((noise, 1 / damping), 1)
        filtered = forward(problem, self.process, noise)
        # A set that cannot be simulated, with a mass matrix that is singular, say, stays where it was fitted.
        step = backward(filtered)[0][..., 0].nan_to_num(0, 0, 0)
        return step, self.cost - filtered.white[..., 0].square().sum((1, 2))

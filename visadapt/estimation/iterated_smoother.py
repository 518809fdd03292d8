"""The most probable states of a fitted set, where the model is not linear as far as a smoother corrects them.

Within a row in which a joint with dry friction comes to rest, its next velocity does not depend on this one: linearised
there, a smoother may move states by any amount, to such as the model does not lead through. So the corrections are
damped, the model is linearised anew at the states found, and those that are less probable are rejected (Sarkka and
Svensson 2020, Levenberg-Marquardt and line-search extended Kalman smoothers, ICASSP).
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

NOT_LINEAR = 2.0
"""Decrease of a window's -2 log probability, as the linearised model promises it, from which on it is verified."""

MOST_STEPS = 40
FIRST_DAMPING, MAX_DAMPING = 1e2, 1e9
"""Precisions, per squared scale of a state, with which a state is held where it was in the first step, and in the last
before a window's states are kept as they are."""

Driven = Callable[[CandidateModel, FitState, Linear], Linear]
"""Adds what else drives the states of a model to its linear problem."""


def smoothed_states(model: CandidateModel, fits: FitState, driven: Driven | None = None) -> Tensor:
    """(W, T, n) the most probable states of a single fit (C = 1), from its own on."""
    at = _Linearised.at(model, fits, fits.state[0], driven)
    correction, decrease = at.correction()
    state = fits.state[0] + correction
    unsure = (decrease > NOT_LINEAR).nonzero()[:, 0]
    return _verified(model, fits, state, at[unsure], unsure, driven) if len(unsure) else state


def _verified(
    model: CandidateModel, fits: FitState, state: Tensor, best: _Linearised, unsure: Tensor, driven: Driven | None
) -> Tensor:
    """The states (W, T, n), those of the windows `unsure` (N,) by damped corrections, each of which is verified, of the
    states of `best`."""
    scale = state.new_tensor([one.scale for one in model.system.states])
    damping = torch.full_like(best.improbable, FIRST_DAMPING)
    for _ in range(MOST_STEPS):
        few = CandidateModel(model.system, model.effects, model.rows.select(unsure), model.accuracy)
        correction, _ = best.correction(damping[:, None] / scale.square())
        tried = _Linearised.at(few, fits.on(unsure), best.state + correction, driven)
        better = tried.improbable < best.improbable
        best, damping = tried.where(better, best), torch.where(better, damping / 10, damping * 10)
        state[unsure] = best.state
        left = ((best.correction()[1] > NOT_LINEAR) & (damping < MAX_DAMPING)).nonzero()[:, 0]
        unsure, best, damping = unsure[left], best[left], damping[left]
        if not len(unsure):
            break
    return state


@dataclass(frozen=True)
class _Linearised(Batch):
    """A model along states, for W windows."""

    state: Tensor  # (W, T, n)
    problem: Linear
    process: Tensor  # (W, T - 1, n, n)
    noise: Tensor  # (W, m)
    improbable: Tensor  # (W,) -2 log probability of the states, up to a constant

    @classmethod
    def at(cls, model: CandidateModel, fits: FitState, state: Tensor, driven: Driven | None) -> _Linearised:
        """A model along these states, with the parameters and the noise of a single fit."""
        fits = replace(fits, state=state[None])
        problem = linear_problem([model], fits).data()
        if driven is not None:
            problem = driven(model, fits, problem)
        process, noise = variances(model, fits, problem)
        drive, reading, start = problem.drive[..., 0], problem.reading[..., 0], problem.start[..., 0]
        weighed = torch.linalg.solve_ex(process, drive[..., None]).result[..., 0]
        of_drive, of_start = (drive * weighed).sum((1, 2)), (start.square() / problem.initial_variance).sum(1)
        return cls(
            state, problem, process, noise, of_drive + of_start + (reading.square() / noise[:, None]).sum((1, 2))
        )

    def correction(self, damping: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The smoother's correction (W, T, n) of the states, and the decrease (W,) of -2 log probability that it
        promises. `damping` (W, n) is a precision with which each state is held where it is."""
        problem, noise = self.problem, self.noise
        if damping is not None:
            windows, length, _, n = problem.sensing.shape
            held = torch.eye(n, dtype=noise.dtype).expand(windows, length, n, n)
            sensing = torch.cat((problem.sensing, held), 2)
            reading = torch.cat((problem.reading, problem.reading.new_zeros(windows, length, n, 1)), 2)
            problem = replace(problem, sensing=sensing, reading=reading)
            noise = torch.cat((noise, 1 / damping), 1)
        filtered = forward(problem, self.process, noise)
        # A set that cannot be simulated, with a mass matrix that is singular, say, stays where it was fitted.
        correction = backward(filtered)[0][..., 0].nan_to_num(0, 0, 0)
        return correction, self.improbable - filtered.white[..., 0].square().sum((1, 2))

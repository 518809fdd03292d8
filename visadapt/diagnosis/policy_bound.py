"""Theorem 1 of the paper for a given policy: what bounds its error on the machine, before and after the causes.

    E|f*(s, pi(s)) - nu|  <=  delta + L E|pi(s) - pi_hat(s)| + E[zeta]                                    (equation 8)

    delta = E|f_hat(s, pi(s)) - f*(s, pi(s))|                                                             (equation 6)
    L     = max over s, a1, a2 of |f_hat(s, a1) - f_hat(s, a2)| / |a1 - a2|                               (equation 7)
    zeta  = min over a of |f_hat(s, a) - nu|, reached by pi_hat(s)                                 (equations 4 and 5)

Equation 5 bounds the distance for every action; the proof needs it at pi_hat alone, where it is least. Norms are
Euclidean over one step's state in SI units, as the theorem has them: the weights of a cost that some policy was
trained with would leave out what that cost does (the paper's, the cart's position). The states s are those that the
smoother estimates in the recording; the reference nu is the first state of the line to the goal (`learning.cost`).

Nobody has f*. What the recording tells of it is the step of the best set of effects, with the disturbance that the
smoother finds beside it. |.| in delta is the root of the mean square over the parameters that the effects may have, so
that delta does not fall below what the recording leaves open. What an effect explains is so found within a percent;
what none explains, from smoothed disturbances alone, at up to one and a half times its size where velocities were not
measured. (Its variance would add more: for what is no white noise, the likeliest one is far too large.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from visadapt.diagnosis.result import PolicyTerms
from visadapt.diagnosis.search.search import ScoredModel
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fit_states import posterior
from visadapt.estimation.kalman import backward, forward
from visadapt.estimation.likelihood import linear_problem, variances
from visadapt.estimation.segments import Segments
from visadapt.history import HORIZON, LENGTH, History
from visadapt.policies import ImagePolicy, Policy
from visadapt.systems import System

StatesToActions = Policy | Callable[[Tensor], Any]
"""A policy on states: a `Policy`, or what maps states (N, n_state) to actions (N, n_action) in [-1, 1]."""

GRID = 41
"""Commands from -1 to 1 at which a step is computed; between two of them it is taken for straight."""


@dataclass(frozen=True)
class Known:
    """What a recording tells of the machine's steps, from every row but the last of W windows of T rows."""

    state: Tensor
    """(W, T - 1, n) smoothed, angles within half a turn of upright"""
    beside: Tensor
    """(W, T - 1, n) what adds to the step of the best set, smoothed"""
    variance: Tensor
    """(W, T - 1) of that step by its parameters, summed over the states"""


def check(policy: StatesToActions, system: System) -> None:
    """Raise ValueError for what cannot be a policy on the states of `system`."""
    n, n_action = len(system.states), len(system.actions)
    if n_action != 1:
        raise ValueError(f"diagnose: Theorem 1's terms need a system with one action; {system.name} has {n_action}")
    if isinstance(policy, ImagePolicy):
        raise ValueError("diagnose: the policy sees frames, and a diagnosis has states alone; give a policy on states")
    if isinstance(policy, Policy) and (policy.n_state, policy.n_action) != (n, n_action):
        raise ValueError(
            f"diagnose: the policy is made for {policy.n_state} states and {policy.n_action} actions; "
            f"{system.name} has {n} and {n_action}"
        )
    actions(policy, History.start(torch.zeros(2, n, dtype=torch.float64), n_action))


def actions(policy: StatesToActions, history: History) -> Tensor:
    """What a policy does (B, n_action) after a history of states, in float64."""
    if isinstance(policy, Policy):
        dtype = next(policy.parameters()).dtype
        done = policy.act(History(history.observations.to(dtype), history.actions.to(dtype)))
    else:
        done = torch.as_tensor(policy(history.observations[:, -1].to(torch.get_default_dtype())))
    batch, _, n_action = history.actions.shape
    if done.shape != (batch, n_action) or not bool(done.isfinite().all()):
        what = "values that are not finite" if done.shape == (batch, n_action) else f"the shape {tuple(done.shape)}"
        raise ValueError(
            f"diagnose: for states ({batch}, {history.observations.shape[-1]}) the policy gave {what}; "
            f"actions ({batch}, {n_action}) in [-1, 1] are right"
        )
    return done.double().clamp(-1, 1)


def policy_terms(policy: StatesToActions, system: System, rows: Segments, best: ScoredModel) -> PolicyTerms:
    """Theorem 1's terms with the source as f_hat, and with the best set of effects.

    The policy acts on what the sensors would read of the states, as it does on the machine.
    """
    corrected = CandidateModel(system, best.effects, rows)
    known = _known(corrected, best)
    histories, there = _histories(corrected.at(best.fits.theta[0]).reading(known.state.flatten(0, 1)), rows)
    acted = actions(policy, histories).reshape(known.variance.shape)
    before = Steps.of(CandidateModel(system, (), rows), best.fits.theta[0, :0], known.state, acted, there)
    after = Steps.of(corrected, best.fits.theta[0], known.state, acted, there)
    machine = after.own + known.beside[there]
    pairs = zip(before.terms(machine, known.variance[there]), after.terms(machine, known.variance[there]), strict=True)
    return PolicyTerms(*pairs)


def _known(model: CandidateModel, best: ScoredModel) -> Known:
    fits = best.fits
    problem = linear_problem([model], fits)
    process, noise = variances(model, fits.log_process, fits.log_noise)
    smoothed, adjoint = backward(problem.data(), forward(problem.data(), process, noise))
    beside = -(adjoint[..., 0] @ process)[:, 1:]
    by_parameter = problem.drive[..., 1:]
    covariance = torch.linalg.inv(posterior(best.effects, fits)[1])
    variance = ((by_parameter @ covariance) * by_parameter).sum((-1, -2))
    state = (fits.state[0] + smoothed[..., 0])[:, :-1]
    angle = model.system.index("theta")
    state[..., angle] = torch.atan2(state[..., angle].sin(), state[..., angle].cos())
    return Known(state, beside, variance)


def _histories(seen: Tensor, rows: Segments) -> tuple[History, Tensor]:
    """What a policy has seen (W (T - 1), n) and did, and the rows (W, T - 1) of which all of it is known."""
    windows, length = rows.shape
    seen = seen.reshape(windows, length - 1, -1)
    padded = torch.cat((seen[:, :1].expand(-1, LENGTH - 1, -1), seen), 1)
    observations = padded.unfold(1, LENGTH, 1).mT
    # The row of the episode at which each of the actions before a row began.
    row = rows.first[:, None, None] + torch.arange(length - 1)[:, None] + torch.arange(-LENGTH, 0)
    given = rows.command[rows.episode[:, None, None], row.clamp(min=0)] * (row >= 0)[..., None]
    # A window that begins within an episode does not hold the states before it.
    there = (rows.first[:, None] == 0) | (torch.arange(length - 1) >= LENGTH - 1)
    return History(observations.flatten(0, 1), given.flatten(0, 1)), there & (rows.inside[:, 1:] > 0)


@dataclass(frozen=True)
class Steps:
    """A model's steps from N states."""

    own: Tensor
    """(N, n) under the policy's actions"""
    acted: Tensor
    """(N,) these"""
    nodes: Tensor
    """(N, GRID, n) under commands from -1 to 1"""
    reference: Tensor
    """(N, n) nu"""

    @classmethod
    def of(cls, model: CandidateModel, theta: Tensor, state: Tensor, acted: Tensor, there: Tensor) -> Steps:
        """With parameters (P,) from states (W, T - 1, n) where they are `there`, under actions (W, T - 1)."""
        tried = torch.cat((acted[..., None], _grid().expand(*acted.shape, -1)), -1)[there]
        now = state[there]
        begun = model.started(theta, state)[there.flatten()][torch.arange(len(now)).repeat_interleave(1 + GRID)]
        reached = model.at(theta).step(begun, tried.flatten()[:, None]).state.reshape(len(now), 1 + GRID, -1)
        return cls(reached[:, 0], acted[there], reached[:, 1:], (1 - 1 / HORIZON) * now)

    def terms(self, machine: Tensor, variance: Tensor) -> tuple[float, float, float, float]:
        """delta, L, E|pi - pi_hat| and E[zeta], for steps of the machine (N, n) with a variance (N,)."""
        delta = ((self.own - machine).square().sum(-1) + variance).sqrt()
        width = 2 / (GRID - 1)
        slopes = self.nodes.diff(dim=1) / width
        # The point of each straight piece that is nearest to the reference, then the nearest of all.
        away = self.reference[:, None] - self.nodes[:, :-1]
        along = (away * slopes).sum(-1) / slopes.square().sum(-1).clamp(min=1e-300)
        along = along.clamp(0, width)
        zeta, piece = (along[..., None] * slopes - away).norm(dim=-1).min(1)
        best = _grid()[piece] + along.gather(1, piece[:, None])[:, 0]
        gap = (self.acted - best).abs()
        return float(delta.mean()), float(slopes.norm(dim=-1).max()), float(gap.mean()), float(zeta.mean())


def _grid() -> Tensor:
    return torch.linspace(-1, 1, GRID, dtype=torch.float64)

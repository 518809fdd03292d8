"""Theorem 1 of the paper for a given policy: a bound on its error on the machine, before and after the causes.

    E|f*(s, pi(s)) - nu|  <=  delta + L E|pi(s) - pi_hat(s)| + E[zeta]                                    (equation 8)

    delta = E|f_hat(s, pi(s)) - f*(s, pi(s))|                                                             (equation 6)
    L     = max over s, a1, a2 of |f_hat(s, a1) - f_hat(s, a2)| / |a1 - a2|                               (equation 7)
    zeta  = min over a of |f_hat(s, a) - nu|, reached by pi_hat(s)                                 (equations 4 and 5)

Equation 5 bounds the distance for every action; the proof needs it at pi_hat alone, where it is smallest. Norms are
Euclidean over one step's state in SI units, as in the theorem; weights of a training cost would hide the states that
the cost ignores (the paper's ignores the cart's position). The states s are those that the smoother estimates in the
recording; the reference nu is the first state of the line to the goal (`tasks.balance`).

f* is unknown. Its estimate is the step of the best set of effects plus the smoothed disturbance. |.| in delta is the
root mean square over the posterior of the effects' parameters, so that delta does not fall below the remaining
uncertainty. What an effect explains is estimated within 1 %; what none explains, from smoothed disturbances alone, is
overestimated by up to 50 % where velocities were not measured. The disturbance's variance is not added: modelled as
white noise, which it is not, it would be far too large.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from visadapt.diagnosis.result import PolicyTerms
from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fit_states import posterior
from visadapt.estimation.kalman import backward, forward
from visadapt.estimation.likelihood import linear_problem, variances
from visadapt.estimation.segments import Segments
from visadapt.history import HORIZON, LENGTH, History
from visadapt.policies import ImagePolicy, Policy
from visadapt.systems import CartPole, System

StatesToActions = Policy | Callable[[Tensor], Any]
"""A policy on states: a `Policy`, or a function from states (N, n_state) to actions (N, n_action)."""

COMMAND_POINTS = 41  # Commands from -1 to 1 at which a step is computed; between them it is interpolated linearly


def check(policy: StatesToActions, system: System) -> None:
    """Raise ValueError if `policy` is not one on the states of `system`."""
    n, n_action = len(system.states), len(system.actions)
    if n_action != 1:
        raise ValueError(f"diagnose: Theorem 1's terms need a system with one action; {system.name} has {n_action}")
    if not isinstance(system, CartPole):
        raise ValueError(f"diagnose: Theorem 1's terms are for a policy on a cartpole; the system is {system.name}")
    if isinstance(policy, ImagePolicy):
        raise ValueError("diagnose: the policy sees frames, and a diagnosis has states alone; give a policy on states")
    if isinstance(policy, Policy) and (policy.n_state, policy.n_action) != (n, n_action):
        raise ValueError(
            f"diagnose: the policy is made for {policy.n_state} states and {policy.n_action} actions; "
            f"{system.name} has {n} and {n_action}"
        )
    actions(policy, system, History.start(torch.zeros(2, n, dtype=torch.float64), n_action))


def actions(policy: StatesToActions, system: System, history: History) -> Tensor:
    """The policy's actions (B, n_action), limited to the system's range, after a history of states; float64."""
    if isinstance(policy, Policy):
        chosen = policy.act(history.to(next(policy.parameters())))
    else:
        chosen = torch.as_tensor(policy(history.observations[:, -1].to(torch.get_default_dtype())))
    batch, _, n_action = history.actions.shape
    if chosen.shape != (batch, n_action) or not bool(chosen.isfinite().all()):
        what = "values that are not finite" if chosen.shape == (batch, n_action) else f"the shape {tuple(chosen.shape)}"
        ranges = ", ".join(f"{each.name} from {each.low:g} to {each.high:g}" for each in system.actions)
        raise ValueError(
            f"for states ({batch}, {history.observations.shape[-1]}) the policy gave {what}; "
            f"actions ({batch}, {n_action}) are right: {ranges}"
        )
    return system.within_range(chosen.to(history.actions.device).double())


def policy_terms(policy: StatesToActions, system: System, rows: Segments, best: ScoredModel) -> PolicyTerms:
    """Theorem 1's terms with f_hat the source, and with f_hat the source with the best set of effects.

    The policy acts on the sensors' readings of the states, as it does on the machine.
    """
    corrected = CandidateModel(system, best.effects, rows)
    state, disturbance, variance = _estimated_steps(corrected, best)
    theta, applied = best.fits.theta[0], None
    if corrected.reads_commands:
        applied = corrected.applied(corrected.acting(theta[None])[0], slice(-1))
    histories, complete = _histories(corrected.at(theta).reading(state.flatten(0, 1), applied), rows)
    acted = actions(policy, system, histories).reshape(variance.shape)
    source, no_values = CandidateModel(system, (), rows), best.fits.theta[0, :0]
    before = _steps(source, no_values, state, acted, complete)
    after = _steps(corrected, theta, state, acted, complete)
    machine = after[0] + disturbance[complete], variance[complete]
    reference, acted = (1 - 1 / HORIZON) * state[complete], acted[complete]
    pairs = (_terms(*steps, *machine, acted, reference) for steps in (before, after))
    return PolicyTerms(*zip(*pairs, strict=True))


def _estimated_steps(model: CandidateModel, best: ScoredModel) -> tuple[Tensor, Tensor, Tensor]:
    """The machine's steps from every row but the last of W windows of T rows.

    The smoothed states (W, T - 1, n), the angle within [-pi, pi]; the smoothed change (W, T - 1, n) of the next state
    that the best set does not explain; the posterior variance (W, T - 1) of the next state due to the set's parameters,
    summed over the states.
    """
    fits = best.fits
    problem = linear_problem([model], fits)
    process, noise = variances(model, fits, problem)
    smoothed, adjoint = backward(forward(problem.data(), process, noise))
    disturbance = -(process @ adjoint[:, 1:, :, :1])[..., 0]
    by_parameter = problem.drive[..., 1:]
    covariance = torch.linalg.inv(posterior(best.effects, fits)[1])
    variance = ((by_parameter @ covariance) * by_parameter).sum((-1, -2))
    state = (fits.state[0] + smoothed[..., 0])[:, :-1]
    angle = model.system.index("theta")
    state[..., angle] = torch.atan2(state[..., angle].sin(), state[..., angle].cos())
    return state, disturbance, variance


def _histories(seen: Tensor, rows: Segments) -> tuple[History, Tensor]:
    """Histories of readings (W (T - 1), n) and actions before each row, and whether (W, T - 1) they are complete."""
    windows, length = rows.shape
    seen = seen.reshape(windows, length - 1, -1)
    padded = torch.cat((seen[:, :1].expand(-1, LENGTH - 1, -1), seen), 1)
    observations = padded.unfold(1, LENGTH, 1).mT
    # The episode's row of each of the LENGTH actions before a row.
    row = rows.first[:, None, None] + torch.arange(length - 1)[:, None] + torch.arange(-LENGTH, 0)
    given = rows.command[rows.episode[:, None, None], row.clamp(min=0)] * (row >= 0)[..., None]
    # A window that starts within an episode lacks the states before it.
    complete = (rows.first[:, None] == 0) | (torch.arange(length - 1) >= LENGTH - 1)
    return History(observations.flatten(0, 1), given.flatten(0, 1)), complete & (rows.inside[:, 1:] > 0)


def _steps(model: CandidateModel, theta: Tensor, state: Tensor, acted: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """A model's next states (N, n) under actions (W, T - 1), and (N, COMMAND_POINTS, n) under commands from -1 to 1.

    From the `chosen` (W, T - 1) of the states (W, T - 1, n), with parameters (P,).
    """
    tried = torch.cat((acted[..., None], _grid().expand(*acted.shape, -1)), -1)[chosen]
    count = 1 + COMMAND_POINTS
    row = chosen.flatten().nonzero()[:, 0].repeat_interleave(count)
    values = model.by_row(theta, state.shape[1]).expand(state[..., 0].numel(), -1)[row]
    start = model.started(theta, state)[row]
    stepped = model.at(values).step(start, tried.flatten()[:, None]).state.reshape(len(tried), count, -1)
    return stepped[:, 0], stepped[:, 1:]


def _terms(
    next_state: Tensor, nodes: Tensor, machine: Tensor, variance: Tensor, acted: Tensor, reference: Tensor
) -> tuple[float, float, float, float]:
    """delta, L, E|pi - pi_hat| and E[zeta] from a model's steps.

    The machine's next states (N, n) have the variance (N,); actions are (N,), references nu (N, n).
    """
    delta = ((next_state - machine).square().sum(-1) + variance).sqrt()
    width = 2 / (COMMAND_POINTS - 1)
    slopes = nodes.diff(dim=1) / width
    # The point of each linear piece nearest to the reference, then the nearest of all.
    away = reference[:, None] - nodes[:, :-1]
    along = (away * slopes).sum(-1) / slopes.square().sum(-1).clamp(min=1e-300)
    along = along.clamp(0, width)
    zeta, piece = (along[..., None] * slopes - away).norm(dim=-1).min(1)
    best = _grid()[piece] + along.gather(1, piece[:, None])[:, 0]
    gap = (acted - best).abs()
    return float(delta.mean()), float(slopes.norm(dim=-1).max()), float(gap.mean()), float(zeta.mean())


def _grid() -> Tensor:
    return torch.linspace(-1, 1, COMMAND_POINTS, dtype=torch.float64)

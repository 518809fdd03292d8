"""Nonlinear model predictive control with CasADi and IPOPT: the paper's MBMF (its A.3), with the residual of ours.

At each step, by multiple shooting over the horizon of 10, warm-started with the last plan,

    minimise   C(s_1..s_K, a_0..a_{K-1})                 of `COST`, the cost of all
    subject to s_{k+1} = f(s_k, a_k) + Delta(history_k)   and |a_k| <= 1

f is the source (Runge-Kutta, a step a period); Delta is the residual, on the past and the planned states and commands,
as an expression of its weights. The Hessian is Gauss-Newton's. Where IPOPT does not converge its last iterate is used.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.baselines.problem import COST, Problem, Sizes, Stage, grounded
from visadapt.effects import Residual
from visadapt.history import HORIZON, LENGTH, History
from visadapt.policies import Policy
from visadapt.policies.networks import ACCELERATION_UNIT, StateResidualNetwork
from visadapt.systems import CartPole
from visadapt.tasks.balance import RegulatorCost
from visadapt.world import World

OPTIONS = {
    "ipopt": {
        "print_level": 0,
        "sb": "yes",
        "max_iter": 50,
        "tol": 1e-4,
        "nlp_scaling_method": "none",
        "warm_start_init_point": "yes",
        "mu_init": 1e-5,
        "warm_start_bound_push": 1e-6,
        "warm_start_mult_bound_push": 1e-6,
    },
    "print_time": False,
    "error_on_fail": False,
    "calc_f": False,
    "calc_g": False,
    "calc_lam_p": False,
}
LOST = 0.6
"""rad, beyond which nothing is solved: the episode has ended at half of it"""


class ModelPredictive(Policy):
    """Plans by solving a `Program` at each step, for each episode of a batch by itself."""

    def __init__(self, program: Program, residual: Residual | None = None) -> None:
        super().__init__(4, 1)
        self.program = program
        self.weights = weights(residual)
        self.warm: list[dict[str, Any] | None] = []

    def act(self, history: History) -> Tensor:
        if len(self.warm) != len(history.actions):
            self.warm = [None] * len(history.actions)
        first = history.begins.tolist()
        past = torch.cat((history.observations.flatten(1), history.actions[:, 1:].flatten(1)), 1).double().numpy()
        commands = [self._solve(b, past[b], fresh) for b, fresh in enumerate(first)]
        return torch.tensor(commands, dtype=history.actions.dtype)[:, None]

    def _solve(self, b: int, past: np.ndarray, fresh: bool) -> float:
        now = past[4 * (LENGTH - 1) : 4 * LENGTH]
        if not np.isfinite(past).all() or abs(now[2]) > LOST:
            return 0.0
        warm = None if fresh else self.warm[b]
        if warm is None:
            warm = {"x0": np.concatenate((np.zeros(HORIZON), np.tile(now, HORIZON)))}
        found = self.program.solver(p=np.concatenate((past, self.weights)), **self.program.bounds, **warm)
        plan = np.array(found["x"]).ravel()
        if not np.isfinite(plan).all():
            self.warm[b] = None
            return 0.0
        self.warm[b] = {"x0": onward(plan), "lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}
        return float(np.clip(plan[0], -1, 1))


def onward(plan: np.ndarray) -> np.ndarray:
    """A plan (commands, then states) a step on, its last step repeated."""
    commands, states = plan[:HORIZON], plan[HORIZON:].reshape(HORIZON, -1)
    return np.concatenate((commands[1:], commands[-1:], states[1:].ravel(), states[-1]))


class Program:
    """The solver and its bounds.

    Its variables are commands, then states; its parameters the past states and commands, oldest first, then the
    residual's `weights`, so that a residual that has learnt more needs no other program.
    """

    def __init__(self, source: World, cost: RegulatorCost, residual: Residual | None = None) -> None:
        model = step(source, residual)
        commands, states = ca.MX.sym("a", HORIZON), ca.MX.sym("s", 4, HORIZON)
        past, learnt = ca.MX.sym("past", 4 * LENGTH + LENGTH - 1), ca.MX.sym("weights", len(weights(residual)))
        seen = [past[4 * k : 4 * (k + 1)] for k in range(LENGTH)]
        done = [past[4 * LENGTH + k] for k in range(LENGTH - 1)]
        total, gaps = 0, []
        for k in range(HORIZON):
            seen, done = [*seen[-LENGTH:], states[:, k]], [*done[1 - LENGTH :], commands[k]]
            gaps.append(model(ca.vertcat(*seen[:-1]), ca.vertcat(*done), learnt) - states[:, k])
            total += ca.dot(ca.DM(cost.state) * states[:, k], states[:, k]) + cost.action * commands[k] ** 2
        total += ca.dot(ca.DM(cost.to_go) @ states[:, -1], states[:, -1])
        variables, given, gap = ca.vertcat(commands, ca.vec(states)), ca.vertcat(past, learnt), ca.vertcat(*gaps)
        options = {**OPTIONS, "hess_lag": _curvature(cost, given, gap)}
        self.solver = ca.nlpsol("plan", "ipopt", {"x": variables, "p": given, "f": total, "g": gap}, options)
        low = np.concatenate((-np.ones(HORIZON), np.full(4 * HORIZON, -np.inf)))
        self.bounds = {"lbx": low, "ubx": -low, "lbg": 0, "ubg": 0}


def _curvature(cost: RegulatorCost, given: Any, gap: Any) -> Any:
    """The Hessian of the cost alone (Gauss-Newton): of the constraints' curvature little is left where they hold."""
    hessian = 2 * np.diag([cost.action] * HORIZON + list(cost.state) * HORIZON)
    hessian[-4:, -4:] += 2 * np.array(cost.to_go)
    symbols = [ca.MX.sym(name, size) for name, size in (("x", 5 * HORIZON), ("p", given.numel()), ("lam_f", 1))]
    symbols.append(ca.MX.sym("lam_g", gap.numel()))
    return ca.Function("curvature", symbols, [symbols[2] * ca.sparsify(ca.DM(np.triu(hessian)))])


def step(source: World, residual: Residual | None) -> Any:
    """The state after a period, of the last LENGTH states and commands, the present ones last, and `weights`."""
    system = source.system
    assert isinstance(system, CartPole)
    states, commands = ca.MX.sym("states", 4 * LENGTH), ca.MX.sym("commands", LENGTH)
    now, command, h = states[-4:], commands[-1], source.period
    k1 = derivative(system, now, command)
    k2 = derivative(system, now + h / 2 * k1, command)
    k3 = derivative(system, now + h / 2 * k2, command)
    k4 = derivative(system, now + h * k3, command)
    after = now + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    learnt = ca.MX.sym("weights", len(weights(residual)))
    if residual is not None:
        after += correction(system, residual, states, commands, learnt)
    return ca.Function("step", [states, commands, learnt], [after])


def derivative(system: Any, state: Any, command: Any) -> Any:
    """The equations of `CartPole.derivative` without loads."""
    velocity, angle, turning = state[1], state[2], state[3]
    mass, moment = system.cart_mass + system.pole_mass, system.pole_mass * system.pole_half_length
    sine, cosine = ca.sin(angle), ca.cos(angle)
    push = (system.max_force * command + moment * turning**2 * sine) / mass
    inertia = system.pole_half_length * (4 / 3 - system.pole_mass * cosine**2 / mass)
    spin = (system.gravity * sine - cosine * push) / inertia
    return ca.vertcat(velocity, push - moment * spin * cosine / mass, turning, spin)


def weights(residual: Residual | None) -> np.ndarray:
    """The residual's scale, weights (column after column) and biases, one after the other; nothing without one."""
    if residual is None:
        return np.zeros(0)
    each = [residual.scale, *(part.T if part.dim() == 2 else part for part in residual.network.parameters())]
    return torch.cat([part.detach().double().flatten() for part in each]).numpy()


def correction(system: CartPole, residual: Residual, states: Any, commands: Any, learnt: Any) -> Any:
    """What the residual adds: `StateResidualNetwork` as an expression of its `weights`."""
    network = residual.network
    assert isinstance(network, StateResidualNetwork)
    out = ca.vertcat(states[-4:], commands[-1])
    if network.system is not None:
        each, unexplained = [states[4 * k : 4 * (k + 1)] for k in range(LENGTH)], []
        for k in range(LENGTH - 1):
            ends = [derivative(system, each[end], commands[k]) for end in (k, k + 1)]
            missing = (each[k + 1] - each[k]) / network.period - (ends[0] + ends[1]) / 2
            unexplained += [missing[1] / ACCELERATION_UNIT, missing[3] / ACCELERATION_UNIT]
        out = ca.vertcat(states, commands, *unexplained)
    first = len(residual.scale)
    for layer in network.head if isinstance(network.head, nn.Sequential) else [network.head]:
        if not isinstance(layer, nn.Linear):
            out = ca.tanh(out)
            continue
        rows, columns = layer.weight.shape
        weight = ca.reshape(learnt[first : first + rows * columns], rows, columns)
        first += rows * columns
        out = weight @ out
        if layer.bias is not None:
            out += learnt[first : first + rows]
            first += rows
    return learnt[: len(residual.scale)] * out


def stages(problem: Problem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """On the source, then with the residual."""
    source = problem.setup(sizes).source
    bare = Program(source, COST)
    learning: list[Program] = []

    def planner(residual: Residual | None) -> Policy:
        if residual is None:
            return ModelPredictive(bare)
        if not learning:
            learning.append(Program(source, COST, residual))
        return ModelPredictive(learning[0], residual)

    yield from grounded(problem, sizes, seed, planner)

"""Nonlinear model predictive control with CasADi and IPOPT: the paper's MBMF (its A.3), with the residual of ours.

At each step, by multiple shooting over the horizon of 10, warm-started with the last plan,

    minimise   |e(s_1..s_K, a_0..a_{K-1})|^2             errors e, weighted as in the cost that all are set
    subject to s_{k+1} = f(s_k, a_k) + Delta(history_k)   and |a_k| <= 1

f is the source (Runge-Kutta, a step a period); Delta is the residual, on the past and the planned states and commands,
as an expression of its weights (`symbolic`). The Hessian is Gauss-Newton's. Where IPOPT does not converge its last
iterate is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from benchmarks.baselines.cartpole import COST
from benchmarks.baselines.problem import Problem, Sizes, Stage, grounded
from benchmarks.baselines.symbolic import step, weights
from visadapt.effects import Residual
from visadapt.history import HORIZON, LENGTH, History
from visadapt.policies import Policy
from visadapt.setups.base import Setup
from visadapt.systems import CartPole, FixedWing, Quadrotor, System
from visadapt.systems.rigid_body import POSITION, RATES, VELOCITY
from visadapt.tasks.follow import FollowCost
from visadapt.tasks.reach import Reach
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
"""rad of a cart-pole, beyond which nothing is solved: the episode has ended at half of it"""


class ModelPredictive(Policy):
    """Plans by solving a `Program` at each step, for each episode of a batch by itself."""

    def __init__(self, program: Program, residual: Residual | None = None) -> None:
        super().__init__(program.n_state, program.n_action)
        self.shown = "state and goal" if program.n_goal else "state"
        self.program = program
        self.weights = weights(residual)
        self.warm: list[dict[str, Any] | None] = []

    def act(self, history: History) -> Tensor:
        if len(self.warm) != len(history.actions):
            self.warm = [None] * len(history.actions)
        first = history.begins.tolist()
        shown, done = history.observations.double(), history.actions[:, 1:].double()
        past = torch.cat((shown[..., : self.n_state].flatten(1), done.flatten(1)), 1).numpy()
        goals = shown[:, -1, self.n_state :].numpy()
        commands = [self._solve(b, past[b], goals[b], fresh) for b, fresh in enumerate(first)]
        return torch.tensor(np.array(commands), dtype=history.actions.dtype)

    def _solve(self, b: int, past: np.ndarray, goal: np.ndarray, fresh: bool) -> np.ndarray:
        now = past[self.n_state * (LENGTH - 1) : self.n_state * LENGTH]
        if not np.isfinite(past).all() or (isinstance(self.program.system, CartPole) and abs(now[2]) > LOST):
            return np.zeros(self.n_action)
        warm = None if fresh else self.warm[b]
        if warm is None:
            warm = {"x0": np.concatenate((np.zeros(HORIZON * self.n_action), np.tile(now, HORIZON)))}
        given = np.concatenate((past, goal, self.weights))
        found = self.program.solver(p=given, **self.program.bounds, **warm)
        plan = np.array(found["x"]).ravel()
        if not np.isfinite(plan).all():
            self.warm[b] = None
            return np.zeros(self.n_action)
        self.warm[b] = {"x0": self._onward(plan), "lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}
        return np.clip(plan[: self.n_action], -1, 1)

    def _onward(self, plan: np.ndarray) -> np.ndarray:
        """A plan (commands, then states) a step on, its last step repeated."""
        commands = plan[: HORIZON * self.n_action].reshape(HORIZON, -1)
        states = plan[HORIZON * self.n_action :].reshape(HORIZON, -1)
        return np.concatenate([np.concatenate((each[1:], each[-1:])).ravel() for each in (commands, states)])


class GroundedPredictive(ModelPredictive):
    """Plans with the residual that another policy reads, as it is fitted round after round."""

    def __init__(self, program: Program, learner: Policy) -> None:
        super().__init__(program)
        self.learner = [learner]  # in a list, so that its weights are not of this policy

    def act(self, history: History) -> Tensor:
        self.weights = weights(self.learner[0].residual)
        return super().act(history)


class Program:
    """The solver and its bounds.

    Its variables are commands, then states; its parameters the past states and commands, oldest first, then what the
    policy is shown as its goal, then the residual's `weights`, so that a residual that has learnt more needs no other
    program.
    """

    def __init__(self, source: World, errors: Errors, n_goal: int = 0, residual: Residual | None = None) -> None:
        self.system = source.system
        n_state, n_action = len(self.system.states), len(self.system.actions)
        self.n_state, self.n_action, self.n_goal = n_state, n_action, n_goal
        model = step(source, residual)
        variables = ca.SX.sym("plan", (n_action + n_state) * HORIZON)
        commands = ca.reshape(variables[: n_action * HORIZON], n_action, HORIZON)
        states = ca.reshape(variables[n_action * HORIZON :], n_state, HORIZON)
        past = ca.SX.sym("past", n_state * LENGTH + n_action * (LENGTH - 1))
        goal, learnt = ca.SX.sym("goal", n_goal), ca.SX.sym("weights", len(weights(residual)))
        seen = ca.vertsplit(past[: n_state * LENGTH], n_state)
        done = ca.vertsplit(past[n_state * LENGTH :], n_action)
        now, gaps = seen[-1], []
        for k in range(HORIZON):
            done = [*done[1 - LENGTH :], commands[:, k]]
            gaps.append(model(ca.vertcat(*seen[-LENGTH:]), ca.vertcat(*done), learnt) - states[:, k])
            seen.append(states[:, k])
        error, gap, given = errors(states, commands, now, goal), ca.vertcat(*gaps), ca.vertcat(past, goal, learnt)
        problem = {"x": variables, "p": given, "f": ca.sumsqr(error), "g": gap}
        self.solver = ca.nlpsol("plan", "ipopt", problem, {**OPTIONS, "hess_lag": _curvature(problem, error)})
        low = np.concatenate((-np.ones(n_action * HORIZON), np.full(n_state * HORIZON, -np.inf)))
        self.bounds = {"lbx": low, "ubx": -low, "lbg": 0, "ubg": 0}


def _curvature(problem: dict[str, Any], error: Any) -> Any:
    """The Hessian of the cost alone (Gauss-Newton): of the constraints' curvature little is left where they hold."""
    slope = ca.jacobian(error, problem["x"])
    weight, ignored = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", problem["g"].numel())
    hessian = ca.triu(2 * weight * ca.mtimes(slope.T, slope))
    return ca.Function("curvature", [problem["x"], problem["p"], weight, ignored], [hessian])


Errors = Callable[[Any, Any, Any, Any], Any]
"""Of planned states (n_state, K) and commands (n_action, K), the present state and the goal: a column of weighted
errors, whose squares add up to the cost of the plan."""


def rest_errors(states: Any, commands: Any, now: Any, goal: Any) -> Any:
    """Of a cart-pole: `COST`, the distances from rest and what coming to rest costs after the last planned state."""
    to_go = np.linalg.cholesky(np.array(COST.to_go)).T
    weighted = ca.DM(np.sqrt(COST.state)) * states
    return ca.vertcat(ca.vec(weighted), COST.action**0.5 * ca.vec(commands), ca.mtimes(ca.DM(to_go), states[:, -1]))


def follow_errors(states: Any, commands: Any, now: Any, goal: Any) -> Any:
    """Of a quadrotor: `FollowCost` without its weight on turning, since how the reference turns is not shown."""
    cost = FollowCost()
    away = states[: VELOCITY.stop, :] - ca.reshape(goal, VELOCITY.stop, HORIZON)
    return ca.vertcat(
        cost.position**0.5 * ca.vec(away[POSITION, :]),
        cost.velocity**0.5 * ca.vec(away[VELOCITY, :]),
        cost.action**0.5 * ca.vec(commands),
    )


def reach_errors(states: Any, commands: Any, now: Any, goal: Any) -> Any:
    """Of a fixed wing: the cost of `Reach`, along and across the straight line from where it is to the point."""
    task = Reach()
    to = goal - now[POSITION]
    way = to / ca.fmax(ca.norm_2(to), 1e-3)
    steps = task.speed * task.period * ca.DM(range(1, HORIZON + 1)).T
    away = states[POSITION, :] - now[POSITION] - ca.mtimes(way, steps)
    along = ca.mtimes(way.T, away)
    return ca.vertcat(
        task.along**0.5 * ca.vec(along),
        task.across**0.5 * ca.vec(away - ca.mtimes(way, along)),
        task.rates**0.5 * ca.vec(states[RATES, :]),
        task.action**0.5 * ca.vec(commands),
    )


ERRORS: dict[type[System], tuple[Errors, int]] = {
    CartPole: (rest_errors, 0),
    Quadrotor: (follow_errors, 6 * HORIZON),
    FixedWing: (reach_errors, 3),
}
"""Of each system: the errors that its plans minimise, and how many numbers its goal has."""


def planned(source: World, program: Program | None = None, residual: Residual | None = None) -> ModelPredictive:
    """The planner of a source, with a residual or without; `program` is made where none is given."""
    if program is None:
        program = Program(source, *ERRORS[type(source.system)], residual)
    return ModelPredictive(program, residual)


def following(setup: Setup, learner: Policy) -> Policy:
    """The planner of a vehicle's setup, with the residual that `learner` reads."""
    source = setup.source
    return GroundedPredictive(Program(source, *ERRORS[type(source.system)], setup.residual(learner, source)), learner)


def stages(problem: Problem, sizes: Sizes, folder: Path, seed: int) -> Iterator[Stage]:
    """On the source, then with the residual."""
    source = problem.setup(sizes).source
    programs: dict[bool, Program] = {}

    def planner(residual: Residual | None) -> Policy:
        policy = planned(source, programs.get(residual is not None), residual)
        programs[residual is not None] = policy.program
        return policy

    yield from grounded(problem, sizes, seed, planner)

"""Theorem 1 of the paper, measured: both sides of its bound, term by term, and the Lipschitz constant L of Table 1.

    python -m benchmarks.theorem

    E|f*(s, pi) - nu|  <=  delta + L E|pi - best| + E[zeta]                                             (equation 8)
    delta = E|f(s, pi) - f*(s, pi)|,  best = argmin over a of |f(s, a) - nu|,  zeta = |f(s, best) - nu|

for the experiments of Table 1, before and after adaptation, over all steps of 100 episodes of the policy in the target,
those that it is scored on. f* is the target. f is the policy's own model: the source before adaptation, the source and
its residual after it. nu is what the state should be one period on:

    CartPole    at rest: x_dot, theta and theta_dot 0; x has no reference (A.1.3)
    quadrotor   the reference's next position and velocity
    fixed wing  position and velocity one period on along the straight line to the point, at 11.5 m/s (A.1.2), until the
                point is passed

Norms are Euclidean over these components in SI units, unweighted, so m, m/s, rad and rad/s are added up; of commands,
over commands in [-1, 1]. L depends on both. It is the largest singular value of df/da in float64; its supremum is
looked for at `POINTS` points of the way from pi to best, at every step. `best` is the optimum in the box of commands,
and where several are equally good one near pi. Where equation 5 asks that zeta bounds |f(s, a) - nu| for every a, which
no least error does, zeta is taken at `best`, which is all that the proof uses.

Adaptations are those of benchmarks.cartpole_states and benchmarks.flight: read where they are kept, else made there.
Writes results/theorem.csv, a row for each policy. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import torch
import tyro
from torch import Tensor

from benchmarks.cartpole_states import CONSTANT, FORCE, PLANS, Settings as CartPoleSettings, opened
from benchmarks.flight import Settings as FlightSettings
from datasets import quadrotor_references
from experiments.flights import EXPERIMENTS, flight_target
from experiments.result_tables import write_csv
from visadapt.evaluation import SCORE_SEED
from visadapt.learning.transitions import Transitions
from visadapt.policies import Policy
from visadapt.setups.base import Setup
from visadapt.storage.run_folder import once
from visadapt.systems.rigid_body import POSITION
from visadapt.targets import FlightTarget, SyntheticTarget, Target, constant_force
from visadapt.targets.rollout import run
from visadapt.tasks.base import Task
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.weights import shipped

FLIGHTS = ("quadrotor, drag", "fixed wing, drag")
EPISODES = 100
POINTS = 5
"""at which L is looked for between two actions, both ends among them"""
ITERATIONS = 100
"""of `best_action` at most; nearly all rows need less than ten"""
NEAR = 1e-7
"""how far a projected gradient step may still move a command at the optimum"""

Step = Callable[[Tensor], Tensor]
"""Actions (N, m) to what comes of them (N, n), row by row."""


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    cartpole: Path = Path("runs/cartpole_states")
    """where benchmarks.cartpole_states keeps its adaptations"""
    flight: Path = Path("runs/flight")
    """where benchmarks.flight keeps its own"""
    out: Path = Path("results/theorem.csv")


@dataclass(frozen=True)
class Terms:
    """Theorem 1 along a policy's runs. L is per unit of command, in the norm of nu."""

    steps: int
    left: float
    """E|f*(s, pi) - nu|"""
    delta: float
    lipschitz_median: float
    """L, over the observed states at the policy's own actions"""
    lipschitz_max: float
    """L, the largest of these"""
    lipschitz_between: float
    """L, the largest between the policy's action and the best one: the one in `right`"""
    action_distance: float
    """E|pi - best|"""
    zeta: float
    right: float
    """delta + L E|pi - best| + zeta"""
    holds: bool
    """left <= right"""
    ratio: float
    """right / left"""
    steps_that_hold: float
    """share of the steps at which the bound holds without E, to 1e-6, with the L between that step's own two actions"""
    control: float
    """E|f(s, pi) - nu|; delta + control is the bound of equation 3, in which there is no L"""
    rate_lipschitz_median: float
    """1/s; L of the whole state's rate of change in the source, over the observed states"""
    rate_lipschitz_max: float


@dataclass(frozen=True)
class Row:
    """The `Terms` of one policy."""

    experiment: str
    system: str
    samples: int
    """of the target, that it was adapted with"""
    seed: int
    terms: Terms

    def cells(self) -> dict[str, str]:
        """By column of the table."""
        about = asdict(self)
        values = about | about.pop("terms")
        return {key: f"{value:.6g}" if isinstance(value, float) else str(value) for key, value in values.items()}


def main(settings: Settings) -> None:
    """Adapt and measure what is not yet, and write the table."""
    torch.set_num_threads(1)
    rows = []
    for row in _rows(settings):
        rows.append(row.cells())
        own = row.terms
        print(
            f"{row.experiment:34} {row.samples:5} samples, seed {row.seed}: {own.left:.4f} <= {own.delta:.4f} + "
            f"{own.lipschitz_between:.4f} * {own.action_distance:.4f} + {own.zeta:.4f} = {own.right:.4f}",
            flush=True,
        )
    write_csv(settings.out, list(rows[0]), rows)


def _rows(settings: Settings) -> Iterator[Row]:
    """Seed by seed; the vehicles' policies of the source are the same for all seeds."""
    target = SyntheticTarget(constant_force(FORCE))
    ((budget, round_samples, _),) = PLANS[CONSTANT]
    for seed in range(settings.seeds):
        setup, folder = opened(CartPoleSettings(work=settings.cartpole), CONSTANT, seed)
        measure = partial(_row, setup, target, folder, CONSTANT, seed)
        policy = setup.pretrain(folder / "policy.safetensors", seed)
        yield measure(policy, 0)
        setup.adapt(policy, target, folder / f"budget-{budget}", budget, round_samples, seed)
        yield measure(policy, budget)
        for name in FLIGHTS:
            experiment = EXPERIMENTS[name]
            setup = experiment.setup(quadrotor_references.ready)
            folder = experiment.open(setup, settings.flight, seed, FlightSettings.flights)
            hidden = flight_target(setup, experiment.effects(setup))
            measure = partial(_row, setup, hidden, folder, name, seed)
            policy = setup.load(shipped(experiment.vehicle.name))
            if seed == 0:
                yield measure(policy, 0)
            experiment.adapt(setup, settings.flight, policy, seed)
            yield measure(policy, experiment.budget)


def _row(setup: Setup, target: Target, folder: Path, experiment: str, seed: int, policy: Policy, samples: int) -> Row:
    """The row of a policy, measured unless it is kept in `folder`."""
    terms = once(folder / f"theorem-{samples}.json", lambda: asdict(measured(setup, policy, target)))
    return Row(experiment, setup.source.system.name, samples, seed, Terms(**terms))


def measured(setup: Setup, policy: Policy, target: Target, episodes: int = EPISODES) -> Terms:
    """Both sides of Theorem 1 over the steps of a policy's episodes in the target."""
    task, source = setup.test or setup.settings.tuning.task, setup.source
    steps = (target.task if isinstance(target, FlightTarget) else task).episode_steps(source.period)
    drawn = torch.Generator().manual_seed(SCORE_SEED)
    runs = run(target, policy.eval(), episodes, steps, drawn, strict=False)
    transitions = to_come(task, Transitions.cut([each.episode for each in runs]))
    nu, columns = reference(task, transitions)
    residual = [] if policy.residual is None else [copy.deepcopy(policy.residual).double()]
    model = source.with_effects([*source.effects, *residual]).requires_grad_(False)
    at = transitions.start(model).map(Tensor.double)
    history = transitions.history(torch.arange(len(transitions))).map(Tensor.double)
    none = at.state.new_zeros(len(transitions), len(source.system.loads))

    def step(action: Tensor) -> Tensor:
        return model.step(at, action, history).state[:, columns]

    def rate(action: Tensor) -> Tensor:
        return source.system.derivative(at.state, action, none)

    own = transitions.action.double()
    best = best_action(step, nu, own)
    after, predicted = transitions.next_state.double()[:, columns], step(own)
    left, gap = (after - nu).norm(dim=1), (after - predicted).norm(dim=1)
    control, zeta = (predicted - nu).norm(dim=1), (step(best) - nu).norm(dim=1)
    apart, rates = (own - best).norm(dim=1), lipschitz(rate, own)
    shares = torch.linspace(0, 1, POINTS).tolist()
    along = torch.stack([lipschitz(step, torch.lerp(own, best, share)) for share in shares])
    here, between, largest = along[0], along.amax(0), float(along.max())
    right = float(gap.mean() + largest * apart.mean() + zeta.mean())
    # L may be a little larger between the points than at them.
    holding = left <= (gap + between * apart + zeta) * (1 + 1e-6)
    return Terms(
        steps=len(transitions),
        left=float(left.mean()),
        delta=float(gap.mean()),
        lipschitz_median=float(here.median()),
        lipschitz_max=float(here.max()),
        lipschitz_between=largest,
        action_distance=float(apart.mean()),
        zeta=float(zeta.mean()),
        right=right,
        holds=float(left.mean()) <= right,
        ratio=right / float(left.mean()),
        steps_that_hold=float(holding.double().mean()),
        control=float(control.mean()),
        rate_lipschitz_median=float(rates.median()),
        rate_lipschitz_max=float(rates.max()),
    )


def to_come(task: Task, transitions: Transitions) -> Transitions:
    """The steps that have a reference: those of a fixed wing end where it passes its point."""
    if not isinstance(task, Reach):
        return transitions
    ahead = transitions.state[:, 0] < transitions.task_states[transitions.rows[:, -1], 0]
    return replace(transitions, rows=transitions.rows[ahead])


def reference(task: Task, transitions: Transitions) -> tuple[Tensor, slice]:
    """nu (N, n) in float64, what each state should be one period on, and the columns of the state that it says."""
    state, task_state = transitions.state.double(), transitions.task_states[transitions.rows[:, -1]]
    if isinstance(task, Follow):
        return task.ahead(task_state.long())[:, 0].double(), slice(0, 6)
    if isinstance(task, Reach):
        to = task_state.double() - state[:, POSITION]
        velocity = task.speed * to / to.norm(dim=1, keepdim=True)
        return torch.cat((state[:, POSITION] + task.period * velocity, velocity), 1), slice(0, 6)
    return torch.zeros(len(state), 3, dtype=torch.float64), slice(1, 4)


def slopes(step: Step, action: Tensor) -> Tensor:
    """Derivatives (N, n, m) of a step by the actions (N, m)."""
    action = action.detach().requires_grad_()
    with torch.enable_grad():
        columns = step(action).unbind(1)
    rows = [torch.autograd.grad(each.sum(), action, retain_graph=True)[0] for each in columns]
    return torch.stack(rows, 1)


def lipschitz(step: Step, action: Tensor) -> Tensor:
    """The largest singular value (N,) of a step's derivative by the action."""
    return torch.linalg.matrix_norm(slopes(step, action), ord=2)


def best_action(step: Step, wanted: Tensor, start: Tensor) -> Tensor:
    """The actions (N, m) in [-1, 1] for which |step(a) - wanted| is least, searched from `start`, row by row.

    Projected Newton (Bertsekas 1982): commands at a limit that they are pushed against are held there, the others move
    by a damped Newton step, cut at the limits. A step that raises the error is not taken, and the damping grows, up to
    a short step down the gradient. A Gauss-Newton step would miss the curvature that decides where a command, such as
    an aileron's within one period, moves nothing to first order.

    Raises:
        ArithmeticError: rows that are not at an optimum after ITERATIONS.
    """

    def error(action: Tensor) -> Tensor:
        return (step(action) - wanted).square().sum(1) / 2

    def uphill(action: Tensor) -> Tensor:
        return torch.autograd.grad(error(action).sum(), action, create_graph=True)[0]

    action, damping = start.clone(), start.new_full((len(start),), 1e-6)
    eye = torch.eye(start.shape[1]).to(start)
    for _ in range(ITERATIONS):
        gradient, hessian = uphill(action.requires_grad_()).detach(), slopes(uphill, action)
        action = action.detach()
        size = torch.linalg.matrix_norm(hessian)[:, None]
        away = ((action - gradient / size).clamp(-1, 1) - action).abs().max()
        if away < NEAR:
            return action
        free = ~((action >= 1) & (gradient < 0) | (action <= -1) & (gradient > 0))
        matrix = hessian * free[:, None] * free[:, :, None]
        lowest = torch.linalg.eigvalsh(matrix)[:, :1].clamp(max=0)
        move = torch.linalg.solve(matrix + (damping[:, None] * size - 2 * lowest)[..., None] * eye, free * -gradient)
        tried = (action + move).clamp(-1, 1)
        better = error(tried) <= error(action) * (1 + 1e-14)
        action = torch.where(better[:, None], tried, action)
        damping = torch.where(better, damping / 10, damping * 10).clamp(1e-9, 1e6)
    raise ArithmeticError(f"no optimum after {ITERATIONS} iterations: a step of {float(away):.2g} is left")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

"""One call that films policies or runs of any target: cart-poles that balance or swing up, and vehicles."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from renderers import DrawnCartPole
from visadapt.films.cartpole_film import CartPoleFilm, CartPolePanel
from visadapt.films.film import Film, StrPath
from visadapt.films.flight_film import FlightFilm
from visadapt.films.flight_panel import FlightPanel
from visadapt.policies import Policy
from visadapt.progress import Progress
from visadapt.systems import CartPole, FixedWing, Quadrotor, RigidBody
from visadapt.targets import SyntheticTarget, Target, TaskTarget
from visadapt.targets.gymnasium import GymnasiumTarget
from visadapt.targets.rollout import Run, See, check_period, run, see_within_a_turn
from visadapt.tasks.follow import Follow


def film(
    shown: Policy | Run | Mapping[str, Policy | Run],
    target: Target,
    path: StrPath,
    *,
    seconds: float = 10.0,
    seed: int = 0,
    see: See | None = None,
    due: float = 5.0,
    progress: Progress | None = None,
) -> None:
    """Write an mp4 of policies that run on a target, or of runs that were made on it, side by side.

        film(policy, target, "film.mp4")
        film({"before": old_policy, "after": new_policy}, target, "film.mp4")

    A vehicle is shown in three dimensions with its course; a cart-pole in the target's own frames, or drawn from its
    states where the target is synthetic or shows none; as a swing-up where a synthetic target has no angle limit.

    Args:
        shown: a policy, a run, or several of them by the title of their panel. All policies start alike.
        target: what policies run on; its steps for the film are free and not counted. Runs must be of this target.
        path: of the mp4.
        seconds: length of the policies' episodes; a flight ends with its course.
        seed: of the starts, and of whatever else the target draws.
        see: what policies are shown of an observation; by default what `Policy.shown` names.
        due: s, the time by which a pole that swings up must be up.
        progress: called after each frame.

    Raises:
        ValueError: a system that is neither a cart-pole nor a vehicle, or states of neither, a run that does not fit
            the target, or a policy that was trained for another period.
        TargetError: the target shows no frames to a policy that sees frames.
        DiskFullError: the disk is full; a file that was at `path` before is unchanged.
        FilmError: ffmpeg failed for another reason; a file that was at `path` before is unchanged.

    >>> import pathlib, tempfile, visadapt as va
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "film.mp4"
    >>> va.film(va.load_policy(va.shipped("cartpole_states")), va.SyntheticTarget(), path, seconds=0.2)
    >>> path.exists()
    True
    """
    check_filmable(target)
    titled = shown if isinstance(shown, Mapping) else {target.name: shown}
    runs = {
        title: each if isinstance(each, Run) else _run(each, target, seconds, seed, see)
        for title, each in titled.items()
    }
    _film(runs, target, due).write(path, progress)


def check_filmable(target: Target) -> None:
    """Raises ValueError where the target is neither a cart-pole nor a vehicle."""
    kind = target.system_class
    if kind is not None and not issubclass(kind, CartPole | RigidBody):
        raise ValueError(f"a film is that of a cart-pole or of a vehicle; {target.name} is a {kind.name}")


def _run(policy: Policy, target: Target, seconds: float, seed: int, see: See | None) -> Run:
    check_period(policy, target)
    steps = round(seconds / target.period)
    if isinstance(target, TaskTarget):
        steps = min(steps, target.task.steps)
    swings_up = isinstance(target, SyntheticTarget) and math.isinf(target.angle_limit)
    if see is None and policy.shown == "state" and swings_up:
        see = see_within_a_turn
    generator = torch.Generator().manual_seed(seed)
    return run(target, policy.eval(), 1, steps, generator, strict=False, see=see)[0]


def _film(runs: Mapping[str, Run], target: Target, due: float) -> Film:
    if isinstance(target, TaskTarget):
        return FlightFilm([_flight_panel(title, each, target) for title, each in runs.items()])
    drawn = _drawn(target)
    limit, position_limit = target.angle_limit if isinstance(target, SyntheticTarget) else 0.3, None
    if isinstance(target, GymnasiumTarget):
        limit, position_limit = target.mapping.limits.get("theta", limit), target.mapping.limits.get("x")
    panels = []
    for title, each in runs.items():
        state = each.episode.state
        if state is None or state.shape[1] != len(CartPole.states):
            raise ValueError(f"panel {title!r}: a cart-pole's states (rows, 4) are needed to film {target.name}")
        pictures = None if isinstance(target, SyntheticTarget) else each.episode.frame
        farthest = math.inf if position_limit is None and each.episode.frame is None else position_limit
        panels.append(CartPolePanel(title, each, pictures, drawn, limit, farthest))
    return CartPoleFilm(panels, target.period, due)


def _drawn(target: Target) -> DrawnCartPole:
    """Sizes and view in which a cart-pole is drawn: its camera's, or with its system's pole where that is known."""
    if isinstance(target, SyntheticTarget) and target.camera is not None:
        return target.camera
    if isinstance(target.system, CartPole):
        return DrawnCartPole(pole_length=2 * float(target.system.pole_half_length))
    return DrawnCartPole()


def _flight_panel(title: str, flown: Run, target: TaskTarget) -> FlightPanel:
    if flown.episode.task_state is None:
        raise ValueError(f"panel {title!r}: the run does not hold its progress in the task of {target.name}")
    task_state = torch.as_tensor(flown.episode.task_state[0])
    # References are chosen by whole numbers, points are positions.
    task_state = task_state.long() if isinstance(target.task, Follow) else task_state
    vehicle = target.system
    if not isinstance(vehicle, RigidBody):  # one of unknown sizes is drawn in the usual ones
        vehicle = Quadrotor() if isinstance(target.task, Follow) else FixedWing()
    return FlightPanel(title, flown, vehicle, target.task, task_state)

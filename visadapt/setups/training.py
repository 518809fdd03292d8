"""Train a policy in a world, tune it there, or adapt it to a target: the right setup is found by system and policy."""

from __future__ import annotations

import copy
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import overload

import torch

from renderers import LayeredRenderer
from visadapt.learning.joint import Adapted
from visadapt.policies import ImagePolicy, Policy, RegulatorPolicy, StatePolicy
from visadapt.policies.base import check_policy
from visadapt.progress import Report
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import cartpole_frames, cartpole_states
from visadapt.setups.explained import steps_to_diagnose
from visadapt.setups.flight import fixed_wing, quadrotor
from visadapt.setups.policy_file import save_policy
from visadapt.setups.regulator import regulator
from visadapt.systems import CartPole, FixedWing, Quadrotor
from visadapt.targets import Target, TaskTarget
from visadapt.targets.base import periods_differ
from visadapt.tasks.follow import Follow
from visadapt.tasks.reach import Reach
from visadapt.tasks.references import Reference
from visadapt.tasks.regulate import Regulate
from visadapt.world import World

Renderer = LayeredRenderer | str | Path


def setup_for(
    world: World,
    policy: Policy | None = None,
    renderer: Renderer | None = None,
    references: Reference | None = None,
    with_history: bool = False,
    task: Regulate | None = None,
) -> Setup:
    """The setup of the world's system, for a given policy or a new one.

    Args:
        renderer: a cart-pole's states to frames, for a policy that is shown frames; without it, a new policy is shown
            states, and one that is shown frames takes the shipped renderer.
        references: (N, T, 3) or (T, 3), what a quadrotor is to follow.
        with_history: whether a cart-pole's policy, or a vehicle's residual, also reads the last periods, which show a
            changing force.
        task: where a system, of one's own say, is to come to rest; a policy that was trained for such a task keeps it.

    Raises:
        ValueError: a policy of another system, a system of one's own without a task, a quadrotor without references, or
            what the system or the policy has no use for.

    >>> import visadapt as va
    >>> setup = va.setup_for(va.World(va.CartPole()))
    >>> setup.settings.source.iterations
    3000
    """
    system = world.system
    if isinstance(policy, RegulatorPolicy):
        task = Regulate(system, **policy.task)
    if task is not None:
        if task.system.name != system.name:
            raise ValueError(f"the task is of a {task.system.name}, the world of a {system.name}")
        if renderer is not None or references is not None or with_history:
            raise ValueError("a policy with a task of its own has no use for a renderer, references or a history")
        return _checked(regulator(world, task), policy)
    if references is not None and not isinstance(system, Quadrotor):
        raise ValueError(f"references are for a quadrotor, not for a {system.name}: leave them out")
    if renderer is not None and not isinstance(system, CartPole):
        raise ValueError(f"a {system.name} is shown its states, for which a renderer has no use: leave it out")
    if isinstance(system, CartPole):
        if renderer is not None or isinstance(policy, ImagePolicy):
            if with_history:
                raise ValueError("a policy that is shown frames reads the last 5 in any case: leave the history out")
            setup = cartpole_frames(world, renderer)
        else:
            reads_history = policy.with_history if isinstance(policy, StatePolicy) else with_history
            if with_history and not reads_history:
                raise ValueError("the policy reads the last state alone: train one with a history, or leave it out")
            setup = cartpole_states(world, reads_history)
    elif isinstance(system, Quadrotor):
        if references is None:
            raise ValueError("a quadrotor follows references: give some, by references= or --references")
        setup = quadrotor(references, source=world, with_history=with_history)
    elif isinstance(system, FixedWing):
        setup = fixed_wing(world, with_history)
    elif policy is not None:
        raise ValueError(
            f"what a {type(policy).__name__} is to do with a {system.name} is not known: a policy that va.train made "
            "with a task keeps it; for one of your own, use the adapt of a va.Setup (docs/own_rig.md)"
        )
    else:
        raise ValueError(
            f"what a {system.name} is to do is not known: give a task, by task= or --task, that says where it is to "
            "come to rest"
        )
    return _checked(setup, policy)


def train(
    world: World,
    path: str | Path | None = None,
    seed: int = 0,
    iterations: int | None = None,
    renderer: Renderer | None = None,
    references: Reference | None = None,
    with_history: bool = False,
    task: Regulate | None = None,
    report: Report | None = None,
) -> Policy:
    """A policy trained in `world`, with the effects that it has, by backpropagation through it.

    Args:
        path: file of the policy: an interrupted training goes on, a finished one is read. Without it, the policy is
            not written.
        iterations: instead of the setup's own.
        renderer, references, with_history, task: as for `setup_for`; a vehicle has no residual yet that could read a
            history.

    Raises:
        ValueError: as `setup_for`.

    >>> import visadapt as va
    >>> policy = va.train(va.World(va.CartPole(), [va.effects.ViscousFriction(coefficient=2.0)]), iterations=2)
    >>> policy.n_action
    1
    """
    setup = setup_to_train(copy.deepcopy(world), iterations, renderer, references, with_history, task)
    with tempfile.TemporaryDirectory() as temporary:
        return setup.pretrain(Path(path or Path(temporary, "policy.safetensors")), seed, report)


@overload
def adapt(
    policy: Policy,
    source: World,
    target: None = None,
    *,
    seed: int = ...,
    iterations: int | None = ...,
    renderer: Renderer | None = ...,
    references: Reference | None = ...,
    report: Report | None = ...,
) -> Policy: ...
@overload
def adapt(
    policy: Policy,
    source: World,
    target: Target,
    samples: int = ...,
    folder: str | Path | None = ...,
    seed: int = ...,
    round_samples: int | None = ...,
    iterations: int | None = ...,
    renderer: Renderer | None = ...,
    references: Reference | None = ...,
    with_history: bool = ...,
    diagnose: bool = ...,
    report: Report | None = ...,
) -> Adapted: ...
def adapt(
    policy: Policy,
    source: World,
    target: Target | None = None,
    samples: int = 1000,
    folder: str | Path | None = None,
    seed: int = 0,
    round_samples: int | None = None,
    iterations: int | None = None,
    renderer: Renderer | None = None,
    references: Reference | None = None,
    with_history: bool = False,
    diagnose: bool = False,
    report: Report | None = None,
) -> Policy | Adapted:
    """Tune a copy of `policy` in the world `source`; or, with a target, adapt it by the paper's Algorithm 1.

    Without a target the policy is tuned in `source` with the effects that it has: those of a diagnosis, say. With one,
    the policy is run there for `samples` counted steps, round by round; a residual learns what `source` leaves out, the
    parameters of its effects are fitted, and the policy is tuned in the result. Tuning happens on the device of the
    policy's parameters; the target is given, and gives, tensors on the CPU.

    Args:
        samples: steps of the target in all; every one is counted.
        folder: where a run is kept, its policy as policy.safetensors; an interrupted run goes on from there. Without
            it nothing is kept, and `Adapted.restore` cannot be used.
        round_samples: steps in a round; a fifth of `samples` without it, and at least 20, or as many as can be
            diagnosed.
        iterations: of tuning (in each round), instead of the setup's own; the residual is fitted in as many at most.
        renderer, references, with_history: as for `setup_for`.
        diagnose: name the causes of the gap in each round and put them into `source`, which must have no effects; a
            residual then learns the gap only where they do not explain it.

    Returns:
        The tuned policy; with a target, the run: its `policy`, `ledger`, `rounds` and `episodes`, and the `source` with
        the effects that were found. Where the rounds show that tuned policies do much worse on the target than the one
        given, `policy` has the weights of that one, and `taken_back` says why.

    Raises:
        ValueError: a policy of another system, a target of another period or with other actions, effects that cannot
            be fitted, too few samples, other references than a target's own, with a history, or arguments that are for
            a target where there is none.
        TypeError: something else in the place of a policy or a world.
        TargetError: the target misbehaves.

    >>> import visadapt as va
    >>> source, target = va.World(va.CartPole()), va.SyntheticTarget(va.constant_force(2.0))
    >>> policy = va.load_policy(va.shipped("cartpole_states"))
    >>> tuned = va.adapt(policy, va.World(va.CartPole(), [va.effects.ViscousFriction(coefficient=2.0)]), iterations=2)
    >>> result = va.adapt(policy, source, target, samples=20, iterations=2)
    >>> result.ledger.used
    20
    """
    check_policy(policy)
    if not isinstance(source, World):
        raise TypeError(f"adapt: {type(source).__name__} is no World; World(system, period=...) is right")
    _check_iterations(iterations)
    if target is None and (folder is not None or round_samples is not None or with_history or diagnose):
        raise ValueError("folder, round_samples, with_history and diagnose are for a target, and none is given")
    setup = setup_to_adapt(policy, copy.deepcopy(source), target, renderer, references, with_history)
    if iterations is not None:
        own = setup.settings
        ground = replace(own.ground, steps=min(own.ground.steps, iterations))
        shorter = own.with_tuning(partial(replace, iterations=iterations))
        setup = replace(setup, settings=replace(shorter, ground=ground))
    policy = copy.deepcopy(policy)
    if target is None:
        setup.tune(policy, seed, report)
        return policy
    if round_samples is None:
        least = max(20, steps_to_diagnose(source)) if diagnose else 20
        round_samples = min(samples, max(least, samples // 5))
    with tempfile.TemporaryDirectory() as temporary:
        run_folder = Path(folder or temporary)
        adapted = setup.adapt(policy, target, run_folder, samples, round_samples, seed, report, diagnose=diagnose)
        if folder is not None:
            save_policy(run_folder / "policy.safetensors", policy)
    return adapted if folder is not None else replace(adapted, folder=None)


def setup_to_train(
    world: World,
    iterations: int | None,
    renderer: Renderer | None,
    references: Reference | None,
    with_history: bool,
    task: Regulate | None,
) -> Setup:
    """As `setup_for`, for a new policy, with `iterations` of its training instead of the setup's own.

    Raises:
        ValueError: as `setup_for`, or a history for a vehicle, whose policy reads none.
    """
    if with_history and task is None and not isinstance(world.system, CartPole):
        raise ValueError(f"a {world.system.name}'s policy reads no history; its residual may, where it is adapted")
    _check_iterations(iterations)
    setup = setup_for(world, None, renderer, references, with_history, task)
    return setup if iterations is None else replace(setup, settings=setup.settings.shortened(iterations))


def setup_to_adapt(
    policy: Policy,
    source: World,
    target: Target | None,
    renderer: Renderer | None = None,
    references: Reference | None = None,
    with_history: bool = False,
) -> Setup:
    """As `setup_for`, with the references, or the points, that a `TaskTarget` has.

    Raises:
        ValueError: as `setup_for`, other references than the target's own, with a history, or a world of another period
            than that which the policy was trained for.
    """
    task = target.task if isinstance(target, TaskTarget) else None
    if isinstance(task, Follow):
        own = task.references
        if references is None:
            references = own
        elif with_history and not torch.equal(references.as_many().positions, own.positions):
            raise ValueError("the target has references of its own, from which histories start: give no others")
    setup = setup_for(source, policy, renderer, references, with_history)
    trained = policy.trained_period
    if trained is not None and periods_differ(trained, source.period):
        raise ValueError(
            f"the policy was trained for {trained:g} s between commands, the world is stepped every "
            f"{source.period:g} s: World(..., period={trained:g}) is right"
        )
    if isinstance(task, Reach) and isinstance(source.system, FixedWing):
        return fixed_wing(source, with_history, replace(task, system=source.system))
    return setup


def _checked(setup: Setup, policy: Policy | None) -> Setup:
    """The setup, whose policy the given one must be."""
    if policy is not None:
        setup.check_policy(policy)
    return setup


def _check_iterations(iterations: int | None) -> None:
    if iterations is not None and iterations < 0:
        raise ValueError(f"{iterations} iterations; 0 or more are right")

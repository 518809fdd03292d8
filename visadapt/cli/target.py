"""A policy and the target that it is run on, as the command line names them, checked against each other."""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from collections.abc import Callable
from inspect import Parameter, signature
from numbers import Integral, Real
from typing import Any

import torch

from visadapt.cli.errors import InputError
from visadapt.cli.user_code import as_input_error, describe, find_factory, own_code
from visadapt.policies import Policy
from visadapt.policies.flight import FollowPolicy, ReachPolicy
from visadapt.setups.policy_file import load_policy, load_source
from visadapt.systems import System
from visadapt.systems.base import parameters
from visadapt.targets import FollowingTarget, ReachingTarget, Target, TaskTarget
from visadapt.targets.base import periods_differ
from visadapt.targets.env_map import EnvMap
from visadapt.targets.gymnasium import GymnasiumTarget
from visadapt.targets.rollout import SHOWN, checked_copy
from visadapt.tasks.references import read_reference
from visadapt.world import World


def load_policy_and_target(options: argparse.Namespace) -> tuple[Policy, World, Target]:
    """The policy, the world that it was trained in, and the target.

    Raises:
        InputError, TargetError: either cannot be had, or the two do not go together.
        CheckpointError: the policy's file is missing, torn, or holds something else.
    """
    policy, source = load_policy_and_source(options)
    target = load_target(options, source, policy.shown == "frame")
    references = read_reference(options.references, source.period) if getattr(options, "references", None) else None
    if references is not None and isinstance(policy, FollowPolicy) and not _has_goal(target):
        with as_input_error():
            target = FollowingTarget(target, references)
    if isinstance(policy, ReachPolicy) and not _has_goal(target):
        target = ReachingTarget(target)
    _check(options.policy, policy, source, target)
    return policy, source, target


def _has_goal(target: Target) -> bool:
    """Whether a target shows a goal of its own. A reset is no step: it is not counted."""
    if isinstance(target, TaskTarget):
        return True
    return getattr(target.reset(1, torch.Generator().manual_seed(0)), "goal", None) is not None


def load_policy_and_source(options: argparse.Namespace) -> tuple[Policy, World]:
    """The policy and the world that it was trained in.

    Raises:
        InputError: the policy is for another system than that of --system.
        CheckpointError: the policy's file is missing, torn, or holds something else.
    """
    policy, source = load_policy(options.policy), load_source(options.policy)
    if options.system and options.system.name != source.system.name:
        raise InputError(f"{options.policy}: a policy of a {source.system.name}; --system is a {options.system.name}")
    if options.system and (changed := _changed(source.system)):
        print(f"visadapt: {options.policy}: was made with {changed}; the policy's own are used", file=sys.stderr)
    return policy, source


def _changed(system: System) -> str:
    """The parameters of a system that differ from the defaults of its class, in words."""
    now = dict(parameters(type(system)()))
    return ", ".join(
        f"{name} {value:.6g} where {type(system).__name__} has {now[name]:.6g}"
        for name, value in parameters(system)
        if isinstance(value, Real) and isinstance(now[name], Real) and not math.isclose(value, now[name], rel_tol=1e-6)
    )


def load_target(options: argparse.Namespace, source: World, frames: bool) -> Target:
    """The target that --target and --map name; `frames`: whether a gymnasium environment has to draw."""
    mapping = EnvMap.load(options.map) if options.map else None
    name = env = options.target
    # gymnasium too has ids of the form module:Name-v0, whose last part is no name of Python's.
    if ":" in name and name.rpartition(":")[2].isidentifier():
        env = _from_factory(name, mapping)
        if isinstance(env, Target):
            return env
    if mapping is None:
        raise InputError(f"{name}: a gymnasium id needs --map MAP.toml; a target of your own is package.module:factory")
    with warnings.catch_warnings(action="ignore"):  # of an inherited period: said below
        target = GymnasiumTarget(env, mapping, type(source.system), frames=frames, name=name)
    if target.period_origin != "as given":
        print(f"visadapt: {name}: {target.period:g} s between actions, from {target.period_origin}", file=sys.stderr)
    if target.held > 1:
        step = target.period / target.held
        print(f"visadapt: {name}: each command is held for {target.held} of its steps of {step:g} s", file=sys.stderr)
    return target


def _from_factory(name: str, mapping: EnvMap | None) -> Target | Callable[[], Any]:
    """The target that the function `name` returns or, if that is a gymnasium environment, a function that makes these:
    first the one that was made here."""
    factory = find_factory(name)
    if needed := _arguments(factory):
        raise InputError(f"{name}: takes arguments ({', '.join(needed)}); a function without arguments is right")
    with own_code(lambda error: f"{name}: {describe(error)}"):
        made = factory()
    if isinstance(made, Target):
        if mapping is not None:
            raise InputError(f"{name}: returns a visadapt.Target, for which --map has no use: leave it out")
        _check_attributes(name, made)
        return made
    if not hasattr(made, "action_space") or not hasattr(made, "reset"):
        kind = type(made).__name__
        raise InputError(f"{name}: returned a {kind}; a visadapt.Target or a gymnasium environment is needed")
    if mapping is None:
        raise InputError(f"{name}: returned a gymnasium environment, which needs --map MAP.toml")
    ready = [made]
    return lambda: ready.pop() if ready else factory()


def _check_attributes(name: str, target: Target) -> None:
    """Raises InputError where a target of the user's lacks what a target has."""
    if not isinstance(said := getattr(target, "name", None), str):
        raise InputError(f"{name}: its target's name is {said!r}; a text, by which its runs are known, is right")
    for attribute, right in (("period", "the time between actions in s"), ("n_action", "the number of its commands")):
        value = getattr(target, attribute, None)
        if not isinstance(value, Real if attribute == "period" else Integral) or not 0 < float(value) < math.inf:
            raise InputError(f"{name}: its target's {attribute} is {value!r}; {right}, above 0, is right")


def _arguments(factory: Callable[..., Any]) -> list[str]:
    """The arguments that a function cannot do without."""
    try:
        takes = signature(factory).parameters.values()
    except ValueError:  # some functions of compiled modules do not say
        return []
    optional = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
    return [each.name for each in takes if each.default is Parameter.empty and each.kind not in optional]


def _check(path: str, policy: Policy, source: World, target: Target) -> None:
    """Raises InputError where the policy cannot be run on the target."""
    system = source.system
    if target.n_action != policy.n_action:
        raise InputError(
            f"{path}: a policy of a {system.name}, with {policy.n_action} commands; {target.name} takes "
            f"{target.n_action}: it is another system"
        )
    own = system if target.system is None else target.system
    if own.name != system.name:
        raise InputError(f"{path}: a policy of a {system.name}; {target.name} is a {own.name}")
    # Only what is observed says how large it is. A reset is no step: it is not counted.
    observed = checked_copy(target, target.reset(1, torch.Generator().manual_seed(0)), 1)
    shown = SHOWN[policy.shown](observed).shape[1:]
    if shown != (needed := policy.observation_shape):
        differ = f"{shown[0]} numbers of {policy.shown}; {path} was trained on {needed[0]}"
        if policy.shown == "frame":
            differ = f"frames of {shown[1]} x {shown[0]} px; {path} was trained on {needed[1]} x {needed[0]}"
        raise InputError(f"{target.name} shows {differ}")
    if periods_differ(target.period, source.period):
        raise InputError(
            f"{target.name} has {target.period:g} s between actions, {path} was trained for {source.period:g} s: "
            f"train with --period {target.period:g}, or give the target that period"
        )

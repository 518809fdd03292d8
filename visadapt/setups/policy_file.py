"""Policies on disk: the network, the arguments that made it and, once it is adapted, the residual that it reads.

A file names the class of its policy, the arguments of the constructor and, for a residual, the world in which it was
grounded, so a policy is loaded from the file alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from visadapt.effects import EFFECTS, Effect, Residual
from visadapt.effects.own import is_own, own_effects
from visadapt.learning.perception import PerceptionSettings, kinematics_units
from visadapt.policies import (
    FlightPolicy,
    FollowPolicy,
    ImagePolicy,
    Policy,
    ReachPolicy,
    RegulatorPolicy,
    RegulatorResidualNetwork,
    StatePolicy,
)
from visadapt.policies.networks import (
    FlightResidualNetwork,
    ImageResidualNetwork,
    ResidualNetwork,
    StateHistoryResidualNetwork,
    StateResidualNetwork,
)
from visadapt.storage.checkpoints import CheckpointError, check_sizes, fitting, load_tree, load_weights, save_network
from visadapt.systems import SYSTEMS, RigidBody, System
from visadapt.systems.base import NAMED, parameters
from visadapt.world import World

KINDS: dict[str, type[Policy]] = {
    kind.__name__: kind for kind in (ImagePolicy, StatePolicy, FollowPolicy, ReachPolicy, RegulatorPolicy)
}

OF_OTHERS = (".onnx", ".pt", ".pth", ".ts", ".zip", ".pkl")
"""Suffixes of policies of other libraries."""


def save_policy(path: str | Path, policy: Policy, about: Mapping[str, Any] | None = None) -> None:
    """Write a policy, and its residual if it has one, to a safetensors file; `about` is kept with it.

    Raises:
        DiskFullError: the disk is full; what stood at `path` before stays.
        TypeError: something else than a policy is to be written, as where the two arguments are exchanged.

    >>> import visadapt as va, tempfile, pathlib
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "policy.safetensors"
    >>> va.save_policy(path, va.load_policy(va.shipped("quadrotor")))
    >>> type(va.load_policy(path)).__name__
    'FollowPolicy'
    """
    if not isinstance(policy, Policy):
        raise TypeError(
            f"save_policy takes a path, then a policy of visadapt; it was given a {type(path).__name__}, then a "
            f"{type(policy).__name__}"
        )
    settings: dict[str, Any] = {"arguments": policy.arguments}
    settings |= {"grounded_in": policy.grounded_in, "source": policy.trained_in}
    if policy.residual is not None and isinstance(policy.residual.network, FlightResidualNetwork):
        settings["with_history"] = policy.residual.network.predict is not None
    save_network(Path(path), policy, {**settings, **(about or {})})


def load_policy(path: str | Path) -> Policy:
    """The policy in a file that `save_policy`, `train` or `adapt` wrote, with the residual that it reads.

    Raises:
        CheckpointError: the file is missing, torn, or holds something else.

    >>> import visadapt as va
    >>> policy = va.load_policy(va.shipped("cartpole_states"))
    >>> policy.n_state, policy.n_action, policy.shown
    (4, 1, 'state')
    """
    path = Path(path)
    if path.suffix.lower() in OF_OTHERS:
        raise CheckpointError(
            f"{path}: a network of another library, which no simulator was differentiated through; a policy that "
            "`visadapt train` makes for the system is right"
        )
    tree = _load(path)
    if tree["class"] not in KINDS:
        raise CheckpointError(
            f"{path}: holds a {tree['class']}, a policy ({', '.join(sorted(KINDS))}) is needed; a policy of a Setup of "
            "your own is read by the `load` of that setup"
        )
    with fitting(path):
        settings, weights = tree["settings"], tree["weights"]
        kind, arguments = KINDS[tree["class"]], settings["arguments"]
        with torch.device("meta"):  # without memory: a damaged file may ask for more than there is
            sizes = kind(**arguments).to(_dtype(weights)).state_dict()
        check_sizes(sizes, {key: value for key, value in weights.items() if not key.startswith("residual.")}, path)
        policy = kind(**arguments)
        residual = partial(residual_for, with_history=settings.get("with_history", False))
        return _restored(policy, tree, path, residual)


def load_into(path: Path, policy: Policy, residual: Callable[[Policy, World], Residual]) -> Policy:
    """Give `policy` what a file holds, and the residual in it, if there is one, made by `residual`.

    Raises:
        CheckpointError: the file is missing, torn, or holds another network.
    """
    tree = _load(path)
    if tree["class"] != type(policy).__name__:
        raise CheckpointError(f"{path}: holds a {tree['class']}, a {type(policy).__name__} is needed")
    with fitting(path):
        return _restored(policy, tree, path, residual)


def _restored(
    policy: Policy, tree: Mapping[str, Any], path: Path, residual: Callable[[Policy, World], Residual]
) -> Policy:
    """`policy` with the weights, the worlds and the residual of a file's `tree`."""
    policy.to(_dtype(tree["weights"]))
    policy.trained_in = tree["settings"].get("source")
    if (grounded_in := tree["settings"].get("grounded_in")) is not None:
        policy.grounded_in = grounded_in
        policy.residual = residual(policy, _world(grounded_in, path)).to(next(policy.parameters()))
    load_weights(policy, tree["weights"], path)
    return policy.eval()


def _dtype(weights: Mapping[str, Tensor]) -> torch.dtype:
    """The dtype of the first floating-point weight, which all weights of a policy share; float32 without any."""
    return next((weight.dtype for weight in weights.values() if weight.is_floating_point()), torch.float32)


def load_source(path: str | Path) -> World:
    """The world that the policy in a file was trained in, or last adapted from: its source.

    Raises:
        CheckpointError: as `load_policy`, or the file does not say.

    >>> import visadapt as va
    >>> source = va.load_source(va.shipped("quadrotor"))
    >>> source.system.name, source.period
    ('quadrotor', 0.1)
    """
    path = Path(path)
    settings = _load(path)["settings"]
    with fitting(path):
        description = settings.get("grounded_in") or settings.get("source")
        if description is None:
            raise CheckpointError(f"{path}: does not say in which world the policy was trained; train it again")
        return _world(description, path)


def _load(path: Path) -> dict[str, Any]:
    """The class, settings and weights in a policy's file; raises CheckpointError where one of them is missing."""
    tree = load_tree(path)
    keys = {"class", "settings", "weights"}
    if not isinstance(tree, dict) or not keys <= tree.keys() or not isinstance(tree["class"], str):
        raise CheckpointError(f"{path}: a checkpoint, but not of a policy")
    if not isinstance(tree["settings"], dict):
        raise CheckpointError(f"{path}: a checkpoint, but not of a policy: its settings are not a table")
    return tree


def describe(world: World) -> dict[str, Any]:
    """A world as plain values: its system's parameters, its clock, and its effects with their present values; an effect
    without a name by that of its class."""

    def values(effect: Effect) -> dict[str, Any]:
        name = getattr(effect, "name", type(effect).__name__)
        return {"effect": name, **{each.name: getattr(effect, each.name).detach().clone() for each in effect.table}}

    return {
        "system": world.system.name,
        "parameters": parameters_of(world.system),
        "period": world.period,
        "integrator": world.integrator,
        "substeps": world.substeps,
        "effects": [values(effect) for effect in world.modules() if isinstance(effect, Effect)],
    }


def parameters_of(system: System) -> dict[str, float]:
    """The parameters of a system, by their names."""
    return {name: float(value) for name, value in parameters(system)}


def _world(description: Mapping[str, Any], path: Path) -> World:
    """The world that `describe` described; raises CheckpointError where its system or an effect is not known."""

    def class_of(name: str, classes: Mapping[str, Any], option: str) -> Any:
        if not isinstance(name, str):
            raise CheckpointError(f"{path}: the name of a system or an effect is no text but a {type(name).__name__}")
        if name not in classes:
            line = f"{path}: needs {name!r}, which is not known here: import the file that defines it{option}"
            raise CheckpointError(line)
        return classes[name]

    kind = class_of(description["system"], {**NAMED, **SYSTEMS}, ", or name it by --system")
    if is_own(kind):
        own_effects(kind)  # which makes them known
    described = [dict(effect) for effect in description["effects"]]
    effects = [class_of(values.pop("effect"), EFFECTS, ", or name it by --effects")(**values) for values in described]
    clock = {name: description[name] for name in ("period", "integrator", "substeps")}
    return World(kind(**description["parameters"]), effects, **clock)


def residual_for(
    policy: Policy, source: World, with_history: bool = False, perception: PerceptionSettings | None = None
) -> Residual:
    """A new residual of `source`, whose correction is zero until it is fitted.

    Args:
        with_history: for flights: whether it also reads the accelerations that the source left unexplained over the
            last periods, which show a changing force. For frames and for states the policy determines it.
        perception: for frames: how the policy's encoder was trained; the default settings without it.

    Raises:
        TypeError: a policy of a class that has no residual here; make a `Setup` with one of your own.
    """
    system, period = source.system, source.period
    network: ResidualNetwork
    if isinstance(policy, ImagePolicy):
        encoder = policy.perception
        units = kinematics_units(perception or PerceptionSettings(), period)
        network = ImageResidualNetwork(encoder.background, float(encoder.contrast), system, period, units)
        network.to(encoder.background).encoder.load_state_dict(encoder.state_dict())
    elif isinstance(policy, RegulatorPolicy):
        network = RegulatorResidualNetwork(system, period, policy)
    elif isinstance(policy, StatePolicy) and policy.with_history:
        network = StateHistoryResidualNetwork(system, period)
    elif isinstance(policy, StatePolicy):
        network = StateResidualNetwork(policy.n_state, policy.n_action)
    elif isinstance(policy, FlightPolicy) and isinstance(system, RigidBody):
        network = FlightResidualNetwork(system, period, source.steps_along if with_history else None)
    else:
        raise TypeError(f"no residual is known for a {type(policy).__name__} of a {system.name}")
    return Residual(network, torch.ones(policy.n_state))

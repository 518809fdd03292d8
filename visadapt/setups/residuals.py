"""The residual that goes with a kind of policy: it reads what the policy is shown."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from visadapt.effects import Residual
from visadapt.learning.perception import PerceptionSettings, scale
from visadapt.policies import FlightPolicy, ImagePolicy, Policy, StatePolicy
from visadapt.policies.networks import (
    FlightResidualNetwork,
    ImageResidualNetwork,
    ResidualNetwork,
    StateResidualNetwork,
)
from visadapt.systems import RigidBody
from visadapt.world import World, WorldState


def residual_for(
    policy: Policy, source: World, with_history: bool = False, perception: PerceptionSettings | None = None
) -> Residual:
    """A new residual of `source` that begins at zero.

    Args:
        with_history: for flights: whether it also reads what the source left unexplained over the last periods, in
            which a force that changes shows. Policies on frames and on states say so themselves.
        perception: for frames: how the policy's encoder learnt to see; the default settings without it.

    Raises:
        TypeError: a policy of a class that is not known here; give a `Setup` of its own.
    """
    system, period = source.system, source.period
    network: ResidualNetwork
    if isinstance(policy, ImagePolicy):
        eyes = policy.perception
        unit = scale(perception or PerceptionSettings(), period)
        network = ImageResidualNetwork(eyes.background, float(eyes.contrast), system, period, unit)
        network.encoder.load_state_dict(eyes.state_dict())
    elif isinstance(policy, StatePolicy):
        network = StateResidualNetwork(
            policy.n_state,
            policy.n_action,
            system if policy.with_history else None,
            period if policy.with_history else 0.0,
        )
    elif isinstance(policy, FlightPolicy) and isinstance(system, RigidBody):
        network = FlightResidualNetwork(system, period, partial(source_steps, source) if with_history else None)
    else:
        raise TypeError(f"no residual is known for a {type(policy).__name__} of a {system.name}")
    return Residual(network, torch.ones(policy.n_state))


def source_steps(source: World, states: Tensor, actions: Tensor) -> Tensor:
    """The source's step from each of the states (B, T, n) that follow each other, under actions (B, T, n_action).

    Actuators remember the actions before; what was given earlier, and the time in the episode, a history does not hold.
    """
    memory = source.memories(states[:, 0], actions, states)
    before = tuple(each[:, :-1].flatten(0, 1) for each in memory)
    at = WorldState(states.new_zeros(states[..., 0].numel()), states.flatten(0, 1), before)
    return source.step(at, actions.flatten(0, 1)).state.unflatten(0, states.shape[:2])

"""The source and the residual as CasADi expressions, for planners that need derivatives of each by itself.

Everything here is tested against the torch code that it repeats: a step of `World` with the residual in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import nn

from visadapt.effects import Residual
from visadapt.history import LENGTH
from visadapt.policies.networks import (
    ACCELERATION_UNIT,
    HISTORY_ACCELERATION_UNIT,
    FlightResidualNetwork,
    ResidualNetwork,
    StateHistoryResidualNetwork,
    StateResidualNetwork,
)
from visadapt.systems import CartPole, FixedWing, Quadrotor, RigidBody, System
from visadapt.systems.rigid_body import ATTITUDE, RATES, VELOCITY
from visadapt.world import World


def step(source: World, residual: Residual | None) -> Any:
    """The state after a period, of the last LENGTH states and commands, the present ones last, and `weights`."""
    n_state, n_action = len(source.system.states), len(source.system.actions)
    states, commands = ca.SX.sym("states", n_state * LENGTH), ca.SX.sym("commands", n_action * LENGTH)
    learnt = ca.SX.sym("weights", len(weights(residual)))
    after = source_step(source, states[-n_state:], commands[-n_action:])
    if residual is not None:
        after += correction(residual, source, states, commands, learnt)
    return ca.Function("step", [states, commands, learnt], [after])


def source_step(source: World, state: Any, command: Any) -> Any:
    """The state a period later by Runge and Kutta's method of fourth order, in the source's substeps."""
    h = source.period / source.substeps
    for _ in range(source.substeps):
        k1 = derivative(source.system, state, command)
        k2 = derivative(source.system, state + h / 2 * k1, command)
        k3 = derivative(source.system, state + h / 2 * k2, command)
        k4 = derivative(source.system, state + h * k3, command)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state


def derivative(system: System, state: Any, command: Any) -> Any:
    """The equations of the system without loads."""
    return DERIVATIVES[type(system)](system, state, command)


def cartpole(system: Any, state: Any, command: Any) -> Any:
    """`CartPole.derivative`."""
    velocity, angle, turning = state[1], state[2], state[3]
    mass, moment = system.cart_mass + system.pole_mass, system.pole_mass * system.pole_half_length
    sine, cosine = ca.sin(angle), ca.cos(angle)
    push = (system.max_force * command + moment * turning**2 * sine) / mass
    inertia = system.pole_half_length * (4 / 3 - system.pole_mass * cosine**2 / mass)
    spin = (system.gravity * sine - cosine * push) / inertia
    return ca.vertcat(velocity, push - moment * spin * cosine / mass, turning, spin)


def quadrotor(system: Any, state: Any, command: Any) -> Any:
    """`RigidBody.derivative` with `Quadrotor.wrench`, of a vehicle without deviations: its rate loops are exact."""
    middle, half = (system.max_thrust + system.min_thrust) / 2, (system.max_thrust - system.min_thrust) / 2
    gain = ca.DM([system.roll_gain, system.roll_gain, system.yaw_gain])
    force = system.mass * ca.vertcat(0, 0, middle + half * command[0])
    return moving(system, state, force, gain * (system.max_rate * command[1:] - state[RATES]))


def fixed_wing(system: Any, state: Any, command: Any) -> Any:
    """`RigidBody.derivative` with `FixedWing.wrench`, in still air."""
    table, limit = (values.numpy() for values in system.coefficients(torch.empty(0, dtype=torch.float64)))
    velocity, rates = ca.mtimes(rotation(state[ATTITUDE]).T, state[VELOCITY]), state[RATES]
    speed, in_plane = ca.norm_2(velocity), ca.sqrt(velocity[0] ** 2 + velocity[2] ** 2)
    angles = ca.vertcat(ca.atan2(velocity[1], in_plane), ca.atan2(velocity[2], velocity[0]))
    angles = ca.fmin(ca.fmax(angles, -float(limit[0])), float(limit[0]))
    effects = speed * ca.mtimes(ca.DM(table), ca.vertcat(speed, speed * ca.vertcat(angles, command[1:]), rates))
    drag, side, lift = effects[0], effects[1], effects[2]
    forward, upward = velocity[0] / in_plane, velocity[2] / in_plane
    thrust = system.max_thrust * (command[0] + 1) / 2
    force = ca.vertcat(thrust - drag * forward - lift * upward, side, lift * forward - drag * upward)
    inertia = system.inertia(torch.empty(0, dtype=torch.float64)).numpy()
    torque = effects[3:] - ca.cross(rates, ca.mtimes(ca.DM(inertia), rates))
    return moving(system, state, force, ca.mtimes(ca.DM(np.linalg.inv(inertia)), torque))


def moving(system: RigidBody, state: Any, force: Any, spin: Any) -> Any:
    """The change of a rigid body's state, of a force in body axes and the change of its rates."""
    w, x, y, z = (state[ATTITUDE][k] for k in range(4))
    p, q, r = (state[RATES][k] for k in range(3))
    products = (-x * p - y * q - z * r, w * p + y * r - z * q, w * q - x * r + z * p, w * r + x * q - y * p)
    acceleration = ca.mtimes(rotation(state[ATTITUDE]), force) / system.mass - ca.vertcat(0, 0, system.gravity)
    return ca.vertcat(state[VELOCITY], acceleration, ca.vertcat(*products) / 2, spin)


def rotation(attitude: Any) -> Any:
    """The rotation matrix from body to world axes (`rigid_body.rotation`)."""
    w, x, y, z = (attitude[k] for k in range(4))
    rows = (
        (w**2 + x**2 - y**2 - z**2, 2 * (x * y - w * z), 2 * (w * y + x * z)),
        (2 * (x * y + w * z), w**2 - x**2 + y**2 - z**2, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w**2 - x**2 - y**2 + z**2),
    )
    return ca.vertcat(*(ca.horzcat(*row) for row in rows)) / ca.sumsqr(attitude)


DERIVATIVES: dict[type[System], Callable[[Any, Any, Any], Any]] = {
    CartPole: cartpole,
    Quadrotor: quadrotor,
    FixedWing: fixed_wing,
}


def weights(residual: Residual | None) -> np.ndarray:
    """The residual's scale, weights (column after column) and biases, one after the other; nothing without one."""
    if residual is None:
        return np.zeros(0)
    assert isinstance(residual.network, ResidualNetwork)
    parts = [residual.scale, *residual.network.head.parameters()]
    each = [part.T if part.dim() == 2 else part for part in parts]
    return torch.cat([part.detach().double().flatten() for part in each]).numpy()


def correction(residual: Residual, source: World, states: Any, commands: Any, learnt: Any) -> Any:
    """What the residual adds, as an expression of its `weights`."""
    network = residual.network
    assert isinstance(network, ResidualNetwork)
    out = read(network, source, states, commands)
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


def read(network: ResidualNetwork, source: World, states: Any, commands: Any) -> Any:
    """What a residual network reads of the last states and commands: its `embed`."""
    n_state, n_action = len(source.system.states), len(source.system.actions)
    each, done = ca.vertsplit(states, n_state), ca.vertsplit(commands, n_action)
    if isinstance(network, FlightResidualNetwork):
        turned = ca.vec(rotation(each[-1][ATTITUDE]).T)
        own = ca.vertcat(each[-1][VELOCITY], turned, each[-1][RATES], done[-1])
        return own if network.predict is None else ca.vertcat(own, *unexplained_changes(source, each, done))
    if isinstance(network, StateResidualNetwork):
        return ca.vertcat(each[-1], done[-1])
    assert isinstance(network, StateHistoryResidualNetwork)
    unexplained = []
    for k in range(LENGTH - 1):
        ends = [derivative(source.system, each[end], done[k]) for end in (k, k + 1)]
        missing = (each[k + 1] - each[k]) / network.period - (ends[0] + ends[1]) / 2
        unexplained += [missing[1] / ACCELERATION_UNIT, missing[3] / ACCELERATION_UNIT]
    return ca.vertcat(states, commands, *unexplained)


def unexplained_changes(source: World, states: Sequence[Any], commands: Sequence[Any]) -> list[Any]:
    """`FlightResidualNetwork.unexplained`; before a flight, where states repeat, that of its first period."""
    found: list[Any] = []
    for k in reversed(range(LENGTH - 1)):
        left = states[k + 1] - source_step(source, states[k], commands[k])
        moving = ca.vertcat(left[VELOCITY], left[RATES]) / (HISTORY_ACCELERATION_UNIT * source.period)
        known = ca.sumsqr(states[k + 1] - states[k]) > 0
        found.append(ca.if_else(known, moving, found[-1] if found else ca.SX.zeros(moving.numel())))
    return found[::-1]

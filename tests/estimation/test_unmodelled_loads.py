"""Loads that a model leaves out: against worlds in which they act."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.diagnosed import GAINS, record
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import ConstantForce, CoulombFriction, PoleMass
from visadapt.estimation.linearise import load_effect
from visadapt.estimation.segments import initial_states
from visadapt.estimation.unmodelled_loads import (
    leading_loads,
    load_response,
    noise_directions,
    response_without_friction,
)
from visadapt.recordings import Episode, Recording
from visadapt.systems import CartPole
from visadapt.world import World

NEWTONS = 4.0


def rows_of(*effects):
    measured = ("x", "x_dot", "theta", "theta_dot")
    return prepare(record(list(effects), 4, 120, measured=measured, noise=(0.0,) * 4), CartPole()).rows


def steps_of(rows):
    """Times, states, those that follow, commands (N, 1, 1) and durations of every row but the last of each window."""
    (time, duration), state = rows.clock, initial_states(rows, CartPole())
    now, following, command = state[:, :-1], state[:, 1:], rows.given[:, :-1]
    return time, now.flatten(0, 1), following.flatten(0, 1), command.flatten(0, 1)[:, None], duration


def test_the_response_to_loads_is_that_of_the_forces_that_they_are():
    rows = rows_of(ConstantForce(force=0.1))
    (time, now, _, command, _), response = steps_of(rows), load_response(rows, CartPole())
    forces = (0.0, 0.01)
    free, pushed = (
        World(CartPole(), [ConstantForce(force=force).double()]).integrate(time, now, command) for force in forces
    )
    torch.testing.assert_close(response[..., 0].flatten(0, 1), (pushed - free) / 0.01, atol=1e-6, rtol=1e-4)
    # Of noise, each load is as large as changes the velocity of its own coordinate by 1.
    own = noise_directions(rows, CartPole())[:, :, [1, 3]].diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(own.abs(), torch.ones_like(own))


@pytest.mark.parametrize("mass", [1.0, 0.08])
def test_the_load_that_acted_is_found_beside_dry_friction_also_where_the_cart_turns_round(mass):
    """Of a pole that is far lighter than the source's too, which loads move 12 times as much."""
    rows = rows_of(CoulombFriction(force=2.0), PoleMass(scale=mass), ConstantForce(force=NEWTONS))
    time, now, following, command, duration = steps_of(rows)
    turns, rests = now[:, 1] * following[:, 1] < 0, following[:, 1] == 0
    assert turns.sum() > 5
    assert rests.sum() > 5
    zeros = {parameter.name: 0.0 for parameter in load_effect(CartPole).table}
    placeholders = [CoulombFriction(force=0.0), PoleMass(scale=1.0), load_effect(CartPole)(**zeros)]
    values = torch.tensor([2.0, mass, 0.0, 0.0], dtype=torch.float64).expand(len(now), -1)
    world = World(CartPole(), placeholders, rows.period, "rk4", 20).with_values(values)
    response = response_without_friction(world, now, command[:, 0], duration)
    loads = leading_loads(world, values, time, now, following, command.expand(-1, 20, -1), duration, response)
    cart, pole = loads.unbind(-1)
    found = (cart - NEWTONS).abs() < 0.05
    assert found[now[:, 1] * following[:, 1] > 0].double().mean() > 0.99  # a cart may turn round twice
    assert found[turns].double().mean() > 0.6
    assert pole[~rests].abs().max() < 0.01
    # Of what holds a cart at rest no more is known than that it is no larger than friction and load together.
    assert (cart[rests].abs() < NEWTONS + 2.0).all()


@pytest.mark.parametrize("jumps", [False, True])
def test_a_machine_that_loads_disturb_is_told_from_one_whose_velocities_jump(jumps):
    """Forces on the cart move the pole too, by the mass matrix; jumps of both velocities are independent."""
    generator, pushed = torch.Generator().manual_seed(0), World(CartPole(), [ConstantForce(force=0.0)])
    still, states, commands = torch.zeros(4, 1, dtype=torch.float64), [torch.zeros(4, 4, dtype=torch.float64)], []
    for _ in range(100):
        drawn = torch.randn(4, 3, generator=generator, dtype=torch.float64)
        commands.append((states[-1] @ GAINS[:, None] + 0.1 * drawn[:, 2:]).clamp(-1, 1))
        world = pushed.with_values(still if jumps else 2 * drawn[:, :1])
        jump = torch.stack((still[:, 0], drawn[:, 0], still[:, 0], drawn[:, 1]), 1)
        states.append(world.step(world.start(states[-1]), commands[-1]).state + (0.1 * jump if jumps else 0))
    true = torch.stack(states[:-1], 1)[..., [0, 2]]
    seen = (true + 1e-4 * torch.randn(true.shape, generator=generator, dtype=torch.float64)).numpy()
    given, time = torch.stack(commands, 1).numpy(), 0.05 * np.arange(100)
    episodes = tuple(Episode(time, given[k], seen[k]) for k in range(4))
    rows = prepare(Recording(episodes, ("x", "theta"), 0.05, ("",) * 4), CartPole()).rows
    likelihoods = [Search(CartPole(), replace(rows, jumps=kind), []).source.log_odds for kind in (jumps, not jumps)]
    assert likelihoods[0] > likelihoods[1] + 50

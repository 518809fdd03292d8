"""Theorem 1 is measured with the best action and the slope that there are."""

import dataclasses

import numpy as np
import pytest
import torch

from benchmarks.theorem import best_action, lipschitz, measured, to_come
from experiments.flights import flight_target
from tests.flying import drag, seeded, small_quadrotor
from visadapt.learning.transitions import Transitions
from visadapt.recordings import Episode
from visadapt.setups.cartpole import cartpole_states
from visadapt.setups.flight import fixed_wing
from visadapt.setups.policy_file import residual_for
from visadapt.systems import CartPole, FixedWing, Quadrotor
from visadapt.targets import SyntheticTarget, constant_force
from visadapt.tasks.reach import Reach
from visadapt.weights import shipped
from visadapt.world import World


def step_of(system, count):
    """One period of a system from `count` random states in motion, under one or more actions for each; and what its
    position and velocity are wanted to be."""
    world = World(system, period=0.05)
    if isinstance(system, CartPole):
        state = 0.3 * torch.randn(count, 4, generator=seeded(), dtype=torch.float64)
        wanted = torch.zeros(count, 4, dtype=torch.float64)
        columns = slice(0, 4)
    else:
        level = FixedWing().trim(torch.tensor([11.5]))[0].double()
        state = level + 0.2 * torch.randn(count, 13, generator=seeded(), dtype=torch.float64)
        columns = slice(0, 6)
        wanted = state[:, columns] + 0.3 * torch.randn(count, 6, generator=seeded(1), dtype=torch.float64)

    def step(action):
        starts = state.repeat(len(action) // count, 1)
        return world.step(world.start(starts), action).state[:, columns]

    return step, wanted


@pytest.mark.parametrize(("system", "points"), [(CartPole(), 2001), (Quadrotor(), 7), (FixedWing(), 7)])
def test_no_action_on_a_grid_is_better_than_the_best_one(system, points):
    count, width = 4, len(system.actions)
    step, wanted = step_of(system, count)
    best = best_action(step, wanted, torch.zeros(count, width, dtype=torch.float64))
    assert best.abs().max() <= 1
    error = (step(best) - wanted).norm(dim=1)
    axis = torch.linspace(-1, 1, points, dtype=torch.float64)
    grid = torch.cartesian_prod(*[axis] * width).reshape(-1, 1, width).expand(-1, count, -1)
    on_grid = (step(grid.flatten(0, 1)).unflatten(0, (-1, count)) - wanted).norm(dim=2)
    assert (error <= on_grid.amin(0) + 1e-9).all()
    if width == 1:
        assert torch.allclose(best[:, 0], axis[on_grid.argmin(0)], atol=2 / (points - 1))


@pytest.mark.parametrize("system", [CartPole(), Quadrotor(), FixedWing()])
def test_l_is_the_largest_singular_value_of_differences(system):
    step, _ = step_of(system, 5)
    action = torch.rand(5, len(system.actions), generator=seeded(2), dtype=torch.float64) - 0.5
    eye = 1e-5 * torch.eye(action.shape[1], dtype=torch.float64)
    differences = torch.stack([(step(action + each) - step(action - each)) / 2e-5 for each in eye], 2)
    found = torch.linalg.svdvals(differences)[:, 0]
    assert torch.allclose(lipschitz(step, action), found, rtol=1e-6)


def flown(setup, rate):
    return flight_target(setup, drag(rate))


def short_wing():
    return dataclasses.replace(fixed_wing(), test=Reach(distance=10.0))


@pytest.mark.parametrize(
    ("name", "make"), [("cartpole_states", cartpole_states), ("quadrotor", small_quadrotor), ("fixed_wing", short_wing)]
)
def test_the_bound_holds_at_every_step_whatever_the_residual(name, make):
    setup = make()
    policy = setup.load(shipped(name))
    torch.manual_seed(0)
    policy.residual = residual_for(policy, setup.source)
    for weight in policy.residual.parameters():
        torch.nn.init.normal_(weight, std=0.01)
    target = SyntheticTarget(constant_force(3.3)) if name == "cartpole_states" else flown(setup, 0.3)
    found = measured(setup, policy, target, episodes=2)
    assert found.holds
    assert found.steps_that_hold == 1.0
    assert found.left <= found.delta + found.control <= found.right
    assert found.zeta <= found.control
    assert 0 < found.lipschitz_median <= found.lipschitz_max <= found.lipschitz_between


def test_without_a_gap_delta_is_nothing_and_l_the_papers():
    setup = small_quadrotor()
    policy = setup.load(shipped("quadrotor"))
    without, with_drag = (measured(setup, policy, flown(setup, rate), episodes=2) for rate in (0.0, 0.3))
    assert without.delta < 1e-3 < 1e-2 < with_drag.delta
    assert without.rate_lipschitz_max == pytest.approx(8.3)  # 16.6 1/s, the gain of the rate loop, times 0.5 rad/s


def test_a_wing_that_has_passed_its_point_has_no_reference():
    state = torch.zeros(5, 13, dtype=torch.float64)
    state[:, 0] = torch.tensor([48.0, 49.0, 50.0, 51.0, 52.0])
    point = torch.tensor([[50.0, 1.0, 2.0]]).expand(5, 3)
    episode = Episode(0.05 * np.arange(5), np.zeros((5, 4)), state.numpy(), None, point.numpy())
    kept = to_come(Reach(), Transitions.cut([episode]))
    assert kept.state[:, 0].tolist() == [48.0, 49.0]

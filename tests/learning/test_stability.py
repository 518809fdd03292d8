"""A learnt world in which the policy does not hold the cart-pole is told from one in which it does, and learnt anew."""

import math
from dataclasses import replace
from itertools import repeat

import numpy as np
import pytest
import torch
from torch import nn

from visadapt.effects import Residual
from visadapt.learning import stability
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.rounds import out_of_range
from visadapt.learning.stability import early_cost, improved, plan_costs, stable
from visadapt.learning.transitions import Transitions
from visadapt.learning.tuning import DivergedError
from visadapt.policies.networks import ResidualNetwork
from visadapt.setups.cartpole import cartpole_states
from visadapt.storage.checkpoints import load_tree
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget
from visadapt.targets.rollout import run
from visadapt.targets.synthetic import constant_force
from visadapt.weights import shipped
from visadapt.world import World


class LinearInHistory(ResidualNetwork):
    """A linear residual that reads the last 5 states and actions."""

    def __init__(self):
        super().__init__(nn.Linear(25, 4, bias=False))

    def embed(self, history):
        return torch.cat((history.observations.flatten(1), history.actions.flatten(1)), 1)


class MlpOfHistory(LinearInHistory):
    def __init__(self):
        super().__init__()
        self.head = nn.Sequential(nn.Linear(25, 8), nn.Tanh(), nn.Linear(8, 4))


def setup(network=LinearInHistory, **ground):
    """The cart-pole from states with such a residual, in Euler's steps; one short iteration of tuning."""
    made = cartpole_states(World(CartPole(), integrator="euler"))
    tuning = replace(made.settings.tuning, iterations=1, batch=16)
    settings = replace(made.settings, tuning=tuning, ground=GroundSettings(steps=20, **ground))
    return replace(made, settings=settings, residual=lambda *_: Residual(network(), torch.ones(4)))


def policy():
    return cartpole_states().load(shipped("cartpole_states"))


class TestStable:
    @pytest.mark.parametrize(
        ("feedback", "expected"), [(0.0, True), (0.2, True), (3.0, False), (float("nan"), False), (1e20, False)]
    )
    def test_it_is_not_where_the_residual_drives_the_cart_by_its_own_speed(self, feedback, expected):
        network = LinearInHistory()
        with torch.no_grad():
            next(network.head.parameters())[1, 17] = feedback  # x_dot of the last state
        residual = Residual(network, torch.full((4,), 0.1))
        rolled = run(SyntheticTarget(constant_force(1.0)), policy(), 1, 60, torch.Generator().manual_seed(0))
        transitions = Transitions.cut([rolled[0].episode])
        made = setup()
        world = made.source.with_effects([residual])
        about = made.settings.tuning, torch.Generator().manual_seed(0), transitions
        assert stable(plan_costs(policy(), world, None, *about)) == expected


class TestRidge:
    """A linear residual is fitted to 12 samples with 25 inputs."""

    def learnt(self, folder, network=LinearInHistory, **ground):
        torch.manual_seed(0)
        setup(network, **ground).adapt(policy(), SyntheticTarget(constant_force(2.0)), folder, 12, 12, 0)
        return load_tree(folder / "round-01" / "residual.safetensors")["weights"]

    def equal(self, one, other):
        return all(torch.equal(one[key], other[key]) for key in one)

    def test_that_which_predicts_best_is_kept_where_the_world_is_stable(self, tmp_path):
        kept = self.learnt(tmp_path / "a", ridges=(0.1, 1.0))
        assert self.equal(kept, self.learnt(tmp_path / "b", ridges=(0.1,)))
        assert not self.equal(kept, self.learnt(tmp_path / "c", ridges=(1.0,)))

    def test_a_larger_one_is_taken_where_the_world_is_unstable(self, tmp_path, monkeypatch):
        monkeypatch.setattr(stability, "MAX_GROWTH", 0.0)  # so that every world is
        kept = self.learnt(tmp_path / "a", ridges=(0.1, 1.0))
        assert self.equal(kept, self.learnt(tmp_path / "b", ridges=(1.0,)))

    def test_it_does_not_matter_where_the_head_is_not_linear(self, tmp_path):
        kept = self.learnt(tmp_path / "a", MlpOfHistory, ridges=(1.0, 10.0))
        assert self.equal(kept, self.learnt(tmp_path / "b", MlpOfHistory))


class TestTuning:
    """A policy that tuning makes far worse, in the world where it was tuned, keeps its weights."""

    def tuned(self, cost, before=10.0, broken=False):
        made, losses = nn.Linear(1, 1), [3.0, 2.0]
        first = made.weight.detach().clone()

        def tune():
            made.weight.data += 1
            if broken:
                raise DivergedError("the policy's loss is nan at iteration 5")
            return losses

        def costs():
            return repeat(before if torch.equal(made.weight, first) else cost)

        kept = improved(made, early_cost(costs()), costs, tune)  # type: ignore[arg-type]
        assert kept == ([] if torch.equal(made.weight, first) else losses)
        return bool(kept)

    def test_one_that_is_better_or_nearly_as_good_is_taken(self):
        assert self.tuned(1.0)
        assert self.tuned(10.2)

    @pytest.mark.parametrize("cost", [30.0, math.inf, math.nan])
    def test_one_that_is_far_worse_is_not(self, cost):
        assert not self.tuned(cost)

    def test_where_it_diverges_the_weights_from_before_are_kept_if_they_are_any_better(self):
        assert not self.tuned(1.0, broken=True)
        with pytest.raises(DivergedError):
            self.tuned(1.0, before=math.nan, broken=True)


def test_a_state_far_out_of_its_range_is_named_where_the_loss_is_no_number():
    hint = out_of_range([np.array([[0.0, 0.0, 9.0, 1.0]]), np.array([[0.1, 0.0, -57.3, 1.0]])], CartPole())
    assert hint == "; theta of the target reaches 57.3, of a range up to 0.3 rad: is it in another unit?"
    assert out_of_range([np.array([[0.0, 0.0, 0.1, 1.0]])], CartPole()) == out_of_range([], CartPole()) == ""

"""A learnt world in which the policy does not hold the cart-pole is told from one in which it does, and learnt anew."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from visadapt.effects import Residual
from visadapt.learning import stability
from visadapt.learning.grounding import GroundSettings
from visadapt.learning.stability import plan_costs, stable
from visadapt.learning.transitions import Transitions
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

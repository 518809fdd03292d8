"""The pieces of the job on InvertedPendulum-v5 that need no MuJoCo."""

import pytest
import torch

from renderers import LayeredRenderer
from train.inverted_pendulum import ANGLE_LIMIT, GUESS, SeenSource, _gap
from visadapt.effects import ViscousFriction
from visadapt.recordings import Episode
from visadapt.setups.cartpole import cartpole_frames
from visadapt.targets.inverted_pendulum import SOURCE
from visadapt.world import World


def episode(world, steps=60, seed=0):
    generator = torch.Generator().manual_seed(seed)
    at = world.start(torch.tensor([[0.1, 0.2, 0.02, -0.1]]))
    states, actions = [at.state[0]], []
    for _ in range(steps):
        # Upright needs a push after every lean.
        action = (at.state @ torch.tensor([0.9, 1.0, 8.0, 1.7]))[:, None] + 0.1 * torch.randn(1, 1, generator=generator)
        at = world.step(at, action)
        states.append(at.state[0])
        actions.append(action[0].clamp(-1, 1))
    rows = torch.stack([*actions, torch.zeros(1)])
    return Episode(0.04 * torch.arange(steps + 1).double().numpy(), rows.numpy(), torch.stack(states).numpy())


@torch.no_grad()
def test_the_gap_is_put_down_to_the_friction_that_made_it():
    source = World(SOURCE, period=0.04)
    rough = World(SOURCE, (ViscousFriction(coefficient=2.0),), 0.04, "midpoint", 40)
    found = _gap(source, [episode(rough), episode(rough, seed=1)])
    assert found["viscous_friction"] == pytest.approx(2.0, rel=0.05)
    assert found["pole_damping"] == pytest.approx(0.0, abs=0.05)
    assert found["explained"] > 0.95


def test_the_source_is_seen_through_the_renderer_and_ends_where_the_environment_would():
    target = SeenSource(cartpole_frames(World(SOURCE, period=0.04), LayeredRenderer(100, 120, *GUESS)))
    seen = target.reset(3, torch.Generator().manual_seed(0))
    assert seen.frame.shape == (3, 100, 120)
    assert seen.frame.dtype == torch.uint8
    while seen.alive.any():
        seen = target.step(torch.ones(3, 1))
    assert (seen.state[:, 2].abs() > ANGLE_LIMIT).all()

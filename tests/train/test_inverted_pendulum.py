"""The pieces of the job on InvertedPendulum-v5 that need no MuJoCo."""

import torch

from renderers import LayeredRenderer
from train.inverted_pendulum import ANGLE_LIMIT, GUESS, SeenSource
from visadapt.setups.cartpole import cartpole_frames
from visadapt.targets.inverted_pendulum import SOURCE
from visadapt.world import World


def test_the_source_is_seen_through_the_renderer_and_ends_where_the_environment_would():
    target = SeenSource(cartpole_frames(World(SOURCE, period=0.04), LayeredRenderer(100, 120, *GUESS)))
    seen = target.reset(3, torch.Generator().manual_seed(0))
    assert seen.frame.shape == (3, 100, 120)
    assert seen.frame.dtype == torch.uint8
    while seen.alive.any():
        seen = target.step(torch.ones(3, 1))
    assert (seen.state[:, 2].abs() > ANGLE_LIMIT).all()

"""The paper's CartPole from frames (its Table 2), as the baselines are set it.

All that they learn and plan with are states. So a camera's frames are turned into states first: as they come, for the
policy (`Seeing`), and afterwards, over whole episodes, for what it learns from (`visadapt/learning/tracking.py`, as
ours).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor, nn

from benchmarks.baselines.cartpole import CartPoleProblem
from benchmarks.baselines.problem import Sizes
from benchmarks.cartpole_pixels import EXPERIMENT
from renderers import DrawnCartPole, load_renderer
from visadapt.effects import ConstantForce, PeriodicForce
from visadapt.history import LENGTH, History
from visadapt.learning.tracking import Tracker
from visadapt.learning.transitions import Transitions
from visadapt.policies import Policy
from visadapt.recordings import Episode
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget
from visadapt.targets.synthetic import no_effects, sine_force
from visadapt.weights import shipped
from visadapt.world import World


@dataclass(frozen=True)
class CartPoleFrames(CartPoleProblem):
    """A CartPole under a hidden effect, of which a camera shows frames and nothing else is known."""

    baselines = ("mpc", "mpc_pixels", "mppi", "pets", "ppo")

    def target(self) -> SyntheticTarget:
        return SyntheticTarget(self.hidden, DrawnCartPole())

    def scored(self, domain: str) -> SyntheticTarget:
        return SyntheticTarget(no_effects, DrawnCartPole()) if domain == "source" else self.target()

    def watching(self, policy: Policy) -> Policy:
        return Seeing(policy)

    def transitions(self, episodes: Sequence[Episode]) -> Transitions:
        return Transitions.cut(tracker().label(episodes))

    @property
    def sizes(self) -> Sizes:
        return replace(Sizes(), plans=((1000, 100),), scored=(100, 200, 500, 1000))


FRAMES = (CartPoleFrames(EXPERIMENT, True, sine_force, PeriodicForce),)


POSE = 1e-3
"""m and rad, deviation of the poses that frames show"""
RATE, PUSH = 1.0, 5.0
"""m/s and rad/s, and N: deviations of the velocities and of the force before any frame is seen"""
STEPS = 3
"""of Gauss and Newton to the most probable path"""
DIFFERENCE = 1e-6
"""in SI units, finite difference of the first state and of the force"""


class Seeing(Policy):
    """A policy on states, shown frames: the path of the source through the poses that the last five frames show.

    The path is the most probable one, under a force that is constant over it. So, as ours, it reads five frames and the
    commands between them.
    """

    shown = "frame"

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy.n_state, policy.n_action)
        self.policy = policy
        self.poses = torch.zeros(0, 0, 2, dtype=torch.float64)  # (B, frames seen, 2), five at most

    @torch.no_grad()
    def act(self, history: History) -> Tensor:
        found = tracker().poses((255 * history.observations[:, -1]).round().to(torch.uint8))
        pose = found.pose
        if bool(history.begins.all()):
            self.poses = pose[:, None]
        else:
            # Where a frame shows no cart-pole, the last pose is kept.
            pose = torch.where(found.explained[:, None], pose, self.poses[:, -1])
            self.poses = torch.cat((self.poses[:, 1 - LENGTH :], pose[:, None]), 1)
        states = path_through(self.poses, history.actions[:, history.actions.shape[1] + 1 - self.poses.shape[1] :])
        before = states[:, :1].expand(-1, LENGTH - states.shape[1], -1)
        return self.policy.act(History(torch.cat((before, states), 1).to(history.actions), history.actions))


def path_through(poses: Tensor, actions: Tensor) -> Tensor:
    """States (B, n, 4) of the source on its way through poses (B, n, 2) under commands (B, n - 1, 1) and a force.

    Five numbers of each episode are unknown: its first state, and the force.
    """
    batch, actions = len(poses), actions.double()

    def path(unknown: Tensor) -> Tensor:
        """(B, n, 4) from the first state and the force (B, 5)."""
        world = World(CartPole(), [ConstantForce(force=unknown[:, 4])]).double()
        states = [unknown[:, :4]]
        for k in range(actions.shape[1]):
            command = actions[:, k].repeat(len(unknown) // batch, 1)
            states.append(world.step(world.start(states[-1]), command).state)
        return torch.stack(states, 1)

    def errors(unknown: Tensor) -> Tensor:
        """(B, 2 n + 3) in standard deviations."""
        away = path(unknown)[..., [0, 2]] - poses.repeat(len(unknown) // batch, 1, 1)
        return torch.cat((away.flatten(1) / POSE, unknown[:, [1, 3]] / RATE, unknown[:, 4:] / PUSH), 1)

    found = torch.zeros(batch, 5, dtype=torch.float64)
    found[:, 0], found[:, 2] = poses[:, 0].unbind(-1)
    step = DIFFERENCE * torch.eye(5, dtype=torch.float64)
    for _ in range(STEPS):
        here, *moved = errors(torch.cat([found, *(found + each for each in step)])).split(batch)
        slope = torch.stack([each - here for each in moved], -1) / DIFFERENCE
        found = found - torch.linalg.lstsq(slope, here[..., None]).solution[..., 0]
    return path(found)


@cache
def renderer() -> nn.Module:
    """The renderer of ours: x (B,) in m and theta (B,) in rad to frames (B, H, W) in [0, 1]."""
    return load_renderer(shipped("renderer")).requires_grad_(False).eval()


@cache
def tracker() -> Tracker:
    """What tells states from whole episodes of frames."""
    return Tracker(renderer(), World(CartPole()))

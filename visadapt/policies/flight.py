"""Policies of rigid bodies: along a reference, and through a point."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from visadapt.history import HORIZON, History
from visadapt.policies.base import Policy, ignore_correction
from visadapt.policies.networks import N_DISTURBANCE, FlightResidualNetwork, mlp
from visadapt.systems.rigid_body import ATTITUDE, POSITION, RATES, VELOCITY, RigidBody, matvec, rotation

LARGEST_POSITION_ERROR, LARGEST_VELOCITY_ERROR = 1.5, 2.5
"""m and m/s, above which `FollowPolicy` reacts no more strongly."""
REACH_DISTANCE = 50.0  # m, the unit of the distance to its point that `ReachPolicy` reads
HEADING_GAIN = 10.0  # what it multiplies the small error of its heading by


class FlightPolicy(Policy):
    """A policy for a rigid body that is shown its state (13) and, after it, its goal; after A.1.1 and A.1.2.

    A linear path past the hidden layers carries the feedback near the goal.

    Args:
        n_goal, n_own: numbers of the goal, and of what `own_inputs` makes of state and goal.
    """

    shown = "state and goal"
    goal: ClassVar[str]
    """what the goal's numbers are, in words"""

    def __init__(self, n_goal: int, n_own: int, arguments: Mapping[str, Any] | None = None) -> None:
        n_action, width, n_state = 4, 128, len(RigidBody.states)
        super().__init__(n_state, n_action, arguments, (n_state + n_goal,))
        self.first = nn.Linear(n_own + self.n_state, width)
        self.rest = mlp(width, width, width)
        self.out = nn.Linear(width, HORIZON * n_action)
        self.skip = nn.Linear(n_own, HORIZON * n_action, bias=False)
        # Last, so that the initial weights of the other layers do not depend on these.
        self.disturbance_in = nn.Linear(N_DISTURBANCE, width, bias=False)
        self.disturbance_out = nn.Linear(N_DISTURBANCE, HORIZON * n_action, bias=False)
        ignore_correction(self.first, self.n_state)
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            for layer in (self.skip, self.disturbance_in, self.disturbance_out):
                layer.weight.zero_()

    def own_inputs(self, state: Tensor, goal: Tensor, axes: Tensor) -> Tensor:
        """What the policy reads of its state (B, 13) and goal (B, n_goal): (B, n_own); `axes` (B, 3, 3), the body's."""
        raise NotImplementedError

    def disturbance_inputs(self, disturbance: Tensor, axes: Tensor) -> Tensor:
        """What it reads of the disturbance estimate (B, N_DISTURBANCE), as many numbers."""
        return disturbance

    def embed(self, history: History) -> Tensor:
        shown = history.observations[:, -1]
        if shown.shape[1:] != self.observation_shape:
            needed = self.observation_shape[0]
            raise ValueError(f"the policy was trained on {needed} numbers of state and goal, got {shown.shape[1]}")
        state, goal = shown[:, : self.n_state], shown[:, self.n_state :]
        axes = rotation(state[:, ATTITUDE])
        disturbance = self.disturbance_inputs(self.disturbance(history), axes)
        return torch.cat((self.own_inputs(state, goal, axes), disturbance), 1)

    def plan(self, inputs: Tensor, correction: Tensor) -> Tensor:
        own, disturbance = inputs[:, :-N_DISTURBANCE], inputs[:, -N_DISTURBANCE:]
        first = self.first(torch.cat((own, correction), 1)) + self.disturbance_in(disturbance)
        hidden = self.rest(first.tanh()).tanh()
        return self.out(hidden) + self.skip(own) + self.disturbance_out(disturbance)

    def disturbance(self, history: History) -> Tensor:
        """The residual's disturbance estimate and its rate, (B, N_DISTURBANCE), to anticipate a changing force."""
        network = None if self.residual is None else self.residual.network
        if not isinstance(network, FlightResidualNetwork):
            return history.actions.new_zeros(len(history.actions), N_DISTURBANCE)
        with torch.no_grad():
            return network.disturbance(history.acting(torch.zeros_like(history.actions[:, 0])))


class FollowPolicy(FlightPolicy):
    """Follows a reference, whose next HORIZON positions and velocities (6 each), `period` s apart, are its goal.

    It reads velocity, the vertical, rates, what `aim` makes of the goal and the disturbance estimate, all in body axes.
    So its response is the same at every heading, except for what it reads of the residual's correction, which is in
    world axes; and under a strong push it may yaw in order to tilt about two axes at once.
    """

    goal = f"the next {HORIZON} points of the reference, a period apart: x, y, z in m and their rates in m/s"

    def __init__(self, period: float) -> None:
        # Velocity, the vertical, rates and the aim.
        super().__init__(n_goal=6 * HORIZON, n_own=3 + 3 + 3 + 6 * HORIZON, arguments={"period": period})
        self.period = period

    def own_inputs(self, state: Tensor, goal: Tensor, axes: Tensor) -> Tensor:
        aim = self.aim(state, goal).unflatten(1, (-1, 3))
        moving = torch.cat((state[:, None, VELOCITY], aim), 1) @ axes
        return torch.cat((moving.flatten(1), axes[:, 2], state[:, RATES]), 1)

    def disturbance_inputs(self, disturbance: Tensor, axes: Tensor) -> Tensor:
        linear, angular, linear_rate, angular_rate = disturbance.unflatten(1, (4, 3)).unbind(1)
        linear, linear_rate = matvec(axes.mT, linear), matvec(axes.mT, linear_rate)
        return torch.cat((linear, angular, linear_rate, angular_rate), 1)

    def aim(self, state: Tensor, goal: Tensor) -> Tensor:
        """The reference minus the path at constant present velocity, (B, 6 HORIZON): positions in m, velocities in m/s.

        Errors of position and velocity are limited to LARGEST_POSITION_ERROR and LARGEST_VELOCITY_ERROR. Since a
        vehicle tilts slowly, one that tilted in proportion to a large error would tilt back too late, and overshoot
        further each time.
        """
        reference = goal.unflatten(1, (HORIZON, 6))
        next_velocity = reference[:, :1, 3:]
        now = reference[:, :1, :3] - self.period * next_velocity  # where the reference is
        position = now - _at_most(LARGEST_POSITION_ERROR, now - state[:, None, POSITION])
        velocity = next_velocity - _at_most(LARGEST_VELOCITY_ERROR, next_velocity - state[:, None, VELOCITY])
        steps = torch.arange(1, HORIZON + 1).to(state)[:, None]
        away = reference[..., :3] - position - self.period * steps * velocity
        return torch.cat((away, reference[..., 3:] - velocity), -1).flatten(1)


def _at_most(limit: float, vectors: Tensor) -> Tensor:
    """Vectors (..., 3), those that are longer shortened to `limit`."""
    return vectors * (limit / vectors.norm(dim=-1, keepdim=True).clamp_min(limit))


class ReachPolicy(FlightPolicy):
    """Flies a fixed wing through a point (3), its goal.

    Like the paper's it reads velocity in world and body axes, two columns of the rotation matrix, the rates, and what
    `aim` makes of the goal.
    """

    goal = "the point to fly through: x, y, z in m"

    def __init__(self) -> None:
        # Velocity in both axes, two columns of the rotation matrix, rates and the aim.
        super().__init__(n_goal=3, n_own=3 + 3 + 6 + 3 + 10)

    def own_inputs(self, state: Tensor, goal: Tensor, axes: Tensor) -> Tensor:
        velocity = state[:, VELOCITY]
        moving = (velocity, matvec(axes.mT, velocity), axes[:, :, :2].flatten(1), state[:, RATES])
        return torch.cat((*moving, self.aim(state, goal, axes)), 1)

    def aim(self, state: Tensor, goal: Tensor, axes: Tensor) -> Tensor:
        """(B, 10): distance / REACH_DISTANCE, direction to the point in body axes, heading error, and that error /
        distance.

        The heading error is HEADING_GAIN times the direction to the point minus that of the velocity, in world axes;
        `axes` (B, 3, 3) are the body's, the rotation matrix of the attitude.
        """
        to_point, velocity = goal - state[:, POSITION], state[:, VELOCITY]
        distance = to_point.norm(dim=1, keepdim=True).clamp_min(1.0)
        direction, heading = to_point / distance, velocity / velocity.norm(dim=1, keepdim=True).clamp_min(1.0)
        error = HEADING_GAIN * (direction - heading)
        return torch.cat((distance / REACH_DISTANCE, matvec(axes.mT, direction), error, error / distance), 1)

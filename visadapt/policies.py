"""Policies: what the last observations and actions say to the next HORIZON actions at once, in [-1, 1].

A policy may listen to a residual: the correction that the residual expects, were nothing done now, joins the
policy's features. It is a function of the same observations and actions, so nothing privileged enters; but the
policy need not learn to see again what grounding has learnt to see, and adapts in far fewer iterations.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from visadapt.effects import Residual
from visadapt.history import LENGTH, History
from visadapt.networks import FEATURES, TOLD, FlightResidualNetwork, FrameEncoder, mlp
from visadapt.systems.rigid_body import ATTITUDE, POSITION, RATES, VELOCITY, RigidBody, rotation, times

HORIZON = 10
"""Actions planned at once, k in the paper; only the first is executed before planning again."""


class Policy(nn.Module):
    """Base of policies; subclasses give features, and the layers that turn them into a plan.

    The correction enters in two ways, both of no weight at first: among the features, and straight into the plan as
    a feed-forward, since what is known to push can be pushed against. `learning.policy.oppose` gives the feed-forward
    its weights once there is a residual; tuning changes all of them.
    """

    def __init__(self, n_state: int, n_action: int) -> None:
        super().__init__()
        self.n_state = n_state
        self.n_action = n_action
        self.feedforward = nn.Linear(n_state, HORIZON * n_action, bias=False)
        nn.init.zeros_(self.feedforward.weight)
        self.residual: Residual | None = None

    def features(self, history: History) -> Tensor:
        """What the policy itself makes of a history, (B, F)."""
        raise NotImplementedError

    def plan(self, features: Tensor, correction: Tensor) -> Tensor:
        """Commands (B, HORIZON * n_action) before the last tanh, from features and the correction (B, n_state)."""
        raise NotImplementedError

    def forward(self, history: History) -> Tensor:
        """Planned actions (B, HORIZON, n_action)."""
        correction = self.correction(history)
        out = (self.plan(self.features(history), correction) + self.feedforward(correction)).tanh()
        return out.unflatten(-1, (HORIZON, self.n_action))

    def act(self, history: History) -> Tensor:
        """The action (B, n_action) to execute now."""
        plan: Tensor = self(history)
        return plan[:, 0]

    def correction(self, history: History) -> Tensor:
        """What the residual expects if nothing is done, (B, n_state) in units of its scale; 0 without one."""
        observations = history.observations
        if self.residual is None:
            return observations.new_zeros(len(observations), self.n_state)
        with torch.no_grad():
            out: Tensor = self.residual.network(history.acting(self._nothing(history)))
        return out

    def _nothing(self, history: History) -> Tensor:
        """An action (B, n_action) of zeros."""
        return history.actions.new_zeros(len(history.actions), self.n_action)


class ImagePolicy(Policy):
    """A 4-layer CNN on the last 5 frames and 5 actions (the paper, section 3.2.3)."""

    def __init__(self, background: Tensor, contrast: float, n_state: int = 4, n_action: int = 1) -> None:
        super().__init__(n_state, n_action)
        self.encoder = FrameEncoder(background, contrast, n_action)
        self.hidden = nn.Linear(FEATURES + n_state, 64)
        self.out = nn.Linear(64, HORIZON * n_action)
        _deafen(self.hidden, n_state)

    def features(self, history: History) -> Tensor:
        out: Tensor = self.encoder(history)
        return out

    def plan(self, features: Tensor, correction: Tensor) -> Tensor:
        out: Tensor = self.out(self.hidden(torch.cat((features, correction), 1)).relu())
        return out


class StatePolicy(Policy):
    """The paper's MLP for balancing, 32-64-64-32-10, tanh (A.1.3), on the state, or on 5 states and actions."""

    def __init__(self, n_state: int, n_action: int = 1, with_history: bool = False) -> None:
        super().__init__(n_state, n_action)
        self.with_history = with_history
        inputs = LENGTH * (n_state + n_action) if with_history else n_state
        self.first = nn.Linear(inputs + n_state, 32)
        self.rest = mlp(32, 64, 64, 32, HORIZON * n_action)
        _deafen(self.first, n_state)

    def features(self, history: History) -> Tensor:
        if self.with_history:
            return torch.cat((history.observations.flatten(1), history.actions.flatten(1)), 1)
        return history.observations[:, -1]

    def plan(self, features: Tensor, correction: Tensor) -> Tensor:
        out: Tensor = self.rest(self.first(torch.cat((features, correction), 1)).tanh())
        return out


class FlightPolicy(Policy):
    """A policy for a rigid body that is shown its state (13) and, after it, its goal; after A.1.1 and A.1.2.

    Like the paper's it reads velocities in world and body axes, two columns of the rotation matrix and the rates, and
    what a subclass makes of the goal. A linear path past the hidden layers carries what feedback does near the goal.
    """

    def __init__(self, n_aim: int, n_action: int = 4, width: int = 128) -> None:
        super().__init__(len(RigidBody.states), n_action)
        self.first = nn.Linear(15 + n_aim + self.n_state, width)
        self.rest = mlp(width, width, width)
        self.out = nn.Linear(width, HORIZON * n_action)
        self.straight = nn.Linear(15 + n_aim, HORIZON * n_action, bias=False)
        # The layers that hear what pushes come last, so that the others are drawn as they were without them.
        self.hearing = nn.Linear(TOLD, width, bias=False)
        self.answer = nn.Linear(TOLD, HORIZON * n_action, bias=False)
        _deafen(self.first, self.n_state)
        with torch.no_grad():
            self.out.weight.mul_(0.1)
            for layer in (self.straight, self.hearing, self.answer):
                layer.weight.zero_()

    def aim(self, state: Tensor, goal: Tensor) -> Tensor:
        """What the goal (B, n_goal) is to a vehicle in a state (B, 13): (B, n_aim)."""
        raise NotImplementedError

    def features(self, history: History) -> Tensor:
        shown = history.observations[:, -1]
        state, goal = shown[:, : self.n_state], shown[:, self.n_state :]
        velocity, turned = state[:, VELOCITY], rotation(state[:, ATTITUDE])
        own = (velocity, times(turned.mT, velocity), turned[:, :, :2].flatten(1), state[:, RATES])
        return torch.cat((*own, self.aim(state, goal), self.told(history)), 1)

    def told(self, history: History) -> Tensor:
        """What pushes and how that changes, (B, TOLD): a plan of a second needs to know where a force is going."""
        network = None if self.residual is None else self.residual.network
        if not isinstance(network, FlightResidualNetwork):
            return history.actions.new_zeros(len(history.actions), TOLD)
        with torch.no_grad():
            return network.told(history.acting(self._nothing(history)))

    def plan(self, features: Tensor, correction: Tensor) -> Tensor:
        own, told = features[:, :-TOLD], features[:, -TOLD:]
        hidden = self.rest((self.first(torch.cat((own, correction), 1)) + self.hearing(told)).tanh()).tanh()
        out: Tensor = self.out(hidden) + self.straight(own) + self.answer(told)
        return out


class Wander(Policy):
    """A random policy: commands (n_action,) about `rest` that the noise of `rollout.run` drives, and that last a while.

    Each is the last one, nearer to rest by the factor `keep`: it has nothing to draw, so that a run that is interrupted
    and goes on draws the same.
    """

    rest: Tensor

    def __init__(self, n_state: int, rest: Tensor, keep: float) -> None:
        super().__init__(n_state, len(rest))
        self.register_buffer("rest", rest.clone())
        self.keep = keep

    def forward(self, history: History) -> Tensor:
        # Before an episode all actions are zero, which is nobody's command: it begins at rest.
        begun = history.actions.flatten(1).any(1, keepdim=True)
        away = torch.where(begun, history.actions[:, -1] - self.rest, 0.0)
        lasting = self.keep ** torch.arange(1, HORIZON + 1).to(away)
        return self.rest + away[:, None] * lasting[:, None]


class FollowPolicy(FlightPolicy):
    """Follows a reference, whose next HORIZON positions and velocities (6 each), `period` s apart, are its goal."""

    def __init__(self, period: float) -> None:
        super().__init__(6 * HORIZON)
        self.period = period

    def aim(self, state: Tensor, goal: Tensor) -> Tensor:
        """What is left of the reference after going on at the present velocity."""
        reference, velocity = goal.unflatten(1, (HORIZON, 6)), state[:, None, VELOCITY]
        steps = torch.arange(1, HORIZON + 1).to(state)[:, None]
        away = reference[..., :3] - state[:, None, POSITION] - self.period * steps * velocity
        return torch.cat((away, reference[..., 3:] - velocity), -1).flatten(1)


class ReachPolicy(FlightPolicy):
    """Flies a fixed wing through a point (3), its goal."""

    def __init__(self) -> None:
        super().__init__(10)

    def aim(self, state: Tensor, goal: Tensor) -> Tensor:
        """The distance, the direction to the point in body axes, and how far the path points aside, near and far."""
        to, velocity = goal - state[:, POSITION], state[:, VELOCITY]
        distance = to.norm(dim=1, keepdim=True).clamp_min(1.0)
        way, path = to / distance, velocity / velocity.norm(dim=1, keepdim=True).clamp_min(1.0)
        aside = 10 * (way - path)
        return torch.cat((distance / 50, times(rotation(state[:, ATTITUDE]).mT, way), aside, aside / distance), 1)


def _deafen(layer: nn.Linear, n_state: int) -> None:
    """Begin with no weight on the correction: a residual changes nothing until the policy is tuned with it."""
    with torch.no_grad():
        layer.weight[:, -n_state:] = 0.0

"""Residual networks, and the layers that policies and these have in common; the encoder of frames is in
`frame_encoder.py`."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn

from visadapt.history import LENGTH, History
from visadapt.policies.frame_encoder import N_KINEMATICS, FrameEncoder
from visadapt.systems import System
from visadapt.systems.rigid_body import ATTITUDE, RATES, VELOCITY, RigidBody, rotation

N_ACCELERATIONS = 6  # of a rigid body: of velocity, and of rates
N_DISTURBANCE = 2 * N_ACCELERATIONS  # Width of `FlightResidualNetwork.disturbance`
ACTION_UNIT = 0.1
"""Size of a cart-pole's commands near rest, as a share of their range."""
FRAMES_ACTION_PENALTY = 0.1
"""What ridge regression multiplies the squared weights of commands by, for a residual that reads frames."""
ACCELERATION_UNIT = 2.0  # m/s2 and rad/s2, unit of the unexplained accelerations that a network reads
HISTORY_ACCELERATION_UNIT = 0.2
"""m/s2 and rad/s2, their unit in the history that a vehicle's residual reads. The small unit makes these inputs large,
so that ridge regression predicts the disturbance from its own history rather than from velocities and attitudes that
happen to be correlated with it."""
Predict = Callable[[Tensor, Tensor], Tensor]
"""States (B, T, n) in a row and the actions (B, T, n_action) in them to the states one period later."""


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers of the given widths with tanh between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class ResidualNetwork(nn.Module):
    """Base of residual networks: fixed inputs, and a head on them that grounding fits. Its output is zero at first.

    Args:
        head: a linear layer, or layers of which the last is linear.
    """

    def __init__(self, head: nn.Linear | nn.Sequential) -> None:
        super().__init__()
        self.head = head
        last = head[-1] if isinstance(head, nn.Sequential) else head
        for weight in last.parameters():
            nn.init.zeros_(weight)

    def embed(self, history: History) -> Tensor:
        """The head's inputs (B, inputs)."""
        raise NotImplementedError

    def has_full_history(self, inputs: Tensor) -> Tensor:
        """(B,) whether the head's inputs (B, inputs) have a complete history; it is fitted to these rows alone."""
        return inputs.new_ones(len(inputs), dtype=torch.bool)

    def penalties(self, inputs: Tensor) -> Tensor:
        """(inputs,) what ridge regression multiplies the squared weights of each of the inputs (B, inputs) by."""
        return torch.ones_like(inputs[0])

    def forward(self, history: History) -> Tensor:
        """Corrections (B, n_state) in units of the residual's scale."""
        return self.head(self.embed(history))


class ImageResidualNetwork(ResidualNetwork):
    """A 4-layer CNN on the last 5 frames and 5 actions (the paper, section 3.2.3).

    The encoder reads positions and angles from the frames, which `learning.perception` trained it to do in the source:
    a few hundred target samples are too few to learn that too. The head's inputs are these, the actions, and the
    accelerations that the source's system, without its effects, does not explain (`unexplained`). The head is linear
    without a bias, so that it adds nothing where a bare source explains everything. An MLP instead learns from a few
    hundred samples where along the track the target happened to push, and is wrong in the next episode.

    In the first rows of an episode the history repeats the first frame, so a cart that already moves seems to start
    from rest there. Leaving these rows out of the fit, or filling them as `fill_before_start` does, made no difference
    that 60 episodes could show.

    Args:
        background, contrast: those of `FrameEncoder`.
        system: the source physics, whose states are x, x_dot, theta, theta_dot.
        period: s between frames.
        scale: (N_KINEMATICS,) units of the encoder's readout.
    """

    scale: Tensor

    def __init__(self, background: Tensor, contrast: float, system: System, period: float, scale: Tensor) -> None:
        n_action = len(system.actions)
        inputs = N_KINEMATICS + LENGTH * n_action + 2 * (LENGTH - 2)
        super().__init__(nn.Linear(inputs, len(system.states), bias=False))
        self.encoder = FrameEncoder(background, contrast, n_action)
        self.system = system
        self.period = period
        self.register_buffer("scale", scale.clone())

    def embed(self, history: History) -> Tensor:
        kinematics = self.encoder.kinematics(history)
        unexplained = self.unexplained(kinematics * self.scale, history.actions) / ACCELERATION_UNIT
        return torch.cat((kinematics, history.actions.flatten(1), unexplained.flatten(1)), 1)

    def penalties(self, inputs: Tensor) -> Tensor:
        """(inputs,) FRAMES_ACTION_PENALTY for the actions, which are small near rest; else 1."""
        every = super().penalties(inputs)
        every[N_KINEMATICS : N_KINEMATICS + self.encoder.n_action * LENGTH] = FRAMES_ACTION_PENALTY
        return every

    def unexplained(self, kinematics: Tensor, actions: Tensor) -> Tensor:
        """Accelerations of cart and pole minus the system's, (B, LENGTH - 2, 2), at all frames but the first and last.

        The measured acceleration at a frame is the second difference of positions; the system's is the mean of those
        under the action before and the action after the frame.

        Args:
            kinematics: (B, N_KINEMATICS) latest positions and their changes, SI units.
            actions: (B, LENGTH, n_action).
        """
        latest = kinematics[:, [0, LENGTH]]
        changes = torch.stack((kinematics[:, 1:LENGTH], kinematics[:, LENGTH + 1 :]), -1)
        since = changes.flip(1).cumsum(1).flip(1)  # from the frame before each change to the latest
        positions = latest[:, None] - since[:, 1:]
        velocities = (changes[:, 1:] + changes[:, :-1]) / (2 * self.period)
        states = torch.stack((positions, velocities), -1).flatten(-2)
        before = accelerations(self.system, states, actions[:, : LENGTH - 2])
        after = accelerations(self.system, states, actions[:, 1 : LENGTH - 1])
        measured = changes.diff(dim=1) / self.period**2
        return measured - (before + after) / 2


class StateResidualNetwork(ResidualNetwork):
    """The paper's MLP on the last state and action, with two hidden layers of 64, tanh (3.2.1)."""

    def __init__(self, n_state: int, n_action: int = 1) -> None:
        # Not used: its random numbers are drawn so that a seed gives the weights that it gave the published tables.
        nn.Linear(LENGTH * (n_state + n_action), n_state, bias=False)
        super().__init__(mlp(n_state + n_action, 64, 64, n_state))

    def embed(self, history: History) -> Tensor:
        return torch.cat((history.observations[:, -1], history.actions[:, -1]), 1)


class StateHistoryResidualNetwork(ResidualNetwork):
    """A linear map, without a bias, of the last 5 states and actions and of the accelerations between these states that
    the source does not explain, the only inputs that show a force that changes.

    The paper's residual of states with a history (3.2.2) is an MLP; this is linear for the reason that
    `ImageResidualNetwork` gives.

    Args:
        system: the source physics.
        period: s between actions.
    """

    def __init__(self, system: System, period: float) -> None:
        self.n_state, self.n_action = len(system.states), len(system.actions)
        inputs = LENGTH * (self.n_state + self.n_action) + (LENGTH - 1) * len(system.coordinates)
        super().__init__(nn.Linear(inputs, self.n_state, bias=False))
        self.system = system
        self.period = period

    def embed(self, history: History) -> Tensor:
        states, actions = history.observations, history.actions
        unexplained = self.unexplained(states, actions) / ACCELERATION_UNIT
        return torch.cat((states.flatten(1), actions.flatten(1), unexplained.flatten(1)), 1)

    def has_full_history(self, inputs: Tensor) -> Tensor:
        """(B,) False in the first LENGTH - 1 rows of an episode, whose history is incomplete."""
        states = inputs[:, : LENGTH * self.n_state].unflatten(1, (LENGTH, self.n_state))
        return states.diff(dim=1).any(2).all(1)

    def penalties(self, inputs: Tensor) -> Tensor:
        """(inputs,) ACTION_UNIT squared for the actions, else 1.

        Near rest the commands are small, so their weights must be large to represent a late or weak motor. With the
        same penalty as the other inputs, they represented only a quarter of that effect after 200 samples, and policies
        that were tuned with such a residual fell.
        """
        every = super().penalties(inputs)
        states = LENGTH * self.n_state
        every[states : states + LENGTH * self.n_action] = ACTION_UNIT**2
        return every

    def unexplained(self, states: Tensor, actions: Tensor) -> Tensor:
        """Mean accelerations minus the system's over the periods between states, (B, LENGTH - 1, J) of J joints.

        The system's is the mean of those at both ends of a period, under the action held in between.
        `fill_before_start` fills the periods before an episode.
        """
        ends = [accelerations(self.system, part, actions[:, :-1]) for part in (states[:, :-1], states[:, 1:])]
        measured = states.diff(dim=1)[..., [velocity for _, velocity in self.system.coordinates]] / self.period
        unexplained = measured - (ends[0] + ends[1]) / 2
        return fill_before_start(unexplained, states.diff(dim=1).any(2, keepdim=True))


def accelerations(system: System, states: Tensor, actions: Tensor) -> Tensor:
    """The system's accelerations (B, T, J) of the joints in states (B, T, n) under actions (B, T, n_action)."""
    flat = states.flatten(0, 1)
    loads = flat.new_zeros(len(flat), len(system.loads))
    return system.accelerations(flat, actions.flatten(0, 1), loads).unflatten(0, states.shape[:2])


def fill_before_start(values: Tensor, known: Tensor) -> Tensor:
    """The values (B, periods, n); in the periods before an episode starts, those of its first period.

    `known` (B, periods, 1) says which periods are of the episode: before it, its first state is repeated. Where no
    period is known, all values are 0.
    """
    newest_first = [values[:, -1] * known[:, -1]]
    for k in range(values.shape[1] - 2, -1, -1):
        newest_first.append(torch.where(known[:, k], values[:, k], newest_first[-1]))
    return torch.stack(newest_first[::-1], 1)


class FlightResidualNetwork(ResidualNetwork):
    """A linear map of a vehicle's velocity, rotation matrix, rates and action; few weights and no position to overfit.

    Drag, wind, weight and weak motors are linear in these to first order, and a few hundred samples suffice to fit
    them. With a history it also reads the changes of velocity and rates over the last periods that the source does
    not explain, the only inputs that show a force that changes.

    Args:
        system: the vehicle.
        period: s between actions.
        predict: the source's steps (B, T, 13) from consecutive states (B, T, 13) under actions (B, T, n_action); None
            reads no history.
    """

    def __init__(self, system: RigidBody, period: float, predict: Predict | None = None) -> None:
        inputs = 3 + 9 + 3 + len(system.actions)  # velocity, rotation matrix, rates, action
        if predict is not None:
            inputs += N_ACCELERATIONS * (LENGTH - 1)
        super().__init__(nn.Linear(inputs, len(system.states), bias=False))
        self.n_state = len(system.states)
        self.period = period
        self.predict = predict

    def embed(self, history: History) -> Tensor:
        states = history.observations[..., : self.n_state]
        last = states[:, -1]
        turned = rotation(last[:, ATTITUDE]).flatten(1)
        own = torch.cat((last[:, VELOCITY], turned, last[:, RATES], history.actions[:, -1]), 1)
        if self.predict is None:
            return own
        return torch.cat((own, self.unexplained(self.predict, states, history.actions)), 1)

    def has_full_history(self, inputs: Tensor) -> Tensor:
        """(B,) False in the first LENGTH - 1 rows of a flight, whose history is incomplete; True if none is read."""
        if self.predict is None:
            return super().has_full_history(inputs)
        past = inputs[:, -N_ACCELERATIONS * (LENGTH - 1) :].unflatten(1, (LENGTH - 1, N_ACCELERATIONS))
        return past.diff(dim=1).any(2).all(1)

    def disturbance(self, history: History) -> Tensor:
        """The disturbance estimate (B, N_DISTURBANCE): the last unexplained accelerations and their rates.

        In ACCELERATION_UNIT, and ACCELERATION_UNIT per second; zeros without `predict`. The last action of the
        history, the one being executed, is not used.
        """
        states = history.observations[..., : self.n_state]
        if self.predict is None:
            return states.new_zeros(len(states), N_DISTURBANCE)
        past = self.unexplained(self.predict, states, history.actions).unflatten(1, (LENGTH - 1, -1))
        past = past * (HISTORY_ACCELERATION_UNIT / ACCELERATION_UNIT)
        change = (past[:, -1] - past[:, 0]) / ((LENGTH - 2) * self.period)
        return torch.cat((past[:, -1], change), 1)

    def unexplained(self, predict: Predict, states: Tensor, actions: Tensor) -> Tensor:
        """Changes of velocity and rates minus the source's over the periods between states, flattened.

        (B, (LENGTH - 1) N_ACCELERATIONS), in units of HISTORY_ACCELERATION_UNIT times a period. `fill_before_start`
        fills the periods before a flight.
        """
        predicted = predict(states[:, :-1], actions[:, :-1]).flatten(0, 1)
        before, after = states[:, :-1].flatten(0, 1), states[:, 1:].flatten(0, 1)
        errors = after - predicted
        changes = torch.cat((errors[:, VELOCITY], errors[:, RATES]), 1) / (HISTORY_ACCELERATION_UNIT * self.period)
        known = (after != before).any(1, keepdim=True)
        periods = (len(states), LENGTH - 1)
        return fill_before_start(changes.unflatten(0, periods), known.unflatten(0, periods)).flatten(1)

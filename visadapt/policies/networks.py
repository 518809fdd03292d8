"""Network bodies that policies and residuals share."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from visadapt.history import LENGTH, History
from visadapt.systems import System
from visadapt.systems.rigid_body import ATTITUDE, RATES, VELOCITY, RigidBody, rotation

CHANNELS = (8, 16, 32, 32)
FEATURES = 128
CHANGE_GAIN = 2.0
EXPECTED = 2.0
"""m/s2 and rad/s2: unexplained accelerations are given to a residual's head in units of this"""
FELT = 0.2
"""m/s2 and rad/s2: the same, of vehicles. Small, so that ridge regression trusts a rule by which the unexplained goes
on, from its past, before velocities and attitudes that happened to go with it."""
TOLD = 12
"""What `FlightResidualNetwork.told` tells."""
Predict = Callable[[Tensor, Tensor], Tensor]
"""States and actions to the states a period later."""
KINEMATICS = 2 * LENGTH
"""The latest position and its LENGTH - 1 changes, for each of the two things that move: cart and pole."""


class FrameEncoder(nn.Module):
    """Four convolutions, kernel 3, stride 2, ReLU (the paper, section 3.2.3) over the last frames; actions join after.

    The frames enter as the latest one less the background, and the differences of neighbours, magnified: a
    fixed invertible linear map of the same pixels, without which velocities are lost beside the still stream.

    Args:
        background: (H, W) mean frame in [0, 1]; it is saved with the weights, as is `contrast`, their spread.
        n_action: width of an action.
    """

    background: Tensor
    contrast: Tensor

    def __init__(self, background: Tensor, contrast: float, n_action: int) -> None:
        super().__init__()
        self.n_action = n_action
        self.register_buffer("background", background.clone())
        self.register_buffer("contrast", torch.as_tensor(contrast, dtype=background.dtype))
        layers = [nn.Conv2d(i, o, 3, stride=2, padding=1) for i, o in pairwise((LENGTH, *CHANNELS))]
        self.convolutions = nn.ModuleList(layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        rows, columns = (-(-size // 2 ** len(layers)) for size in background.shape)
        width = CHANNELS[-1] * rows * columns
        self.join = nn.Sequential(nn.Linear(width + LENGTH * n_action, FEATURES), nn.ReLU())
        self.readout = nn.Linear(FEATURES, KINEMATICS)

    def forward(self, history: History) -> Tensor:
        """Features (B, FEATURES) of frames (B, LENGTH, H, W) in [0, 1] and actions (B, LENGTH, n_action)."""
        frames = history.observations
        if frames.shape[-2:] != self.background.shape:
            raise ValueError(
                f"the network was made for frames of {tuple(self.background.shape)} (height, width), "
                f"got {tuple(frames.shape[-2:])}"
            )
        seen = self._first(frames.contiguous(memory_format=torch.channels_last)).relu()
        for convolution in self.convolutions[1:]:
            seen = convolution(seen).relu()
        return self.join(torch.cat((seen.flatten(1), history.actions.flatten(1)), 1))

    def kinematics(self, history: History) -> Tensor:
        """Positions and angles seen, (B, KINEMATICS), in units of `learning.perception.Paths.scale`."""
        out: Tensor = self.readout(self(history))
        return out

    def _first(self, frames: Tensor) -> Tensor:
        """The first convolution, of the latest frame less the background and twice the differences of neighbours.

        That map of the frames is linear, so it is folded into the kernel: the big tensors are touched once.
        """
        first = self.convolutions[0]
        mix = frames.new_zeros(LENGTH, LENGTH)
        mix[0, -1] = 1.0
        for k in range(1, LENGTH):
            mix[k, k], mix[k, k - 1] = CHANGE_GAIN, -CHANGE_GAIN
        kernel = torch.einsum("ocij,cf->ofij", first.weight, mix / self.contrast)
        still = F.conv2d(self.background[None, None], first.weight[:, :1] / self.contrast, stride=2, padding=1)
        return F.conv2d(frames, kernel, first.bias, stride=2, padding=1) - still


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers of the given widths with tanh between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class ResidualNetwork(nn.Module):
    """Base of residual networks: what is seen, and a head on it that grounding fits. It begins at zero.

    Args:
        head: either linear, or layers whose last one is linear.
    """

    def __init__(self, head: nn.Linear | nn.Sequential) -> None:
        super().__init__()
        self.head = head
        last = head[-1] if isinstance(head, nn.Sequential) else head
        for weight in last.parameters():
            nn.init.zeros_(weight)

    def embed(self, history: History) -> Tensor:
        """What the head reads, (B, inputs)."""
        raise NotImplementedError

    def informed(self, seen: Tensor) -> Tensor:
        """(B,) whether what the head reads (B, inputs) can tell what moves the target: it is fitted to these alone."""
        return seen.new_ones(len(seen), dtype=torch.bool)

    def forward(self, history: History) -> Tensor:
        """Corrections (B, n_state) in units of the residual's scale."""
        out: Tensor = self.head(self.embed(history))
        return out


class ImageResidualNetwork(ResidualNetwork):
    """A 4-layer CNN on the last 5 frames and 5 actions (the paper, section 3.2.3).

    Between the convolutions and the head stand the positions and angles that the frames show, read as
    `learning.perception` taught it in the source: a few hundred samples are too few to learn to see as well. The
    head reads them, the actions, and the accelerations that the source does not explain (`unexplained`). It is linear
    and knows no constant: where the source explains everything it has nothing to say. An MLP in its place learns from
    a few hundred samples where along the track the target happened to push, and is wrong on the next episode.

    Args:
        system: the source physics, whose states are x, x_dot, theta, theta_dot.
        period: s between frames.
        scale: (KINEMATICS,) units of the encoder's readout.
    """

    scale: Tensor

    def __init__(self, background: Tensor, contrast: float, system: System, period: float, scale: Tensor) -> None:
        n_action = len(system.actions)
        inputs = KINEMATICS + LENGTH * n_action + 2 * (LENGTH - 2)
        super().__init__(nn.Linear(inputs, len(system.states), bias=False))
        self.encoder = FrameEncoder(background, contrast, n_action)
        self.system = system
        self.period = period
        self.register_buffer("scale", scale.clone())

    def embed(self, history: History) -> Tensor:
        kinematics = self.encoder.kinematics(history)
        unexplained = self.unexplained(kinematics * self.scale, history.actions) / EXPECTED
        return torch.cat((kinematics, history.actions.flatten(1), unexplained.flatten(1)), 1)

    def unexplained(self, kinematics: Tensor, actions: Tensor) -> Tensor:
        """Accelerations of cart and pole beyond the source's, (B, LENGTH - 2, 2), at all frames but first and last.

        At a frame the measured acceleration is the second difference of positions. Over the two periods around it
        the source's is the mean of those under the action before and the action after.
        `kinematics` (B, KINEMATICS) is in SI units, latest positions and changes; actions are (B, LENGTH, n_action).
        """
        latest = kinematics[:, [0, LENGTH]]
        changes = torch.stack((kinematics[:, 1:LENGTH], kinematics[:, LENGTH + 1 :]), -1)
        back = changes.flip(1).cumsum(1).flip(1)
        positions = latest[:, None] - back[:, 1:]
        velocities = (changes[:, 1:] + changes[:, :-1]) / (2 * self.period)
        states = torch.stack((positions, velocities), -1).flatten(-2)
        load = states.new_zeros(*states.shape[:-1], len(self.system.loads))
        before = self.system.derivative(states, actions[:, : LENGTH - 2], load)
        after = self.system.derivative(states, actions[:, 1 : LENGTH - 1], load)
        measured = changes.diff(dim=1) / self.period**2
        return measured - (before + after)[..., 1::2] / 2


class StateResidualNetwork(ResidualNetwork):
    """The paper's MLP with two hidden layers of 64, tanh (3.2.1), on state and action, or on 5 of each (3.2.2).

    On a history, given the source's `system` and the `period` in s, it also reads the accelerations that the source
    leaves unexplained between the states: a force that changes shows there and nowhere else.
    """

    def __init__(self, n_state: int, n_action: int = 1, system: System | None = None, period: float = 0.0) -> None:
        history = 0 if system is None else LENGTH
        inputs = max(1, history) * (n_state + n_action) + max(0, history - 1) * n_state // 2
        super().__init__(mlp(inputs, 64, 64, n_state))
        self.system = system
        self.period = period

    def embed(self, history: History) -> Tensor:
        states, actions = history.observations, history.actions
        if self.system is None:
            return torch.cat((states[:, -1], actions[:, -1]), 1)
        unexplained = self.unexplained(self.system, states, actions) / EXPECTED
        return torch.cat((states.flatten(1), actions.flatten(1), unexplained.flatten(1)), 1)

    def unexplained(self, system: System, states: Tensor, actions: Tensor) -> Tensor:
        """Mean accelerations beyond the source's over the periods between states, (B, LENGTH - 1, n_state / 2).

        The source's is the mean of those at both ends of a period, under the action held over it.
        """
        load = states.new_zeros(*states.shape[:-1], len(system.loads))[:, 1:]
        ends = [system.derivative(part, actions[:, :-1], load) for part in (states[:, :-1], states[:, 1:])]
        measured = states.diff(dim=1) / self.period
        return (measured - (ends[0] + ends[1]) / 2)[..., 1::2]


class FlightResidualNetwork(ResidualNetwork):
    """Linear in what moves a rigid body: velocity, rotation, rates and action now; no position, no network to overfit.

    Drag, wind, weight and weak motors are linear in these to first order, and a few hundred samples fit them. With a
    history it also reads the changes of velocity and rates that the source left unexplained over the last periods: a
    force that changes shows there and nowhere else.

    Args:
        system: the vehicle.
        period: s between actions.
        predict: the source's step, (B, 13) and (B, n_action) to (B, 13); without it, there is no history.
    """

    def __init__(self, system: RigidBody, period: float, predict: Predict | None = None) -> None:
        inputs = 15 + len(system.actions) + (0 if predict is None else 6 * (LENGTH - 1))
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

    def informed(self, seen: Tensor) -> Tensor:
        """All but the first of a flight, whose past is not whole: a rule learnt from them holds nowhere else."""
        if self.predict is None:
            return super().informed(seen)
        past = seen[:, -6 * (LENGTH - 1) :].unflatten(1, (LENGTH - 1, 6))
        return past.diff(dim=1).any(2).all(1)

    def told(self, history: History) -> Tensor:
        """What pushes a vehicle and how that changes, (B, TOLD): unexplained accelerations, and their rates.

        The last action of the history is the one being executed, as for `forward`; it does not matter here.
        Of velocity and rates each, in units of EXPECTED and of EXPECTED a second; zeros where there is no history.
        """
        states = history.observations[..., : self.n_state]
        if self.predict is None:
            return states.new_zeros(len(states), TOLD)
        past = self.unexplained(self.predict, states, history.actions).unflatten(1, (LENGTH - 1, -1))
        past = past * (FELT / EXPECTED)
        change = (past[:, -1] - past[:, 0]) / ((LENGTH - 2) * self.period)
        return torch.cat((past[:, -1], change), 1)

    def unexplained(self, predict: Predict, states: Tensor, actions: Tensor) -> Tensor:
        """Changes of velocity and rates beyond the source's over the periods between states, (B, 6 (LENGTH - 1)).

        In units of FELT times a period. Before a flight begins its first state stands still, which says nothing:
        there stands what the first period of the flight said.
        """
        before, after = states[:, :-1].flatten(0, 1), states[:, 1:].flatten(0, 1)
        left = after - predict(before, actions[:, :-1].flatten(0, 1))
        moving = torch.cat((left[:, VELOCITY], left[:, RATES]), 1) / (FELT * self.period)
        known = (after != before).any(1, keepdim=True)
        periods = (len(states), LENGTH - 1)
        found, told = moving.unflatten(0, periods).unbind(1), known.unflatten(0, periods).unbind(1)
        past = [found[-1] * told[-1]]
        for change, is_known in zip(found[-2::-1], told[-2::-1], strict=True):
            past.append(torch.where(is_known, change, past[-1]))
        return torch.cat(past[::-1], 1)

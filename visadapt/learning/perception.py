"""Perception: a frame encoder is trained, on rendered frames alone, to read where cart and pole are and how they moved.

The frames follow random smooth paths that obey no dynamics, so the encoder learns kinematics only, and nothing about
forces or about a target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from visadapt.history import LENGTH, History
from visadapt.learning.training_state import TrainingState
from visadapt.policies.frame_encoder import FrameEncoder
from visadapt.progress import Progress

SECOND_DIFFERENCE_WEIGHT = 8.0  # Of positions, in the loss: second differences alone show a force


@dataclass(frozen=True)
class Paths:
    """The distribution of random paths of one coordinate, in m or rad, and the units of the encoder's estimates of it.

    The first position is uniform, the first velocity normal, and each period has a normal acceleration of its own.
    """

    reach: float  # half-width of the range of the first position
    velocity: float  # standard deviation of the first velocity, per s
    acceleration: float  # standard deviation, per s2

    def draw(self, batch: int, length: int, period: float, generator: torch.Generator) -> Tensor:
        """Positions (batch, length), `period` s apart."""
        start = self.reach * (2 * torch.rand(batch, 1, generator=generator) - 1)
        first_velocity = self.velocity * torch.randn(batch, 1, generator=generator)
        accelerations = self.acceleration * torch.randn(batch, length - 1, generator=generator)
        gained = period * accelerations
        velocities = first_velocity + gained.cumsum(1) - gained  # at the beginning of each period
        return torch.cat((start, start + (period * velocities + period**2 / 2 * accelerations).cumsum(1)), 1)

    def scale(self, period: float) -> Tensor:
        """(LENGTH,) typical size of the position and of its changes per period."""
        return torch.tensor([self.reach / 2] + [self.velocity * period] * (LENGTH - 1))


@dataclass(frozen=True)
class PerceptionSettings:
    """How a frame encoder is trained to read positions and their changes."""

    iterations: int = 4000
    streams: int = 32  # paths rendered in an iteration
    length: int = 8  # frames of a path; each gives length - 4 windows
    learning_rate: float = 2e-3
    pixel_noise: float = 0.004  # standard deviation of white noise on the frames
    cart: Paths = Paths(reach=1.3, velocity=0.4, acceleration=2.0)
    pole: Paths = Paths(reach=0.2, velocity=0.4, acceleration=4.0)


def kinematics_units(settings: PerceptionSettings, period: float) -> Tensor:
    """(N_KINEMATICS,) units, in m and rad, of the positions and changes that an encoder reads."""
    return torch.cat((settings.cart.scale(period), settings.pole.scale(period)))


def kinematics(positions: Tensor) -> Tensor:
    """The latest of the positions (..., LENGTH) and their LENGTH - 1 changes, (..., LENGTH)."""
    return torch.cat((positions[..., -1:], positions.diff(dim=-1)), -1)


def train_encoder(
    encoder: FrameEncoder,
    render: Callable[[Tensor, Tensor], Tensor],
    period: float,
    settings: PerceptionSettings,
    generator: torch.Generator,
    progress: Progress | None,
    checkpoint: Path | None,
) -> list[float]:
    """Train `encoder`, in place, to read positions and changes from 5 rendered frames; returns the losses.

    Beside positions and changes the loss weighs second differences, since only these show a force.
    """
    optimiser = torch.optim.AdamW(encoder.parameters(), weight_decay=1e-4)
    rate, steps = settings.learning_rate, settings.iterations
    training = TrainingState(encoder, optimiser, generator, rate, steps, progress, checkpoint)
    training.resume()
    like = next(encoder.parameters())
    units = kinematics_units(settings, period).to(like)
    for _ in range(len(training.losses), steps):
        paths = [
            coordinate.draw(settings.streams, settings.length, period, generator).to(like)
            for coordinate in (settings.cart, settings.pole)
        ]
        with torch.no_grad():
            frames = render(paths[0].flatten(), paths[1].flatten()).unflatten(0, paths[0].shape)
            frames = frames + settings.pixel_noise * torch.randn(frames.shape, generator=generator).to(like)
        windows = frames.unfold(1, LENGTH, 1).permute(0, 1, 4, 2, 3).flatten(0, 1)
        truth = torch.cat([kinematics(path.unfold(1, LENGTH, 1).flatten(0, 1)) for path in paths], 1) / units
        actions = windows.new_zeros(len(windows), LENGTH, encoder.n_action)
        error = encoder.kinematics(History(windows, actions)) - truth
        second = torch.cat([error[:, 1:LENGTH].diff(dim=1), error[:, LENGTH + 1 :].diff(dim=1)], 1)
        training.descend(error.square().mean() + SECOND_DIFFERENCE_WEIGHT * second.square().mean())
        training.keep({})
    return training.losses

"""A target is anything that can be run: it takes actions and shows frames, states, or both."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor


class TargetError(RuntimeError):
    """The target did something that no adaptation can go on from; the message says what, in one line."""


@dataclass(frozen=True)
class Observation:
    """What a batch of targets shows at one instant."""

    state: Tensor
    """(B, n_state), SI units: for labels and scores, never for an image policy"""
    alive: Tensor
    """(B,) whether the episode can go on: the pole up and the cart in the frame"""
    frame: Tensor | None = None
    """(B, H, W) uint8"""
    force: Tensor | None = None
    """(B,), or of vehicles (B, 3), the disturbance in N, where the target knows it: for films only"""
    goal: Tensor | None = None
    """(B, n_goal) what the policy is to do, where that is not always the same"""
    place: Tensor | None = None
    """(B, n_place) where each is on its course, where there is one: the task's and the course's own numbers"""


class Target(ABC):
    """A batch of machines of one kind, reset and stepped together.

    A row whose episode has ended may still be stepped: what it shows then means nothing.
    """

    name: str
    period: float
    """s between actions"""
    n_action: int

    @abstractmethod
    def reset(self, batch: int, generator: torch.Generator) -> Observation:
        """Start `batch` new episodes."""

    @abstractmethod
    def step(self, action: Tensor) -> Observation:
        """Execute the action (B, n_action) in [-1, 1] for one period."""

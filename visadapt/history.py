"""What policies and residuals are allowed to see: the last observations and actions, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Self

import torch
from torch import Tensor

LENGTH = 5
"""Observations and actions kept (the paper, section 3.2.2)."""

HORIZON = 10
"""Actions planned at once, k in the paper; only the first is executed before planning again."""


class Batch:
    """Base of dataclasses of tensors, and of tuples of tensors, whose first axis numbers the rows of a batch."""

    def detach(self) -> Self:
        """The same, cut off from the graph."""
        return _each(Tensor.detach, self)

    def where(self, keep: Tensor, other: Self) -> Self:
        """This batch in the rows where `keep` (B,) holds, `other` in the rest."""
        return _each(lambda own, more: torch.where(keep.reshape(-1, *[1] * (own.dim() - 1)), own, more), self, other)

    def joined(self, other: Self) -> Self:
        """The rows of this batch and, after them, those of another."""
        return _each(lambda *parts: torch.cat(parts), self, other)

    def __getitem__(self, rows: Tensor | slice) -> Self:
        return _each(lambda values: values[rows], self)


def _each(do: Callable[..., Tensor], *batches: Any) -> Any:
    """`do` of all tensors that stand in the same place of the batches."""
    first = batches[0]
    if isinstance(first, Tensor):
        return do(*batches)
    if isinstance(first, tuple):
        return tuple(_each(do, *parts) for parts in zip(*batches, strict=True))
    return type(first)(*(_each(do, *(getattr(each, part.name) for each in batches)) for part in fields(first)))


@dataclass(frozen=True)
class History(Batch):
    """The last observations (B, L, ...), oldest first, and the last actions (B, L, n_action).

    For a policy the last action is the one before the last observation; for a residual (see `acting`) it is the
    one being executed. An observation is a frame (H, W) in [0, 1] or a state (n_state,).
    """

    observations: Tensor
    actions: Tensor

    @classmethod
    def start(cls, observation: Tensor, n_action: int) -> History:
        """At the start of an episode: the first observation (B, ...) repeated, and zero actions."""
        repeated = observation[:, None].expand(-1, LENGTH, *observation.shape[1:])
        return cls(repeated.clone(), observation.new_zeros(len(observation), LENGTH, n_action))

    def acting(self, action: Tensor) -> History:
        """The same observations, with `action` (B, n_action) as the last action."""
        return History(self.observations, torch.cat((self.actions[:, 1:], action[:, None]), 1))

    def observing(self, observation: Tensor) -> History:
        """The same actions, with `observation` (B, ...) as the last observation."""
        return History(torch.cat((self.observations[:, 1:], observation[:, None]), 1), self.actions)

"""Dataclasses of tensors with one row for each member of a batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, Self, get_type_hints

import torch
from torch import Tensor


def placed(values: Tensor, like: Tensor) -> Tensor:
    """The values on the device of `like` and, where they are of floating point, with its dtype."""
    return values.to(like) if values.is_floating_point() else values.to(like.device)


class Batch:
    """Base of dataclasses whose fields are tensors (B, ...), tuples of these, or batches themselves."""

    def map(self, function: Callable[..., Tensor], *others: Self) -> Self:
        """The batch with every tensor replaced by a function of it and of those in its place in `others`."""
        values: Any = self
        names = [field.name for field in fields(values)]
        return type(self)(*(_mapped(function, [getattr(one, name) for one in (self, *others)]) for name in names))

    def to(self, like: Tensor) -> Self:
        """The batch with every tensor `placed` where `like` is."""
        return self.map(lambda tensor: placed(tensor, like))

    def detach(self) -> Self:
        """The same, cut off from the graph."""
        return self.map(Tensor.detach)

    def tree(self) -> dict[str, Any]:
        """All tensors by the names of their fields, for a checkpoint."""
        values: Any = self
        own = {field.name: getattr(values, field.name) for field in fields(values)}
        return {name: value.tree() if isinstance(value, Batch) else value for name, value in own.items()}

    @classmethod
    def of(cls, tree: Mapping[str, Any]) -> Self:
        """The inverse of `tree`, also where tuples have become lists."""
        kinds, values = get_type_hints(cls), dict(tree)
        for name, value in tree.items():
            if isinstance(value, Mapping):
                values[name] = kinds[name].of(value)
            elif isinstance(value, list):
                values[name] = tuple(value)
        return cls(**values)

    def __getitem__(self, rows: Tensor | slice) -> Self:
        return self.map(lambda tensor: tensor[rows])

    def repeat(self, count: int) -> Self:
        """All rows `count` times over."""
        return self.map(lambda tensor: tensor.repeat(count, *[1] * (tensor.dim() - 1)))

    def joined(self, other: Self) -> Self:
        """The rows of this batch and, after them, those of another."""
        return self.map(lambda *pair: torch.cat(pair), other)

    def replaced(self, rows: Tensor, others: Self) -> Self:
        """The same with `others` in the place of `rows` (N,)."""
        return self.map(lambda a, b: a.index_copy(0, rows, b), others)

    def where(self, keep: Tensor, other: Self) -> Self:
        """The rows of this batch where `keep` (B,) holds, those of `other` in the rest."""
        return self.map(lambda a, b: torch.where(keep.reshape(-1, *[1] * (a.dim() - 1)), a, b), other)


def _mapped(function: Callable[..., Tensor], values: list[Any]) -> Any:
    if isinstance(values[0], Batch):
        return values[0].map(function, *values[1:])
    if isinstance(values[0], tuple):
        return tuple(function(*each) for each in zip(*values, strict=True))
    return function(*values)

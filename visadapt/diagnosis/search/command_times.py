"""Commands (T, n) at the stamps (T,), in s, of their rows, each held until the next row: moved in time."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from visadapt.recordings.command_clock import sent_by_clock

Move = Callable[[Tensor, Tensor], Tensor]
"""(commands (T, n), stamps (T,)) to the commands that act in the rows."""


def a_row_earlier(command: Tensor, stamps: Tensor) -> Tensor:
    """The commands, each a row earlier; the last stays."""
    return torch.cat((command[1:], command[-1:]))


def earlier(command: Tensor, stamps: Tensor, by: float) -> Tensor:
    """The commands, each earlier by so many seconds, up to a row: a row then holds the mean of its own and the next."""
    share = (by / stamps.diff()).clamp(max=1)[:, None]
    return torch.cat((torch.lerp(command[:-1], command[1:], share), command[-1:]))


def sent_until_next_row(command: Tensor, stamps: Tensor) -> Tensor:
    """The mean of what a controller sent until the next row, by a clock that is not that of the rows."""
    return torch.from_numpy(sent_by_clock(stamps.numpy(), command.numpy()))


def mean_until_next(command: Tensor, stamps: Tensor, rows: Tensor) -> Tensor:
    """(R, n) of the commands, the mean over time from each of some `rows` (R,) until the next."""
    held = torch.diff(stamps, append=stamps[-1:])
    total = torch.cat((torch.zeros_like(command[:1]), (held[:, None] * command).cumsum(0)))
    means = total[rows].diff(dim=0) / stamps[rows].diff()[:, None]
    return torch.cat((means, command[rows[-1:]]))

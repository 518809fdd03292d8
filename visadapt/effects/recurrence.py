"""Linear recurrences, as of motors that follow their commands, over all substeps at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def linear_recurrence(
    kept: Tensor,
    added: Tensor,
    compose: Callable[[Tensor, Tensor], Tensor] = torch.mul,
    apply: Callable[[Tensor, Tensor], Tensor] = torch.mul,
) -> tuple[Tensor, Tensor]:
    """y_k = kept_k y_(k-1) + added_k from y_0 = 0, and the products kept_k ... kept_1, for k = 1..S.

    In log2(S) rounds; `kept` (B, S, ...) and `added` (B, S, ...) have S on their second axis.

    Args:
        compose: the product of two of `kept`, by default element by element.
        apply: one of `kept` applied to a value.
    """
    spacing = 1
    while spacing < added.shape[1]:
        added = torch.cat((added[:, :spacing], added[:, spacing:] + apply(kept[:, spacing:], added[:, :-spacing])), 1)
        kept = torch.cat((kept[:, :spacing], compose(kept[:, spacing:], kept[:, :-spacing])), 1)
        spacing *= 2
    return added, kept

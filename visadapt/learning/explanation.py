"""What a diagnosis says of the gap between source and target, as the joint loop takes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from visadapt.effects import Effect
from visadapt.policies import Policy

Experiment = Callable[[Policy, int], Tensor | None]
"""From a policy and a number of steps, the commands (steps, n_action) to add to the policy's; None where none help."""


@dataclass(frozen=True)
class Explanation:
    """What a diagnosis says of the gap between source and target."""

    verdict: str
    effects: Sequence[Effect]
    """the causes that it names, at their found values"""
    complete: bool
    """whether they leave nothing for a residual to learn"""
    slight: frozenset[str] = frozenset()
    """names of those effects whose removal would reopen less than 1 % of the gap"""
    others: Sequence[Sequence[Effect]] = ()
    """the causes of each other explanation that fits as well"""
    nearest: str = ""
    """where the gap is unexplained, which effects come nearest to it, in words"""
    warnings: tuple[str, ...] = ()
    """of the recordings, and of the diagnosis"""
    experiment: Experiment | None = field(default=None, compare=False)
    """designs an excitation for the next round that tells causes apart; None unless other causes fit as well"""


NOT_DIAGNOSED = Explanation("", (), complete=False)

Explain = Callable[[Sequence[Path], Path], Explanation]
"""Diagnoses recordings of the target and writes the diagnosis to a file, or reads it where that exists."""

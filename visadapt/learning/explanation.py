"""What a diagnosis says of the gap between source and target, as the joint loop takes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from visadapt.effects import Effect
from visadapt.policies import Policy
from visadapt.recordings import Episode

Experiment = Callable[[Policy, int], Tensor | None]
"""What to add to a policy's commands over so many steps, (steps, n_action); None where nothing helps."""


@dataclass(frozen=True)
class Explanation:
    """What a diagnosis says of the gap between source and target."""

    verdict: str
    effects: Sequence[Effect]
    """the causes that it names, at their found values"""
    complete: bool
    """whether they leave nothing for a residual to learn"""
    experiment: Experiment | None = field(default=None, compare=False)
    """where other causes explain as much: designs what tells them apart in the next round"""


NOT_DIAGNOSED = Explanation("", (), complete=False)

Explain = Callable[[Sequence[Episode], Path], Explanation]
"""Diagnoses episodes of the target, or reads the diagnosis that is in the file."""

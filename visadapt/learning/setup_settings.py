"""How a policy is trained in the source and adapted to a target."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

from torch import Tensor

from visadapt.learning.grounding import GroundSettings
from visadapt.learning.perception import PerceptionSettings
from visadapt.learning.policy import TuneSettings


@dataclass(frozen=True)
class SetupSettings:
    """How a policy is trained and adapted."""

    source: TuneSettings
    """the policy in the source"""
    tuning: TuneSettings
    """the policy in the grounded source, in each round"""
    ground: GroundSettings = field(default_factory=GroundSettings)
    """the residual"""
    observations: str = "state"
    """what grounding shows the residual: one of `learning.windows.SOURCES`"""
    longest_episode: int = 250
    """steps of an episode of the target while data are collected"""
    feedforward: bool = True
    """begin with a policy that opposes what the residual expects; False where one command cannot undo it in a period"""
    trust: float = 1.0
    """share of the way to the tuned weights that the policy goes from those before the first round, where each round
    begins anew; 1: all of it, from those of the round before. The imagined target is not the real one"""
    refinement: TuneSettings | None = None
    """the policy in the source once more, after `source`: near rest, say, where what counts is decided"""
    named: TuneSettings | None = None
    """the policy in the source with effects that have names; without it, as `tuning`"""
    perception: PerceptionSettings | None = None
    """how an encoder learns to see, where the policy is shown frames"""

    def shortened(self, iterations: int) -> SetupSettings:
        """The same with so many iterations of the source policy, and at most as many of its refinement."""
        finer = self.refinement
        if finer is not None:
            finer = replace(finer, iterations=min(iterations, finer.iterations))
        return replace(self, source=replace(self.source, iterations=iterations), refinement=finer)

    @property
    def with_names(self) -> TuneSettings:
        """How the policy is tuned where all effects have names: they hold in every state, not in the recorded ones
        alone, as a residual does."""
        return replace(self.named or self.tuning, recorded=0.0)

    def numbers(self) -> dict[str, Any]:
        """All of them as JSON takes them, for a run's folder; a task's tensors, such as references, are left out."""
        return asdict(self, dict_factory=lambda each: {k: value for k, value in each if not isinstance(value, Tensor)})

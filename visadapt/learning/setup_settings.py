"""How a policy is trained in the source and adapted to a target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from torch import Tensor

from visadapt.learning.grounding import GroundSettings
from visadapt.learning.perception import PerceptionSettings
from visadapt.learning.tuning import TuneSettings


@dataclass(frozen=True)
class SetupSettings:
    """How a policy is trained and adapted."""

    source: TuneSettings
    """training of the policy in the source"""
    tuning: TuneSettings
    """tuning of the policy in the grounded source, in each round that `later` does not shorten"""
    ground: GroundSettings = field(default_factory=GroundSettings)
    """fit of the residual"""
    longest_episode: int = 250
    """most steps of an episode of the target while data are collected"""
    feedforward: bool = True
    """begin with a feed-forward that opposes the residual's correction; False where no one command can cancel it"""
    tunes_on: bool = False
    """a round tunes on from the weights of the round before; False: it begins with those before the first round"""
    later: int | None = None
    """iterations, at most those of `tuning` or `named`, of a round that tunes on because the policy of the round before
    costs less in the world of this round than the one before the first round; None: `tunes_on` alone decides"""
    refinement: TuneSettings | None = None
    """second training of the policy in the source, after `source`: near rest, say, where it is scored"""
    named: TuneSettings | None = None
    """tuning of the policy in the source with named effects and without a residual; None: as `tuning`"""
    perception: PerceptionSettings | None = None
    """training of the frame encoder, where the policy is shown frames"""

    def shortened(self, iterations: int) -> SetupSettings:
        """The same with `iterations` of the source policy's training, and at most as many of its refinement."""
        finer = self.refinement
        if finer is not None:
            finer = replace(finer, iterations=min(iterations, finer.iterations))
        return replace(self, source=replace(self.source, iterations=iterations), refinement=finer)

    @property
    def with_names(self) -> TuneSettings:
        """Settings of tuning in a source with named effects and no residual.

        No stream starts from a recorded state: named effects hold in every state, a residual only near recorded ones.
        """
        return replace(self.named or self.tuning, recorded=0.0)

    def with_tuning(self, change: Callable[[TuneSettings], TuneSettings]) -> SetupSettings:
        """The same with `change` applied to `tuning` and `named`."""
        return replace(self, tuning=change(self.tuning), named=self.named and change(self.named))

    def numbers(self) -> dict[str, Any]:
        """All of them as JSON takes them, for a run's folder; a task's tensors, such as references, are left out."""
        return asdict(self, dict_factory=lambda each: {k: value for k, value in each if not isinstance(value, Tensor)})

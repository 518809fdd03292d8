"""The verdict: which sets of effects the recording speaks for, whether they explain it all, and what else would do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from visadapt.diagnosis.search.search import ScoredModel, Search
from visadapt.diagnosis.search.unexplained import Function, functions
from visadapt.effects import Effect
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fit_states import Effects

WITHIN = 10.0
"""Log posterior odds that such a set may be behind the best."""

NOISE = 5.0
"""Log likelihood that process noise must add to a set to count as something unexplained, and what a set pays for it."""

SLIGHT = 0.05
"""Log likelihood left over, beside that which the best set brings, that is not worth the word unexplained."""

MASS = 0.93
"""Posterior probability that the members of a class hold between them."""


@dataclass(frozen=True)
class Weighed:
    """A set of effects and its posterior probability."""

    fitted: ScoredModel
    score: float
    """log posterior odds, what it leaves unexplained counted against it"""
    probability: float


@dataclass(frozen=True)
class ModelComparison:
    """What the search says."""

    weighed: list[Weighed]
    """the most probable first"""
    leftover: float
    """log likelihood that process noise adds to the best"""
    functions: list[Function]
    """of a black box beside the best"""
    classes: dict[type[Effect], list[Weighed]]
    """for each effect of the best set: the sets with another effect in its place that fit as well"""
    gained: float
    """log likelihood of the best beyond the source's"""
    function: float
    """log odds of a function from which on it counts as something unexplained"""

    @property
    def best(self) -> ScoredModel:
        """The most probable set."""
        return self.weighed[0].fitted

    @property
    def unexplained(self) -> bool:
        """Whether something is left that no set explains."""
        return self.leftover > NOISE or self.functions[0].evidence > self.function

    @property
    def slight(self) -> bool:
        """Whether what is left is little beside what the best set explains: a friction's rounded corner, say."""
        return max(self.leftover, self.functions[0].evidence) < SLIGHT * self.gained


def compare(search: Search) -> ModelComparison:
    """Weigh what a search has fitted."""
    close = [f for f in search.ranked if f.evidence > search.best.evidence - WITHIN][: search.profile.weighed]
    if all(f is not search.source for f in close):
        close.append(search.source)
    left = search.leftover(close)
    scores = [f.evidence - min(rest, NOISE) for f, rest in zip(close, left, strict=True)]
    mass = torch.tensor(scores, dtype=torch.float64).softmax(0).tolist()
    order = sorted(range(len(close)), key=lambda k: -scores[k])
    weighed = [Weighed(close[k], scores[k], mass[k]) for k in order]
    best = weighed[0].fitted
    model = CandidateModel(search.system, best.effects, search.rows)
    classes = {effect: _class(weighed, effect) for effect in best.effects}
    gained = float(best.fits.likelihood[0] - search.source.fits.likelihood[0])
    return ModelComparison(
        weighed, left[order[0]], functions(model, best.fits), classes, gained, search.profile.function
    )


def _class(weighed: Sequence[Weighed], effect: type[Effect]) -> list[Weighed]:
    """Sets that differ from the first by having another effect in the place of `effect`, and fit as well."""
    first = weighed[0]
    rest = {e for e in first.fitted.effects if e is not effect}
    rivals = []
    for other in weighed[1:]:
        if len(other.fitted.effects) == len(first.fitted.effects) and rest < set(other.fitted.effects):
            # More parameters that buy nothing only make the same thing with another name.
            more = other.fitted.fits.theta.shape[1] - first.fitted.fits.theta.shape[1]
            gained = float(other.fitted.fits.likelihood[0] - first.fitted.fits.likelihood[0])
            if more <= 0 or gained > more:
                rivals.append(other)
    whole = first.probability + sum(r.probability for r in rivals)
    held, members = first.probability, []
    for rival in rivals:
        if held >= MASS * whole:
            break
        members.append(rival)
        held += rival.probability
    return members


def exchanged(first: Effects, other: Effects) -> type[Effect]:
    """The one effect of `other` that `first` has not."""
    return next(e for e in other if e not in first)

"""Comparison of the fitted models: their probabilities, what the best leaves unexplained, and what fits as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from visadapt.diagnosis.search.fitted_models import MIN_LEFTOVER, ScoredModel, key_of
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.search.unexplained import CLEAR_LOG_ODDS, SmoothFunction, smooth_functions
from visadapt.effects import Effect
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.likelihood import FitState

COMPARE_WITHIN = 10.0  # Log posterior odds; models further behind the best are not compared

SLIGHT_SHARE = 0.05
"""Share of the best model's gain in log likelihood below which what it leaves unexplained is negligible."""

CLASS_PROBABILITY = 0.93
"""Alternatives to an effect are listed, the most probable first, until they and the best model together hold this share
of the probability of the best model and all its rivals without that effect."""


MIN_PROBABILITY = 0.3  # Of a model with two effects in the place of one, or one for two, to be an alternative


@dataclass(frozen=True)
class ComparedModel:
    """A fitted model and its posterior probability."""

    model: ScoredModel
    probability: float  # among the models compared; log odds are lowered by what process noise adds to the model


@dataclass(frozen=True)
class ModelComparison:
    """The models that were compared, and what the best leaves unexplained."""

    models: list[ComparedModel]  # the most probable first
    predicting: FitState
    """the best's fit from which predictions start: without process noise that the data do not need, which moves the
    states"""
    leftover: float  # log likelihood that process noise adds to the best
    functions: list[SmoothFunction]  # each added alone to the best, the largest log odds first
    alternatives: dict[type[Effect], list[ComparedModel]]
    """for each effect of the best: the models without it, with others in its place, that fit as well"""
    gained: float  # log likelihood of the best minus that of the source
    threshold: float  # log odds above which a function of a reading counts as something unexplained

    @property
    def best(self) -> ScoredModel:
        """The most probable model."""
        return self.models[0].model

    @property
    def unchanged(self) -> float:
        """Probability of the simulator as it stands."""
        return sum(one.probability for one in self.models if not one.model.effects)

    def unexplained(self, improvable: bool) -> bool:
        """Whether the best model leaves something unexplained; `improvable`: a black box beside it clearly predicts
        better on held-out episodes."""
        if improvable or self.leftover > MIN_LEFTOVER:
            return True
        # A load that improves no held-out prediction must be clear; errors of readings are not in the black box.
        for_load = max(self.threshold, CLEAR_LOG_ODDS)
        return any(each.log_odds > (self.threshold if each.of_reading else for_load) for each in self.functions)

    @property
    def misread(self) -> bool:
        """Whether a reading clearly has an error beyond the best model. Predictions may not show it: that of a velocity
        is fitted as noise where the positions are read too."""
        return any(each.of_reading and each.log_odds > CLEAR_LOG_ODDS for each in self.functions)

    @property
    def negligible(self) -> bool:
        """Whether what is unexplained is small against what the best model explains."""
        return max(self.leftover, self.functions[0].log_odds) < SLIGHT_SHARE * self.gained


def compare(search: Search) -> ModelComparison:
    """Compare the best models that a search has fitted, and the source."""
    close = _close(search)
    quiet = search.without_process_noise(close)
    close = [search.fitted[key_of(f.effects)] for f in close]  # some of which may now have a better fit
    models = _weighed(search, close, [each.left for each in quiet])
    best = models[0].model
    gained = float(best.fits.likelihood[0] - search.source.fits.likelihood[0])
    threshold = search.profile.smooth_function_threshold
    # The source, which is not refitted, is best only where it is close.
    alone = {f.names: each for f, each in zip(close, quiet, strict=True)}.get(best.names)
    left = alone.left if alone else 0.0
    predicting = alone.fits if alone and left <= MIN_LEFTOVER else best.fits
    model = CandidateModel(search.system, best.effects, search.rows)
    functions = smooth_functions(model, best.fits, predicting.state[0])
    return ModelComparison(models, predicting, left, functions, _alternatives_to(models), gained, threshold)


def compare_coloured(search: Search, white: ModelComparison) -> ModelComparison:
    """Compare the best models of a search with coloured noise; what is unexplained, the comparison with `white` noise
    says."""
    close = _close(search)
    models = _weighed(search, close, [0.0] * len(close))
    return replace(white, models=models, predicting=models[0].model.fits, alternatives=_alternatives_to(models))


def _close(search: Search) -> list[ScoredModel]:
    """The models that are compared, the most probable first."""
    close = [f for f in search.ranked if f.log_odds >= search.best.log_odds - COMPARE_WITHIN]
    return close[: search.profile.compared_models]


def _weighed(search: Search, close: Sequence[ScoredModel], leftover: Sequence[float]) -> list[ComparedModel]:
    """Models and the source with their probabilities, the most probable first; `leftover` is what process noise adds to
    the log likelihood of each."""
    scores = [f.log_odds - min(rest, MIN_LEFTOVER) for f, rest in zip(close, leftover, strict=True)]
    every = list(close)
    if all(f is not search.source for f in every):
        # So far behind that what process noise adds to it makes no difference.
        every.append(search.source)
        scores.append(search.source.log_odds)
    probabilities = torch.tensor(scores, dtype=torch.float64).softmax(0).tolist()
    return [ComparedModel(every[k], probabilities[k]) for k in sorted(range(len(every)), key=lambda k: -scores[k])]


def _alternatives_to(models: Sequence[ComparedModel]) -> dict[type[Effect], list[ComparedModel]]:
    """For each effect of the most probable model, the models that fit as well without it."""
    return {effect: _alternatives(models, effect) for effect in models[0].model.effects}


def _alternatives(models: Sequence[ComparedModel], effect: type[Effect]) -> list[ComparedModel]:
    """Models that have another effect in the place of `effect` of the first, and fit as well.

    Two may also stand for one, or one for two, as a slow periodic force does for a gust and a bias: where such a model
    is about as probable.
    """
    first = models[0]
    named = set(first.model.effects)
    rivals = []
    for other in models[1:]:
        gone, new = named - set(other.model.effects), set(other.model.effects) - named
        one_for_one = len(gone) == len(new) == 1
        with_two = {len(gone), len(new)} == {1, 2} and other.probability > MIN_PROBABILITY
        if effect in gone and (one_for_one or with_two):
            # More parameters but no gain only imitate the first under another name.
            more = other.model.fits.theta.shape[1] - first.model.fits.theta.shape[1]
            gained = float(other.model.fits.likelihood[0] - first.model.fits.likelihood[0])
            if more <= 0 or gained > more:
                rivals.append(other)
    whole = first.probability + sum(r.probability for r in rivals)
    reached, members = first.probability, []
    for rival in rivals:
        if reached >= CLASS_PROBABILITY * whole:
            break
        members.append(rival)
        reached += rival.probability
    return members

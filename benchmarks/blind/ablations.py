"""The parts of our diagnosis: on which recordings each acts, and the diagnosis without it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from visadapt.diagnosis.search import heldout, search
from visadapt.diagnosis.search.fitted_models import MIN_LEFTOVER, FittedModels, ScoredModel, less
from visadapt.diagnosis.search.model_comparison import ModelComparison
from visadapt.diagnosis.search.search import SMALL_SET, Exchanges, Search
from visadapt.estimation import iterated_smoother
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fit_states import QUICK, Effects
from visadapt.estimation.iterated_smoother import AddLoads
from visadapt.estimation.likelihood import FitState

EXPLORATION = import_module("visadapt.diagnosis.exploration")
"""The module; as an attribute of its package, the name is that of the function."""


@dataclass(frozen=True)
class Part:
    """A part of the diagnosis, by the function or method that does it."""

    owner: Any
    """module or class"""
    name: str
    without: Callable[..., Any]
    """what is called in its place in the diagnosis without the part"""
    acts: Callable[..., bool] = lambda *_: True
    """of what it returned, and its arguments: whether the diagnosis may be another without the part"""


@contextmanager
def without(part: str) -> Iterator[None]:
    """A context in which the diagnosis lacks a part, or all of TOGETHER."""
    with ExitStack() as stack:
        for one in parts_of(part):
            stack.enter_context(patch.object(PARTS[one].owner, PARTS[one].name, PARTS[one].without))
        yield


def parts_of(row: str) -> tuple[str, ...]:
    """The parts that are left out in a row of the table."""
    return TOGETHER if row == ALL_OF_THEM else (row,)


@contextmanager
def watched() -> Iterator[set[str]]:
    """A context that collects the names of the parts that act in it."""
    acting: set[str] = set()
    with ExitStack() as stack:
        for name, part in PARTS.items():
            stack.enter_context(patch.object(part.owner, part.name, _noting(name, part, acting)))
        yield acting


def _noting(name: str, part: Part, acting: set[str]) -> Callable[..., Any]:
    """The function of a part, which adds the part's name to `acting` where it acts."""
    function = getattr(part.owner, part.name)

    @wraps(function)
    def noting(*arguments: Any, **options: Any) -> Any:
        out = function(*arguments, **options)
        if part.acts(out, *arguments, **options):
            acting.add(name)
        return out

    return noting


def _nothing(*_: object, **__: object) -> None:
    pass


def _remove_only(self: Search, centre: ScoredModel, exchanged: Exchanges) -> None:
    self.fit([less(centre, [removed]) for removed in centre.effects], QUICK)


def _one_for_one_only(self: Search, centre: ScoredModel, exchanged: Exchanges) -> None:
    with patch.object(search, "_pairs", lambda effects: ()):
        _fit_neighbours(self, centre, exchanged)


def _fit_with_noise(self: Search, starts: Sequence[tuple[Effects, FitState]], effort: tuple[int, int]) -> None:
    self.fit(starts, effort)


def _smoothed_once(model: CandidateModel, fits: FitState, add_loads: AddLoads | None) -> Tensor:
    """The states (W, T, n) after one linear step."""
    with patch.object(iterated_smoother, "LARGEST_UNVERIFIED", math.inf):
        return iterated_smoother.smoothed_states(model, fits, add_loads)


def _verifies(out: Tensor, *given: Any) -> bool:
    """Whether further steps were taken."""
    return not torch.equal(out, _smoothed_once(*given))


def _by_noise_and_black_box(self: ModelComparison, improvable: bool) -> bool:
    return improvable or self.leftover > MIN_LEFTOVER


_fit_neighbours = Search._fit_neighbours

PARTS = {
    "no further where all is explained": Part(FittedModels, "explains_all", lambda *_: False, lambda out, *_: out),
    "every effect alone": Part(Search, "_alone", lambda _: [], lambda out, _: bool(out)),
    "exchanges": Part(Search, "_fit_neighbours", _remove_only, lambda _, self, centre, made: bool(centre.effects)),
    "two for one": Part(
        Search,
        "_fit_neighbours",
        _one_for_one_only,
        lambda _, self, centre, made: 2 <= len(centre.effects) <= SMALL_SET,
    ),
    "careful fits": Part(Search, "_polish", _nothing),
    "starts without process noise": Part(Search, "_fit_from_quiet", _fit_with_noise),
    "fits at rest": Part(
        FittedModels, "_at_rest", lambda _, found: found.fits, lambda out, _, found: out is not found.fits
    ),
    "verified states": Part(heldout, "smoothed_states", _smoothed_once, _verifies),
    "late sensors": Part(Search, "_fit_late", _nothing, lambda _, self, bases: bool(bases)),
    "phases of episodes": Part(Search, "_phases_of_episodes", _nothing),
    "jumps": Part(EXPLORATION, "with_jumps", _nothing, lambda out, _: out is not None),
    "coloured noise": Part(
        EXPLORATION,
        "with_coloured_noise",
        lambda found, compared, *_: (found, compared),
        lambda out, found, *_: out[0] is not found,
    ),
    "black box": Part(heldout, "predicts_better", lambda *_: False, lambda out, *_: out),
    "smooth functions": Part(
        ModelComparison,
        "unexplained",
        _by_noise_and_black_box,
        lambda out, self, improvable: out != _by_noise_and_black_box(self, improvable),
    ),
}
"""What may be left out, by the name of the row in the table."""

TOGETHER = (
    "every effect alone",
    "exchanges",
    "starts without process noise",
    "phases of episodes",
)
ALL_OF_THEM = "all but growth, removal and careful fits"
"""The row of a search without any of TOGETHER: effects are added to the best sets and removed, and the best sets fitted
carefully."""

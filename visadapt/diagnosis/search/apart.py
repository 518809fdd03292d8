"""Recordings that are explained one by one, but not together: the machine was changed between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from visadapt.diagnosis.search.fitted_models import ScoredModel
from visadapt.diagnosis.search.search import Search
from visadapt.effects import Effect
from visadapt.estimation.segments import Segments
from visadapt.progress import Report, staged
from visadapt.recordings.episode import file_of

MOST_RECORDINGS = 8  # that are explained one by one

MIN_LOG_ODDS = 10.0  # By which they must be likelier so than together: each then pays for effects of its own


@dataclass(frozen=True)
class ExplainedAlone:
    """One recording of several, and the set of effects that explains it by itself."""

    source: str  # its file
    best: ScoredModel


def explained_apart(
    search: Search, catalogue: Sequence[type[Effect]], sources: Sequence[str], progress: Report | None = None
) -> tuple[ExplainedAlone, ...]:
    """What explains each recording by itself, where that is everything and is likelier than the best set of a search in
    all of them together; else nothing.

    Args:
        catalogue: the effects that are searched.
        sources: of each episode (`Recording.sources`); those of a file are one recording. The first recording that is
            not explained by itself ends the attempt.
    """
    files = windows_by_file(search.rows, sources)
    if not 1 < len(files) <= MOST_RECORDINGS:
        return ()
    out = []
    for name, windows in files.items():
        alone = Search(search.system, search.rows.select(windows), catalogue, jobs=search.jobs)
        alone.run(staged(progress, f"search in {name} alone"))
        if not alone.explains_all(alone.best):
            return ()
        out.append(ExplainedAlone(name, alone.best))
    likelier = sum(one.best.log_odds for one in out) - search.best.log_odds
    return tuple(out) if likelier > MIN_LOG_ODDS else ()


def windows_by_file(rows: Segments, sources: Sequence[str]) -> dict[str, Tensor]:
    """Which windows are of each file, in the order of the files; `sources` are those of each episode."""
    files: dict[str, list[int]] = {}
    for window, episode in enumerate(rows.episode.tolist()):
        files.setdefault(file_of(sources[episode]), []).append(window)
    return {name: torch.tensor(windows) for name, windows in files.items()}

"""The report of a diagnosis: one self-contained HTML page."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

from visadapt.diagnosis.report import figures, film, text
from visadapt.diagnosis.result import Diagnosis
from visadapt.effects import EFFECTS
from visadapt.storage.atomic_files import replacing
from visadapt.systems import system_named


def write_report(path: str | os.PathLike[str], diagnosis: Diagnosis, settings: Mapping[str, str]) -> None:
    """Write the page, atomically; `settings` for its foot are what the diagnosis depends on (files, seed, versions).

    Raises:
        DiskFullError: the disk is full; an earlier file at `path` is kept.
    """
    page = as_html(diagnosis, settings)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def as_html(diagnosis: Diagnosis, settings: Mapping[str, str]) -> str:
    """The page: no external resources, and a script for the frames of a film alone; light or dark as the browser
    prefers."""
    gaps = _gaps(diagnosis)
    return text.rendered(
        "page.html",
        diagnosis,
        gaps=gaps,
        largest=max((value for _, value, _ in gaps if math.isfinite(value)), default=0.0),
        equations={name: effect.equation for name, effect in EFFECTS.items()},
        figures=_figures(diagnosis),
        film=film.shown(diagnosis.figures.film) if diagnosis.figures.film else None,
        settings=settings,
    )


def _gaps(diagnosis: Diagnosis) -> list[tuple[str, float, str]]:
    """Bars of the errors: name, error, CSS class."""
    gap = diagnosis.gap
    rows = [("simulator", gap.before, "before")]
    if gap.after != gap.before:
        rows.append((text.corrected(diagnosis), gap.after, "after"))
    return [*rows, ("with a black box", gap.black_box, "black-box"), ("measurement noise", gap.floor, "floor")]


def _figures(diagnosis: Diagnosis) -> dict[str, Any]:
    data, system = diagnosis.figures, system_named(diagnosis.system)
    corrected = bool(diagnosis.causes)
    return {
        "predictions": [figures.prediction(one, diagnosis.recording, system, corrected) for one in data.predictions],
        "profiles": [figures.profile(one, diagnosis.where.regions, corrected) for one in data.profiles],
        "growth": figures.growth(data.growth, corrected) if data.growth else "",
        "spectrum": figures.spectrum(data.spectrum, corrected) if data.spectrum else "",
    }

"""The tables of the blind check: shares with Wilson intervals, medians, calibration, and confusion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.blind.scoring import Answer, Score, Truth, classes
from experiments.result_tables import write_csv
from visadapt.confidence import wilson

STRENGTH_EDGES = (0.0, 1.0, 1.5, 2.5, 4.0, 8.0, 15.0, np.inf)
"""edges of the bins of strength"""
PROBABILITY_EDGES = (0.0, 0.5, 0.7, 0.9, 0.97, 1.0)
"""edges of the bins of probability"""


Share = Callable[[str, Iterable[bool | None]], None]
Number = Callable[[str, float, int], None]


@dataclass(frozen=True)
class Row:
    """One measure of one diagnoser on one set."""

    kind: str
    """a set of the cart-pole, or a vehicle"""
    diagnoser: str
    measure: str
    """what is measured; docs/results.md explains it"""
    value: float
    low: float
    """Wilson's 95 % for shares; the quartiles for medians; empty otherwise"""
    high: float
    n: int
    """number of recordings, parameters or intervals"""


def tabulate(kind: str, diagnoser: str, scores: Sequence[Score], seconds: Sequence[float]) -> list[Row]:
    """All measures of one diagnoser on one set."""
    rows: list[Row] = []

    def share(measure: str, hits: Iterable[bool | None]) -> None:
        known = [hit for hit in hits if hit is not None]
        if known:
            value = sum(known) / len(known)
            rows.append(Row(kind, diagnoser, measure, value, *wilson(sum(known), len(known)), len(known)))

    def middle(measure: str, values: Sequence[float]) -> None:
        if len(values):
            low, median, high = np.percentile(values, (25, 50, 75))
            rows.append(Row(kind, diagnoser, measure, float(median), float(low), float(high), len(values)))

    def number(measure: str, value: float, n: int) -> None:
        rows.append(Row(kind, diagnoser, measure, value, np.nan, np.nan, n))

    def of(mixture: str) -> list[Score]:
        return [s for s in scores if s.kind == mixture]

    share("single: named, nothing else", [s.exact for s in of("single")])
    share("single: among the named", [s.found for s in of("single")])
    share("single: stage right", [s.stage for s in of("single")])
    share("single: in the first three", [s.top3 for s in of("single")])
    share("pair: both named", [s.found for s in of("pair")])
    share("pair: both named, nothing else", [s.exact for s in of("pair")])
    share("pair: stages right", [s.stage for s in of("pair")])
    share("pair: in the first three", [s.top3 for s in of("pair")])
    share("triple: all named", [s.found for s in of("triple")])
    share("triple: all named, nothing else", [s.exact for s in of("triple")])
    share("none: no_gap", [s.verdict == "no_gap" for s in of("none")])
    share("none: something named", [s.verdict in ("identified", "ambiguous") for s in of("none")])
    share("foreign: unexplained", [s.verdict == "unexplained" for s in of("foreign")])
    share("foreign: something named", [s.verdict in ("identified", "ambiguous") for s in of("foreign")])
    share("named gap: no_gap", [s.verdict == "no_gap" for s in scores if s.exact is not None])
    share("named gap: unexplained", [s.verdict == "unexplained" for s in scores if s.exact is not None])
    share("nobody pushed: push named", [s.pushed for s in scores])
    share("ambiguous", [s.verdict == "ambiguous" for s in scores])
    middle("parameter error, relative", [e for s in scores for e in s.errors])
    middle("parameter error, relative to the change", [e for s in scores for e in s.deviations])
    share("coverage of 90 % intervals", [c for s in scores for c in s.covered])
    closed = [s.closed for s in scores if s.closed is not None]
    middle("closed where identified, median", closed)
    if closed:
        number("closed where identified, mean", float(np.mean(closed)), len(closed))
    overlaps = [o for s in scores for o in s.overlaps]
    middle("region overlap, median", overlaps)
    if overlaps:
        number("region overlap, mean", float(np.mean(overlaps)), len(overlaps))
    for low, high in pairwise(STRENGTH_EDGES):
        inside = [s for s in scores if s.strength is not None and low <= s.strength < high]
        strength = f"strength {low:g} to {high:g}"
        share(f"single: named, nothing else, {strength}", [s.exact for s in inside if s.kind == "single"])
        unexplained = [s.verdict == "unexplained" for s in inside if s.kind == "foreign"]
        share(f"foreign: unexplained, {strength}", unexplained)
    _calibration(scores, share, number)
    middle("seconds", seconds)
    share("failed", [s.verdict == "failed" for s in scores])
    return rows


def _calibration(scores: Sequence[Score], share: Share, number: Number) -> None:
    """Brier score and expected calibration error of the first set's probability, and the share of right ones by bin.

    Brier: mean (p - right)^2. ECE: sum over bins of their share times |mean p - share right|. Foreign recordings,
    which have no right set, are left out.
    """
    stated = np.array([(s.probability, s.first_right) for s in scores if s.probability is not None], float)
    if not len(stated):
        return
    probability, right = stated.T
    number("Brier score", float(np.mean((probability - right) ** 2)), len(stated))
    bins = np.clip(np.digitize(probability, PROBABILITY_EDGES) - 1, 0, len(PROBABILITY_EDGES) - 2)
    error = sum(abs(float((probability - right)[bins == b].sum())) for b in set(bins)) / len(stated)
    number("expected calibration error", error, len(stated))
    for b, (low, high) in enumerate(pairwise(PROBABILITY_EDGES)):
        share(f"right where probability {low:g} to {high:g}", [bool(hit) for hit in right[bins == b]])


def label(answer: Answer) -> str:
    """A short form of an answer: its classes, or its verdict."""
    groups = classes(answer)
    return " + ".join(sorted("/".join(sorted(group)) for group in groups)) if groups else str(answer["verdict"])


def confusion(kind: str, diagnoser: str, pairs: Iterable[tuple[Truth, Answer]]) -> list[dict[str, str | int]]:
    """Counts of answers by truth, for singles, none and foreign recordings, the most frequent first."""
    counts: Counter[tuple[str, str]] = Counter()
    for truth, answer in pairs:
        if truth.kind == "none" or len(truth.effects) == 1:
            name = next(iter(truth.effects), "nothing")
            counts[f"foreign: {name}" if truth.kind == "foreign" else name, label(answer)] += 1
    return [
        {"kind": kind, "diagnoser": diagnoser, "truth": truth, "answer": said, "count": count}
        for (truth, said), count in sorted(counts.items(), key=lambda item: (item[0][0], -item[1], item[0][1]))
    ]


def write_table(path: Path, rows: Sequence[Row], others: Iterable[dict[str, str]]) -> None:
    """Write the rows after the lines that are kept; numbers to four digits, empty where not applicable."""
    shown = [
        {name: _shown(value) if isinstance(value, float) else value for name, value in asdict(row).items()}
        for row in rows
    ]
    write_csv(path, [field.name for field in fields(Row)], [*others, *shown])


def _shown(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.4g}"

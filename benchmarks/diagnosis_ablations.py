"""What each part of the diagnosis is worth: the blind check with one part left out at a time.

    python -m benchmarks.diagnosis_ablations
    python -m benchmarks.diagnosis_ablations --kinds large --count 20 --parts exchanges "two for one"

On a draw for development, not a sealed one, since what a part does here decides whether it is kept. On a recording on
which a part does not act, the answer is that of the whole diagnosis. Every answer is appended to a log: interrupt it
anywhere, and started again, it goes on. Rows of other sets and parts stay in the table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.blind.ablations import ALL_OF_THEM, PARTS, parts_of
from benchmarks.blind.diagnosis import (
    FAILED,
    WATCHED,
    Kind,
    Settings as Check,
    read_key,
    recordings_in,
    recordings_of,
    run_one,
)
from benchmarks.blind.scoring import Truth, score
from datasets.blind.kinds import Effects
from experiments.result_tables import read_rows, write_csv

WHOLE = "as shipped"
COLUMNS = (
    "kind",
    "without",
    "acts",  # recordings on which the part acts
    "named_right",  # recordings of named effects, all named and nothing else
    "named",
    "none_right",  # recordings without an effect, said to have no gap
    "none",
    "foreign_right",  # recordings of foreign effects, said to be unexplained
    "foreign",
    "covered",  # 90 % intervals that hold the truth
    "intervals",
    "seconds",  # CPU time of a recording on which the part acts, mean
    "seconds_whole",  # the same of the whole diagnosis, on these
)


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    kinds: tuple[Kind, ...] = ("hard",)
    """sets of the cart-pole"""
    count: int = 40
    """recordings of each set"""
    seed: int = 5001
    """seed of the recordings"""
    effects: Effects = "core"
    """what the recordings are drawn from"""
    parts: tuple[str, ...] = (*PARTS, ALL_OF_THEM)
    """what is left out"""
    jobs: int = 2
    """recordings diagnosed at once, one core each"""
    work: Path = Path("runs/diagnosis_ablations")
    """folder for the answers"""
    out: Path = Path("results/ablations_diagnosis.csv")


Lines = Mapping[str, Mapping[str, Any]]


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    rows = []
    for kind in settings.kinds:
        check = Check(kinds=(kind,), count=settings.count, seed=settings.seed, effects=settings.effects)
        label, folder = check.label(kind), recordings_of(check, kind)
        recordings, truths = recordings_in(folder), read_key(folder)
        logs = settings.work / folder.name
        whole = run_one(WATCHED, recordings, logs / "whole.jsonl", settings.jobs)
        rows.append(_row(label, WHOLE, truths, whole, whole))
        print(rows[-1])
        for part in settings.parts:
            acting = {one: whole[one.name].get("answer", FAILED).get("acting", ()) for one in recordings}
            acts = [one for one in recordings if {*parts_of(part)} & {*acting[one]}]
            lines = run_one(part, acts, logs / f"{part}.jsonl", settings.jobs)
            rows.append(_row(label, part, truths, whole, {one.name: lines[one.name] for one in acts}))
            print(rows[-1])
    run = {(row["kind"], row["without"]) for row in rows}
    others = read_rows(settings.out) if settings.out.exists() else []
    kept = [row for row in others if (row["kind"], row["without"]) not in run]
    write_csv(settings.out, COLUMNS, [*kept, *rows])


def _row(label: str, part: str, truths: Mapping[str, Truth], whole: Lines, acting: Lines) -> dict[str, object]:
    """A row of the table: the answers of `acting`, and those of the `whole` diagnosis to all other recordings."""
    scores = [score(truth, {**whole, **acting}[file].get("answer", FAILED)) for file, truth in truths.items()]
    named = [one.exact for one in scores if one.exact is not None]
    none = [one.verdict == "no_gap" for one in scores if one.kind == "none"]
    foreign = [one.verdict == "unexplained" for one in scores if one.kind == "foreign"]
    covered = [hit for one in scores for hit in one.covered]
    counts = [count for hits in (named, none, foreign, covered) for count in (sum(hits), len(hits))]
    seconds = [
        round(sum(lines[file]["seconds"] for file in acting) / max(1, len(acting)), 1) for lines in (acting, whole)
    ]
    return dict(zip(COLUMNS, [label, part, len(acting), *counts, *seconds], strict=True))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

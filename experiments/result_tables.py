"""The tables under results/: one row per measure, the same columns everywhere (docs/architecture.md)."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from visadapt.evaluation.scoring import CartPoleScore, FlightScore
from visadapt.storage.atomic_files import replacing

ACTION_TIME = "CPU time of an action"
"""A measure, of methods that control."""


@dataclass(frozen=True)
class Row:
    """One row. `samples` are counted target samples; None does not apply.

    `failed` episodes are counted apart: never in a mean of speeds, always in a mean of misses.
    """

    experiment: str
    system: str
    method: str
    domain: str
    """source, target or adapted"""
    samples: int | None
    measure: str
    unit: str
    mean: float
    std: float | None
    episodes: int | None
    failed: int
    seeds: int | None


def speed_row(
    experiment: str, method: str, domain: str, samples: int, scores: Sequence[CartPoleScore], system: str = "cartpole"
) -> Row:
    """Mean cart speed over the surviving episodes of all seeds (one CartPoleScore each), with its spread over them."""
    weights = np.array([score.survived for score in scores], float)
    means = np.array([score.mean_speed or 0.0 for score in scores])
    spreads = np.array([score.std_speed or 0.0 for score in scores])
    total = weights.sum()
    mean = float((weights * means).sum() / total) if total else float("nan")
    variance = float((weights * (spreads**2 + (means - mean) ** 2)).sum() / total) if total else float("nan")
    episodes = sum(score.episodes for score in scores)
    about = (experiment, system, method, domain, samples, "mean cart speed", "m/s")
    return Row(*about, round(mean, 4), round(variance**0.5, 4), episodes, episodes - int(total), len(scores))


def miss_row(
    experiment: str, system: str, method: str, domain: str, samples: int, measure: str, scores: Sequence[FlightScore]
) -> Row:
    """How far flights miss, over those of all seeds (one FlightScore each); one that failed is in the mean."""
    means = np.array([score.mean for score in scores])
    whole = bool(np.isfinite(means).all())
    variance = np.mean([score.std**2 for score in scores]) + means.var() if whole else np.inf
    about = (experiment, system, method, domain, samples, measure, "m")
    episodes, failed = sum(score.flights for score in scores), sum(score.failed for score in scores)
    return Row(*about, round(float(means.mean()), 5), round(float(np.sqrt(variance)), 5), episodes, failed, len(scores))


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows as CSV, whole or not at all."""
    write_csv(path, [field.name for field in fields(Row)], [asdict(row) for row in rows])


def write_csv(path: Path, columns: Sequence[str], lines: Iterable[Mapping[str, object]]) -> None:
    """Write a CSV, whole or not at all."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV as they stand there."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def print_speed(row: Row) -> None:
    """Print a row of speeds."""
    episodes = row.episodes or 0
    up = f"{episodes - row.failed} of {episodes} up"
    print(f"{row.domain:8} {row.samples:5} samples  {row.mean:.3f} +- {row.std:.3f} {row.unit}, {up}  ({row.method})")

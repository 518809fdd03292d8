"""How well diagnosers name a hidden gap: blind recordings, sealed answers.

    python -m benchmarks.blind.diagnosis --count 200 --seed 7 --jobs 2 --diagnosers ours afternoon greedy refit chance

    python -m benchmarks.blind.diagnosis --system quadrotor --count 30 --seed 7

Makes the recordings with datasets.blind.gaps or datasets.blind.flights unless they exist, gives every diagnoser the
path of one CSV at a time, and opens the key only for scoring. Every answer is appended to a log, so that an interrupted
run resumes; with --data, recordings made elsewhere are scored. Writes results/blind_diagnosis.csv (one row per set,
diagnoser and measure) and results/blind_diagnosis_confusion.csv, in which rows of other diagnosers and sets are kept.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks.blind.ablations import ALL_OF_THEM, PARTS, watched, without
from benchmarks.blind.baselines import BASELINES, FLYING
from benchmarks.blind.flight_onestep import system_of
from benchmarks.blind.scoring import Answer, Score, Truth, score
from benchmarks.blind.tables import Row, confusion, label, tabulate, write_table
from datasets.blind import films as blind_films, flights as blind_flights, gaps as blind_gaps
from datasets.blind.kinds import Effects
from datasets.blind.scene import COLUMN, ROW, SCALE
from datasets.blind.table import ROWS
from experiments.result_tables import read_rows, write_csv

Kind = Literal["easy", "hard", "large", "rig", "table", "film_plain", "film_textured", "quadrotor", "fixed_wing"]
"""One of the sets of the cart-pole, or the set of a vehicle."""
System = Literal["cartpole", "quadrotor", "fixed_wing"]


@dataclass(frozen=True)
class Settings:
    """What is scored, and where files are."""

    system: System = "cartpole"
    """the system that is recorded; a vehicle has one set"""
    count: int = 200
    """recordings of each set; the table has its own count"""
    seed: int = 7
    """seed of the recordings"""
    kinds: tuple[Kind, ...] = ("easy", "hard")
    """which sets of the cart-pole; baselines diagnose no films"""
    effects: Effects = "core"
    """what the recordings are drawn from: the core of the catalogue, the rest of it, or all"""
    diagnosers: tuple[str, ...] = ("ours", *BASELINES)
    """the diagnosers to score"""
    jobs: int = 1
    """recordings diagnosed in parallel, one core each"""
    data: Path | None = None
    """folder of recordings made elsewhere, with <folder>.key.json beside it; --kinds then names its set"""
    work: Path = Path("runs/blind_diagnosis")
    """folder for the answers"""
    out: Path = Path("results/blind_diagnosis.csv")
    """table to write"""
    fresh: bool = False
    """discard the logged answers, after a change of the diagnoser"""
    wrong: int = 0
    """number of wrong answers of each diagnoser that are listed"""

    @property
    def sets(self) -> tuple[Kind, ...]:
        """The sets of the system."""
        return self.kinds if self.system == "cartpole" else (self.system,)

    def asked(self, kind: Kind) -> tuple[str, ...]:
        """Diagnosers that know the system, the effects and what is recorded: the baselines know the core alone."""
        known = DIAGNOSERS if self.system == "cartpole" else ("ours", *FLYING)
        alone = self.effects != "core" or kind in FILMS
        return tuple(name for name in self.diagnosers if name in (("ours",) if alone else known))

    def label(self, kind: Kind) -> str:
        """The name of a set in tables and folders."""
        return kind if self.effects == "core" else f"{kind}-{self.effects}"


FILMS: dict[Kind, blind_films.LookName] = {"film_plain": "plain", "film_textured": "textured"}
"""The look of each set of films."""


def ours(path: Path) -> Answer:
    """What the command `visadapt diagnose` writes, run in this process."""
    of_film = path.suffix == ".h5"
    seen_by = ["--system", "cartpole", "--renderer", str(renderer_of(path.parent))]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "answer.json"
        options = seen_by if of_film else ["--system", system_of(path)]
        _visadapt("diagnose", str(path), *options, "--json", str(out))
        answer: Answer = json.loads(out.read_text(encoding="utf-8"))
    return answer


def watched_ours(path: Path) -> Answer:
    """The same, and which of its parts acted."""
    with watched() as acting:
        answer = ours(path)
    return {**answer, "acting": sorted(acting)}


def ours_without(part: str, path: Path) -> Answer:
    """The same without one of its parts."""
    with without(part):
        return ours(path)


def _visadapt(*arguments: str) -> None:
    """The command `visadapt`, run in this process; raises RuntimeError with what it said where it fails."""
    # Imported here: a worker that runs a baseline need not load the command line.
    cli = importlib.import_module("visadapt.cli.main")
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        status = cli.main(list(arguments))
    if status != 0:
        raise RuntimeError(f"exit status {status}: {said.getvalue().strip()}")


def renderer_of(folder: Path) -> Path:
    """File of the renderer of a folder's films."""
    return folder.with_name(folder.name + ".renderer.safetensors")


WATCHED = "ours, watched"
DIAGNOSERS: dict[str, Callable[[Path], Answer]] = {
    "ours": ours,
    **BASELINES,
    WATCHED: watched_ours,
    **{part: partial(ours_without, part) for part in (*PARTS, ALL_OF_THEM)},
}
"""path of a CSV -> answer, by name"""


FAILED: Answer = {"verdict": "failed", "causes": [], "ranking": []}
"""replaces an answer that ended in an error; wrong whatever the truth"""


class Skipped(Exception):
    """A diagnoser cannot run here; the message says why."""


def diagnose_one(name: str, path: Path) -> dict[str, Any]:
    """A line of the log: the answer or the error, and its CPU seconds."""
    begun = time.process_time()
    line: dict[str, Any] = {"file": path.name, "sha256": fingerprint(path)}
    try:
        line["answer"] = DIAGNOSERS[name](path)
    except ModuleNotFoundError as error:
        raise Skipped(f"{name}: skipped, {error}") from error
    except Exception as error:
        # An error on one recording counts as failed and does not stop the others.
        line["error"] = f"{type(error).__name__}: {error}"
    line["seconds"] = round(time.process_time() - begun, 3)
    return line


def fingerprint(path: Path) -> str:
    """SHA-256 of a recording, and of a film's renderer, to check that a logged answer belongs to them."""
    renderer = renderer_of(path.parent).read_bytes() if path.suffix == ".h5" else b""
    return hashlib.sha256(path.read_bytes() + renderer).hexdigest()


def read_log(path: Path) -> dict[str, dict[str, Any]]:
    """The answers by file, without errors, which are retried, and without a last line cut off by an interrupt."""
    lines: dict[str, dict[str, Any]] = {}
    if path.exists():
        for text in path.read_text(encoding="utf-8").splitlines():
            try:
                line = json.loads(text)
            except json.JSONDecodeError:
                continue
            if "answer" in line:
                lines[line["file"]] = line
    return lines


def run_one(name: str, recordings: list[Path], log: Path, jobs: int) -> dict[str, dict[str, Any]]:
    """All answers of a diagnoser by file: those in the log, and new ones, which are appended to it at once."""
    prints = {path.name: fingerprint(path) for path in recordings}
    known = {file: line for file, line in read_log(log).items() if line["sha256"] == prints.get(file)}
    left = [path for path in recordings if path.name not in known]
    if left:
        log.parent.mkdir(parents=True, exist_ok=True)
        # Rewritten without an incomplete line, which would corrupt the next one.
        log.write_text("".join(json.dumps(line) + "\n" for line in known.values()), encoding="utf-8")
        with log.open("a", encoding="utf-8") as file:
            for line in _answers(name, left, jobs):
                file.write(json.dumps(line) + "\n")
                file.flush()
                known[line["file"]] = line
    return known


def _answers(name: str, left: list[Path], jobs: int) -> Iterator[dict[str, Any]]:
    if jobs == 1:
        yield from (diagnose_one(name, path) for path in left)
        return
    # One thread for torch and BLAS, as the processes share the cores; read when a process loads them.
    os.environ["OMP_NUM_THREADS"] = "1"
    with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(diagnose_one, name, path) for path in left]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def recordings_of(settings: Settings, kind: Kind) -> Path:
    """The folder of a set, made unless it exists and is complete."""
    if settings.data is not None:
        return settings.data
    count = len(ROWS) if kind == "table" else settings.count
    folder = Path("data/blind") / f"{settings.label(kind)}-{count}-{settings.seed}"
    if len(recordings_in(folder)) != count or not key_of(folder).exists():
        if kind == "film_plain" or kind == "film_textured":
            blind_films.main(blind_films.Settings(folder, FILMS[kind], count, settings.seed))
        elif kind == "quadrotor" or kind == "fixed_wing":
            blind_flights.main(blind_flights.Settings(folder, kind, count, settings.seed, effects=settings.effects))
        else:
            blind_gaps.main(blind_gaps.Settings(folder, kind, count, settings.seed, effects=settings.effects))
    if kind in FILMS and not renderer_of(folder).exists():
        film = str(blind_films.calibration_path(folder))
        guess = f"{COLUMN + 2:.0f},{ROW - 2:.0f}", f"{SCALE + 1:.0f}"
        _visadapt("renderer", film, "--hinge", guess[0], "--scale", guess[1], "--out", str(renderer_of(folder)))
    return folder


def recordings_in(folder: Path) -> list[Path]:
    """The recordings of a folder, in order."""
    return sorted(path for path in folder.glob("*") if path.suffix in (".csv", ".h5"))


def key_of(folder: Path) -> Path:
    """File of the key of a folder."""
    return folder.with_name(folder.name + ".key.json")


def read_key(folder: Path) -> dict[str, Truth]:
    """The answers by file."""
    key = json.loads(key_of(folder).read_text(encoding="utf-8"))
    return {recording["file"]: Truth.of(recording) for recording in key["recordings"]}


def show_wrong(name: str, judged: list[tuple[str, Truth, Answer, Score]], most: int) -> None:
    """List wrong answers beside the truth."""
    right = {"none": "no_gap", "foreign": "unexplained"}
    wrong = [j for j in judged if not (j[3].exact if j[3].exact is not None else j[3].verdict == right[j[3].kind])]
    for file, truth, answer, _ in wrong[:most]:
        parts = [
            f"{effect} (strength {truth.strengths[effect]:.1f}, "
            + ", ".join(f"{parameter} {value:.4g}" for parameter, value in parameters.items())
            + ")"
            for effect, parameters in truth.effects.items()
        ]
        print(f"  {name} {file}: {truth.kind}: {' + '.join(parts) or 'nothing'} | said {label(answer)}")


def main(settings: Settings) -> None:
    """Run, score, print and write."""
    if unknown := set(settings.diagnosers) - DIAGNOSERS.keys():
        raise SystemExit(f"no such diagnoser: {', '.join(sorted(unknown))}; there are {', '.join(DIAGNOSERS)}")
    if settings.data is not None and len(settings.sets) != 1:
        raise SystemExit("--data is one set: say which with --kinds easy or --kinds hard")
    rows: list[Row] = []
    taken: list[dict[str, str | int]] = []
    for kind in settings.sets:
        folder = recordings_of(settings, kind)
        recordings = recordings_in(folder)
        for name in settings.asked(kind):
            log = settings.work / folder.name / f"{name}.jsonl"
            if settings.fresh:
                log.unlink(missing_ok=True)
            try:
                lines = run_one(name, recordings, log, settings.jobs)
            except Skipped as reason:
                print(reason)
                continue
            truths = read_key(folder)
            answers = {path.name: lines[path.name].get("answer", FAILED) for path in recordings}
            judged = [(file, truths[file], answer, score(truths[file], answer)) for file, answer in answers.items()]
            seconds = [lines[path.name]["seconds"] for path in recordings]
            own = tabulate(settings.label(kind), name, [j[3] for j in judged], seconds)
            taken += confusion(settings.label(kind), name, [(j[1], j[2]) for j in judged])
            rows += own
            for row in own:
                print(f"{kind} {name:10s} {row.measure:50s} {row.value:8.3f} [{row.low:.3f}, {row.high:.3f}] n={row.n}")
            show_wrong(name, judged, settings.wrong)
    write(settings.out, rows, taken)


def write(out: Path, rows: list[Row], taken: list[dict[str, str | int]]) -> None:
    """Write both tables; rows of other sets and diagnosers are kept."""
    run = {(row.kind, row.diagnoser) for row in rows}

    def others(path: Path) -> list[dict[str, Any]]:
        lines = read_rows(path) if path.exists() else []
        return [line for line in lines if (line["kind"], line["diagnoser"]) not in run]

    if rows:
        write_table(out, rows, others(out))
        beside = out.with_name(f"{out.stem}_confusion.csv")
        write_csv(beside, ("kind", "diagnoser", "truth", "answer", "count"), [*others(beside), *taken])


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

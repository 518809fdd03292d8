"""What else one could use, on the same task, cost, inputs, starts and budgets as ours (`--episodes`: of every score).

    python -m benchmarks.baselines [--baselines ppo mpc] [--smoke]
    python -m benchmarks.baselines --baselines mpc ppo pets --experiments 'quadrotor, drag' 'fixed wing, drag' \
        --out results/baselines_flight.csv --picture assets/baselines_flight.png
    python -m benchmarks.baselines --baselines mpc mpc_pixels ppo --experiments 'CartPole, pixels, 2(sin t + 1) N' \
        --out results/baselines_frames.csv --picture runs/baselines_frames.png

CartPole from states under hidden effects (`cartpole`) and from frames (`frames`), and the vehicles under drag
(`flights`); ours of the last two is in `benchmarks.cartpole_pixels` and `benchmarks.flight`. Each baseline is scored in
the source, in the target before it has seen any of it, and after 50 to 1,000 counted samples, on vehicles after every
round; PPO up to 200,000. The CPU time of one action is measured over an episode of a single machine, on one thread.

Writes results/baselines.csv and assets/baselines.png. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from benchmarks.baselines.cartpole import CARTPOLES, CartPoleProblem, source_policy
from benchmarks.baselines.flights import FLIGHTS
from benchmarks.baselines.frames import FRAMES
from benchmarks.baselines.problem import SMOKE, Problem, Sizes, score_path
from experiments.curves import Chart, plot_charts
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import ACTION_TIME, Row, read_rows, write_rows
from visadapt.policies import Policy
from visadapt.storage.run_folder import open_run, read_json, write_json
from visadapt.targets import Target
from visadapt.targets.rollout import run

BASELINES = {
    "ours": "ours, residual",
    "diagnosed": "ours, diagnosed",
    "mpc": "MPC, residual",
    "mpc_pixels": "MPC in image space, residual",
    "mppi": "MPPI, residual",
    "pets": "PETS",
    "ppo": "PPO",
    "observer": "disturbance observer",
    "randomised": "domain randomisation",
}
"""Module of this room: method in the table"""
PROBLEMS: dict[str, Problem] = {problem.name: problem for problem in (*CARTPOLES, *FRAMES, *FLIGHTS)}
ACTION, DONE = "action.json", "done.json"
SMOKE_STEPS = 10
"""of an episode that is scored, where the numbers mean nothing"""


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 1
    baselines: tuple[str, ...] = tuple(BASELINES)
    """which of BASELINES are run; all that is done is tabled"""
    experiments: tuple[str, ...] = tuple(PROBLEMS)[:2]
    """which of PROBLEMS are run"""
    episodes: int = 100
    """of a score"""
    smoke: bool = False
    """see that all runs; the numbers mean nothing"""
    jobs: Jobs = 2
    """of (baseline, experiment, seed) at once, one core each"""
    work: Path = Path("runs/baselines")
    out: Path = Path("results/baselines.csv")
    picture: Path = Path("assets/baselines.png")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    for name in settings.baselines:
        module_of(name)
    if unknown := sorted(set(settings.experiments) - set(PROBLEMS)):
        raise SystemExit(f"no such experiment: {', '.join(unknown)}; there are {'; '.join(PROBLEMS)}")
    seeds = range(settings.seeds)
    jobs = []
    for experiment in settings.experiments:
        written = PROBLEMS[experiment].baselines
        if not (chosen := [name for name in settings.baselines if name in written]):
            raise SystemExit(
                f"{experiment}: the baselines are {', '.join(written)}, not {', '.join(settings.baselines)}"
            )
        jobs += [(name, experiment, seed) for seed in seeds for name in chosen]
    carts = [(experiment, seed) for name, experiment, seed in jobs if "ours" in PROBLEMS[experiment].baselines]
    sources = {(PROBLEMS[experiment].with_history, seed): experiment for experiment, seed in carts}
    in_processes(_source, settings, [(experiment, seed) for (_, seed), experiment in sources.items()])
    in_processes(_scores, settings, jobs)
    rows = [
        row
        for experiment in settings.experiments
        for name, method in BASELINES.items()
        for row in _rows(experiment, method, [_folder(settings, name, experiment, seed) for seed in seeds])
    ]
    write_rows(settings.out, rows)
    _draw(settings)
    for row in rows:
        counted = "" if row.measure == ACTION_TIME else f"{row.domain} {row.samples} samples, {row.failed} failed"
        print(f"{row.experiment:40}{row.method:24} {row.mean:8.3f} +- {row.std:.3f} {row.unit}  {counted}")


def _rows(experiment: str, method: str, folders: Sequence[Path]) -> list[Row]:
    """The rows of a method, of the scores that its seeds have left in their folders so far."""
    found: dict[tuple[str, int], list[Path]] = {}
    for path in sorted(path for folder in folders for path in folder.glob("score-*.json")):
        _, domain, samples = path.stem.split("-")
        found.setdefault((domain, int(samples)), []).append(path)
    order = sorted(found, key=lambda key: (key[0] == "adapted", key[0] == "target", key[1]))
    problem = PROBLEMS[experiment]
    rows = [problem.row(method, domain, samples, found[domain, samples]) for domain, samples in order]
    timed = [read_json(path) for folder in folders if (path := folder / ACTION).exists()]
    if timed:
        times = [each["ms"] for each in timed]
        about = {"domain": timed[0]["domain"], "samples": timed[0]["samples"], "episodes": len(times), "failed": 0}
        mean, std = round(statistics.mean(times), 4), round(statistics.pstdev(times), 4)
        counted = replace(rows[-1], measure=ACTION_TIME, unit="ms", mean=mean, std=std, seeds=len(times))
        rows.append(replace(counted, **about))
    return rows


def _draw(settings: Settings) -> None:
    """Scores over samples; what takes no samples is drawn level."""
    rows = [row for row in read_rows(settings.out) if row["measure"] != ACTION_TIME]
    charts = []
    for experiment in dict.fromkeys(row["experiment"] for row in rows):
        own = [row for row in rows if row["experiment"] == experiment]
        adapted = [row for row in own if row["domain"] == "adapted"]
        ends = [min((int(row["samples"]) for row in adapted), default=50), 1000]
        learning = {row["method"] for row in adapted}
        still = [row for row in own if row["domain"] == "target" and row["method"] not in learning]
        level = [{**row, "samples": end} for row in still for end in ends]
        charts.append(Chart(experiment, f"{own[0]['measure']}, {own[0]['unit']}", [*adapted, *level]))
    plot_charts(settings.picture, charts, columns=min(len(charts), 2))


def _source(settings: Settings, experiment: str, seed: int) -> None:
    torch.set_num_threads(1)
    problem = PROBLEMS[experiment]
    assert isinstance(problem, CartPoleProblem)
    source_policy(problem, _sizes(settings, problem), settings.work, seed)


def _scores(settings: Settings, name: str, experiment: str, seed: int) -> None:
    """Leave the scores of a job in its folder, and the time of an action of the last policy that was scored."""
    torch.set_num_threads(1)
    problem, steps = PROBLEMS[experiment], SMOKE_STEPS if settings.smoke else None
    sizes = _sizes(settings, problem)
    folder = _folder(settings, name, experiment, seed)
    open_run(folder, {"seed": seed, **asdict(sizes)})
    if (folder / DONE).exists():
        return
    for stage in module_of(name).stages(problem, sizes, folder, seed):
        path, where = score_path(folder, stage), problem.scored(stage.domain)
        found = kept_score(path, stage.policy, where, sizes.episodes, steps)
        about = {"domain": stage.domain, "samples": stage.samples}
        write_json(folder / ACTION, {**about, "ms": action_time(stage.policy, problem.target(), steps or 50)})
        print(f"{name}, {problem.name}, seed {seed}, {stage.domain} {stage.samples}: {found}", flush=True)
    write_json(folder / DONE, {"done": True})


def action_time(policy: Policy, target: Target, steps: int) -> float:
    """Median CPU time in ms of one of `steps` actions of `policy`, one machine at a time, on this thread."""
    times, act = [], policy.act

    def timed(history: Any) -> torch.Tensor:
        began = time.thread_time()
        action = act(history)
        times.append(1000 * (time.thread_time() - began))
        return action

    policy.act = timed  # type: ignore[method-assign]
    try:
        run(target, policy, 1, steps, torch.Generator().manual_seed(0), strict=False)
    finally:
        policy.act = act  # type: ignore[method-assign]
    return statistics.median(times)


def _sizes(settings: Settings, problem: Problem) -> Sizes:
    return SMOKE if settings.smoke else replace(problem.sizes, episodes=settings.episodes)


def _folder(settings: Settings, name: str, experiment: str, seed: int) -> Path:
    """Where a job keeps what it makes."""
    return settings.work / name / "".join(c if c.isalnum() else "-" for c in experiment) / f"seed-{seed}"


def module_of(name: str) -> Any:
    """The module of a baseline; ends with one line where it, or its library, is missing."""
    if name not in BASELINES:
        raise SystemExit(f"no such baseline: {name}; there are {', '.join(BASELINES)}")
    try:
        return import_module(f"benchmarks.baselines.{name}")
    except ModuleNotFoundError as error:
        raise SystemExit(f"{name} needs {error.name}: pip install 'visadapt[baselines]'") from error

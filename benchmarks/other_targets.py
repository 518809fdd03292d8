"""The CartPole's adaptation over counted samples, on targets other than the paper's.

    python -m benchmarks.other_targets
    python -m benchmarks.other_targets --shown states --out results/other_targets_states.csv

Each seed adapts the source policy anew: with 50 samples in one round, and in rounds of 100 up to 1,000. It is scored
as it stands after 50, 100, 200, 500 and 1,000 counted samples, on episodes whose starts no training saw. No score
chooses anything. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

from experiments.cartpole_targets import Shown, experiment, source, target, unadapted_score
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import print_speed, speed_row, write_rows
from visadapt.evaluation import CartPoleScore
from visadapt.storage.run_folder import open_run

NAMES = ("constant 2 N", "dry friction 4 N", "delay 0.05 s and 1 N", "gain 0.7", "pole twice as heavy")
METHOD = "ours"
PLANS = ((50, 50, (50,)), (1000, 100, (100, 200, 500, 1000)))
"""(budget, samples in a round, samples after which the policy is scored)"""


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    shown: Shown = "frames"
    """what the policy sees"""
    seeds: int = 3
    episodes: int = 100
    targets: tuple[str, ...] = NAMES
    """which of the targets of experiments/cartpole_targets.py"""
    jobs: Jobs = 2
    """adaptations at once, one core each"""
    work: Path = Path("runs/other_targets")
    out: Path = Path("results/other_targets.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    settings = replace(settings, work=settings.work / settings.shown)
    source(settings.shown, settings.work)  # trained here, once, where it is not shipped
    before = in_processes(unadapted_score, settings, [(name,) for name in settings.targets])
    jobs = [(name, seed) for name in settings.targets for seed in range(settings.seeds)]
    after = in_processes(_after, settings, jobs)
    rows = []
    for name in settings.targets:
        about = experiment(name, settings.shown)
        rows.append(speed_row(about, "unadapted", "target", 0, [before[(name,)]]))
        for samples in (samples for _, _, scored in PLANS for samples in scored):
            scores = [after[name, seed][samples] for seed in range(settings.seeds)]
            rows.append(speed_row(about, METHOD, "adapted", samples, scores))
    write_rows(settings.out, rows)
    for row in rows:
        print_speed(row)


def _after(settings: Settings, name: str, seed: int) -> dict[int, CartPoleScore]:
    """Scores of one seed, by samples."""
    torch.set_num_threads(1)
    setup, unadapted = source(settings.shown, settings.work)
    machine, folder = target(name, settings.shown), settings.work / name / f"seed-{seed}"
    about = {"shown": settings.shown, "seed": seed, "episodes": settings.episodes, "plans": PLANS}
    open_run(folder, {**about, **setup.settings.numbers()})
    scores = {}
    for budget, round_samples, scored in PLANS:
        policy = copy.deepcopy(unadapted)
        adapted = setup.adapt(policy, machine, folder / f"budget-{budget}", budget, round_samples, seed)
        for samples in scored:
            adapted.restore(policy, samples)
            scores[samples] = kept_score(folder / f"score-{samples}.json", policy, machine, settings.episodes)
    return scores


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

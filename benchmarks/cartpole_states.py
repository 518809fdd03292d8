"""The CartPole from states: a constant force (the paper's Table 1) and 2(sin t + 1) N (its figure 3).

    python -m benchmarks.cartpole_states

Each seed trains its own source policy and adapts it. To a constant force of 3.3 N, under which the unadapted policy
drifts at 0.055 m/s, with 50 samples and networks that see one state. To the
time-variant force, with networks that see 5 states and actions, with 50 samples in one round and in rounds of 100 up
to 1,000. Scored on 100 episodes as it stands after 50, 100, 200, 500 and 1,000 counted samples. There is no camera,
so only a pole beyond 0.3 rad ends an episode.

Writes results/cartpole_states.csv and assets/curve_states.png. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from experiments.curves import plot_curve
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import print_speed, read_rows, speed_row, write_rows
from visadapt.evaluation import CartPoleScore
from visadapt.policies import Policy
from visadapt.setups.base import Setup
from visadapt.setups.cartpole import cartpole_states
from visadapt.storage.run_folder import open_run
from visadapt.targets import SyntheticTarget, constant_force, sine_force

FORCE = 3.3
"""N"""
CONSTANT, SINE = f"CartPole, states, constant {FORCE} N", "CartPole, states, 2(sin t + 1) N"
OURS = "ours, states"
PLANS = {CONSTANT: ((50, 50, (50,)),), SINE: ((50, 50, (50,)), (1000, 100, (100, 200, 500, 1000)))}
"""experiment: (budget, samples in a round, samples after which the policy is scored)"""


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    experiments: tuple[str, ...] = tuple(PLANS)
    """which of PLANS are run and tabled"""
    episodes: int = 100
    jobs: Jobs = 2
    """seeds at once, one core each"""
    work: Path = Path("runs/cartpole_states")
    out: Path = Path("results/cartpole_states.csv")
    picture: Path = Path("assets/curve_states.png")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    jobs = [(experiment, seed) for experiment in settings.experiments for seed in range(settings.seeds)]
    found = in_processes(_scores, settings, jobs)
    rows = []
    for experiment in settings.experiments:
        plans = PLANS[experiment]
        scores = [found[experiment, seed] for seed in range(settings.seeds)]
        rows += [
            speed_row(experiment, "unadapted", domain, 0, [each[domain] for each in scores])
            for domain in ("source", "target")
        ]
        for samples in sorted(samples for plan in plans for samples in plan[2]):
            rows.append(speed_row(experiment, OURS, "adapted", samples, [each[str(samples)] for each in scores]))
    write_rows(settings.out, rows)
    if SINE in settings.experiments:
        drawn = [row for row in read_rows(settings.out) if row["experiment"] == SINE]
        plot_curve(settings.picture, drawn, paper=None)
    for row in rows:
        print_speed(row)


def opened(settings: Settings, experiment: str, seed: int) -> tuple[Setup, Path]:
    """The setup of an experiment, and a seed's folder; raises RunError where that is another run's."""
    folder = settings.work / ("constant" if experiment == CONSTANT else "sine") / f"seed-{seed}"
    setup = cartpole_states(with_history=experiment == SINE)
    about = {"seed": seed, "episodes": settings.episodes, "plans": PLANS[experiment], **setup.settings.numbers()}
    open_run(folder, about)
    return setup, folder


def _scores(settings: Settings, experiment: str, seed: int) -> dict[str, CartPoleScore]:
    """Scores of one seed of an experiment, by samples; before adaptation by domain."""
    torch.set_num_threads(1)
    setup, folder = opened(settings, experiment, seed)
    target = SyntheticTarget(constant_force(FORCE) if experiment == CONSTANT else sine_force)
    unadapted = setup.pretrain(folder / "policy.safetensors", seed)

    def scored(name: str, policy: Policy, where: SyntheticTarget) -> CartPoleScore:
        return kept_score(folder / f"score-{name}.json", policy, where, settings.episodes)

    scores = {"source": scored("source", unadapted, SyntheticTarget()), "target": scored("target", unadapted, target)}
    for budget, round_samples, after in PLANS[experiment]:
        policy = copy.deepcopy(unadapted)
        adapted = setup.adapt(policy, target, folder / f"budget-{budget}", budget, round_samples, seed)
        for samples in after:
            adapted.restore(policy, samples)
            scores[str(samples)] = scored(str(samples), policy, target)
    return scores


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

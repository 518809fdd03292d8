"""PPO on the CartPole swing-up (the paper's A.5): after how many samples do all episodes succeed?

    python -m benchmarks.swing_up_ppo

The episodes, starts and success are those of `train.swing_up`; the reward of a step is (1 + cos theta) / 2 times
exp(-x^2 / 4 - x_dot^2 / 10). Scored on 100 episodes after every 51,200 samples, until all succeed.

Writes results/swing_up_ppo.csv. Interrupted, it begins again.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from benchmarks.baselines.courses import SwingingUp
from benchmarks.baselines.table import module_of
from experiments.result_tables import Row, write_rows
from experiments.swing_up import score
from visadapt.targets.synthetic import no_effects
from visadapt.world import World


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seed: int = 0
    episodes: int = 100
    every: int = 51_200
    """samples between scores"""
    most: int = 1_024_000
    """samples after which it ends in any case"""
    out: Path = Path("results/swing_up_ppo.csv")


def main(settings: Settings) -> None:
    """Train, score, and write the table."""
    torch.set_num_threads(1)
    ppo, course = module_of("ppo"), SwingingUp()
    machines = ppo.Machines(course, no_effects, World(course.system, period=course.period), settings.seed)
    model = ppo.model_of(machines, settings.seed)
    rows: list[Row] = []
    while model.num_timesteps < settings.most and (not rows or rows[-1].failed):
        model.learn(settings.every, reset_num_timesteps=False)
        found = score(ppo.Trained(model, course), settings.episodes)
        rows.append(
            Row(
                experiment="CartPole, swing-up",
                system="cartpole",
                method="PPO",
                domain="source",
                samples=model.num_timesteps,
                measure="mean cart speed",
                unit="m/s",
                mean=round(found.speed, 4),
                std=None,
                episodes=settings.episodes,
                failed=settings.episodes - found.succeeded,
                seeds=1,
            )
        )
        print(f"{model.num_timesteps} samples: {found}", flush=True)
    write_rows(settings.out, rows)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

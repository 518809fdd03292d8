"""A system of one's own adapted to its machine: a rotary pendulum held upright under hidden effects.

    python -m benchmarks.own_system

The pendulum is that of docs/own_system.md, and none of the library's settings were made for it. Angles are measured to
1 mrad and rates to 20 mrad/s (standard deviations of white noise). By method:

    regulator       the linear-quadratic regulator of the source, as which a new policy begins
    source policy   trained in the source
    residual        `visadapt adapt`: Algorithm 1 with a residual
    diagnosed       `visadapt adapt --diagnose`: what is named is put into the simulator
    true effect     the hidden effect is in the simulator; takes no samples

Scores are of episodes of 5 s. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from experiments.furuta import Furuta
from experiments.kept_scores import kept_score
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import Row, write_rows
from visadapt.effects import Effect
from visadapt.effects.catalogue import catalogue
from visadapt.evaluation import RegulationScore
from visadapt.policies import RegulatorPolicy
from visadapt.setups.regulator import regulator
from visadapt.setups.training import adapt
from visadapt.storage.run_folder import open_run
from visadapt.targets.regulation import RegulationTarget
from visadapt.tasks.regulate import Regulate
from visadapt.world import World

PERIOD = 0.02  # s
TASK = Regulate(
    Furuta(),
    goal={"pendulum": math.pi},
    tolerance={"arm": 0.2, "pendulum": 0.1, "arm_rate": 2.0, "pendulum_rate": 2.0},
    start={"arm": 0.3, "pendulum": 0.1, "arm_rate": 0.5, "pendulum_rate": 0.5},
    limits={"arm": 1.9, "pendulum": 0.6},
)
NOISE = {"arm": 1e-3, "pendulum": 1e-3, "arm_rate": 2e-2, "pendulum_rate": 2e-2}
HIDDEN: dict[str, tuple[str, dict[str, float]]] = {
    "a delay of 20 ms": ("voltage.actuator_delay", {"delay": 0.02}),
    "a lag of 30 ms": ("voltage.actuator_lag", {"time_constant": 0.03}),
    "dry friction of 2 mN m on the arm": ("arm_axis.coulomb_friction", {"torque": 0.002}),
    "a bias of 2 V": ("voltage.actuator_bias", {"offset": 2.0}),
    "60 % of the voltage": ("voltage.actuator_gain", {"scale": 0.6}),
}
"""What is hidden: an effect, and its parameters."""
REGULATOR, SOURCE, RESIDUAL, DIAGNOSED, TRUE = METHODS = (
    "regulator",
    "source policy",
    "residual",
    "diagnosed",
    "true effect",
)


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    kinds: tuple[str, ...] = tuple(HIDDEN)
    """what is hidden"""
    seeds: int = 3
    episodes: int = 100
    samples: int = 1000
    """counted by a residual, in five rounds"""
    diagnosed: int = 500
    """counted by a diagnosis, in two rounds"""
    iterations: int | None = None
    """of tuning; without, the setup's own"""
    jobs: Jobs = 2
    """of what is hidden and seeds at once, one core each"""
    work: Path = Path("runs/own_system")
    out: Path = Path("results/own_system.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    in_processes(_source, settings, [(seed,) for seed in range(settings.seeds)])
    jobs = [(kind, seed) for kind in settings.kinds for seed in range(settings.seeds)]
    found = in_processes(_scores, settings, jobs)
    rows = []
    for kind in settings.kinds:
        for method in METHODS:
            scores = [found[kind, seed][method] for seed in range(settings.seeds)]
            rows += _rows(kind, method, _samples(settings, method), scores)
    write_rows(settings.out, rows)
    for row in rows:
        print(f"{row.experiment:45} {row.method:15} {row.measure:15} {row.mean:.4f} {row.unit}, {row.failed} failed")


def _samples(settings: Settings, method: str) -> int:
    """Samples of the target that a method counts."""
    return {RESIDUAL: settings.samples, DIAGNOSED: settings.diagnosed}.get(method, 0)


def _source(settings: Settings, seed: int) -> RegulatorPolicy:
    """The source policy of a seed, trained where it is not kept yet."""
    torch.set_num_threads(1)
    setup = regulator(World(TASK.system, period=PERIOD), TASK)
    policy = setup.pretrain(settings.work / f"seed-{seed}.safetensors", seed)
    assert isinstance(policy, RegulatorPolicy)
    return policy


def _scores(settings: Settings, kind: str, seed: int) -> dict[str, RegulationScore]:
    """Scores of one seed under what is hidden, by method."""
    source = _source(settings, seed)
    folder = settings.work / kind / f"seed-{seed}"
    numbers = {name: getattr(settings, name) for name in ("episodes", "samples", "diagnosed", "iterations")}
    open_run(folder, {"seed": seed, **numbers, "task": TASK.settings(), "noise": NOISE})
    effect, values = HIDDEN[kind]
    hidden = {each.name: each for each in catalogue(TASK.system)}[effect](**values)
    target = RegulationTarget(TASK, PERIOD, lambda batch, generator: [hidden], NOISE)
    scores = {}
    for method in METHODS:
        work = folder / method.replace(" ", "-")
        path = work.with_suffix(".json")
        policy = source if path.exists() else _adapted(source, hidden, target, method, work, settings, seed)
        scores[method] = kept_score(path, policy, target, settings.episodes)
    return scores


def _adapted(
    policy: RegulatorPolicy,
    hidden: Effect,
    target: RegulationTarget,
    method: str,
    work: Path,
    settings: Settings,
    seed: int,
) -> RegulatorPolicy:
    """The source policy, adapted by a method."""
    source = World(TASK.system, period=PERIOD)
    if method == REGULATOR:
        new = regulator(source, TASK).policy()
    elif method == SOURCE:
        new = policy
    elif method == TRUE:
        new = adapt(
            policy, World(TASK.system, [copy.deepcopy(hidden)], PERIOD), seed=seed, iterations=settings.iterations
        )
    else:
        samples, rounds = _samples(settings, method), 2 if method == DIAGNOSED else 5
        new = adapt(
            policy,
            source,
            target,
            samples,
            work,
            seed,
            round_samples=samples // rounds,
            iterations=settings.iterations,
            diagnose=method == DIAGNOSED,
        ).policy
    assert isinstance(new, RegulatorPolicy)
    return new


def _rows(kind: str, method: str, samples: int, scores: list[RegulationScore]) -> list[Row]:
    """The errors of the arm's angle and rate: mean and spread over the seeds in which an episode survived."""
    episodes = sum(one.episodes for one in scores)
    failed = episodes - sum(one.survived for one in scores)
    domain = "target" if method in (REGULATOR, SOURCE) else "adapted"
    rows = []
    for state in ("arm", "arm_rate"):
        errors = np.array([one.errors[state] for one in scores if one.errors is not None])
        mean, std = (float(errors.mean()), float(errors.std())) if len(errors) else (math.nan, math.nan)
        about = (
            f"rotary pendulum, {kind}",
            "furuta",
            method,
            domain,
            samples,
            f"{state} error",
            scores[0].units[state],
        )
        rows.append(Row(*about, round(mean, 6), round(std, 6), episodes, failed, len(scores)))
    return rows


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

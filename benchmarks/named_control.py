"""What a found effect is worth for control: policies tuned with it, and with the true one, on the same target.

    python -m benchmarks.named_control

The CartPole from states under one hidden effect of each kind: steady, in time, with memory, in space. The source
policy collects the samples; the effect, whose class is known and whose parameters are not, is fitted to them; and the
source policy is tuned in the world with the effect as it was found. The same is done with the true parameters, and
without any effect. Each seed has its own source policy and recording; scores are of 100 episodes of 12.5 s.

Writes results/named_control.csv. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import copy
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

from experiments.kept_scores import kept_score
from experiments.result_tables import print_speed, speed_row, write_rows
from visadapt.effects import ActuatorDelay, Effect, PeriodicForce, Spring, ViscousFriction
from visadapt.estimation.fit_states import neutral
from visadapt.evaluation import CartPoleScore
from visadapt.learning.grounding import fit_named
from visadapt.learning.ledger import Ledger
from visadapt.learning.policy import TuneSettings, tune
from visadapt.learning.windows import Windows
from visadapt.policies import Policy
from visadapt.recordings import Episode
from visadapt.setups.cartpole import FROM_STATES, cartpole_states
from visadapt.storage.run_folder import open_run
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget
from visadapt.targets.rollout import run
from visadapt.world import World

HIDDEN: dict[str, Callable[[], Effect]] = {
    "steady": lambda: ViscousFriction(coefficient=5.0),
    "in time": lambda: PeriodicForce(amplitude=2.0, frequency=0.5, phase=1.0, offset=1.0),
    "with memory": lambda: ActuatorDelay(delay=0.08),
    "in space": lambda: Spring(stiffness=2.0, rest=0.2),
}
"""kind of effect: what is hidden"""

FOUND, TRUE, NONE = "found effect", "true effect", "no effect"


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    episodes: int = 100
    samples: int = 300
    """counted, of each recording"""
    exploration: float = 0.2
    """standard deviation of white noise on the commands while samples are collected"""
    source_iterations: int = 3000
    """of the source policy"""
    iterations: int = 400
    """of the tuning"""
    jobs: int = 2
    """seeds at once, one core each"""
    work: Path = Path("runs/named_control")
    out: Path = Path("results/named_control.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(settings.jobs, mp_context=context) as pool:
        found = list(pool.map(_scores, [settings] * settings.seeds, range(settings.seeds)))
    rows = []
    for kind, hidden in HIDDEN.items():
        experiment = f"CartPole, states, {hidden().name} ({kind})"
        for method, samples in ((NONE, 0), (FOUND, settings.samples), (TRUE, 0)):
            domain = "target" if method == NONE else "adapted"
            rows.append(speed_row(experiment, method, domain, samples, [each[kind, method] for each in found]))
    write_rows(settings.out, rows)
    for row in rows:
        print(f"{row.experiment:50}", end="")
        print_speed(row)


def _scores(settings: Settings, seed: int) -> dict[tuple[str, str], CartPoleScore]:
    """Scores of one seed, by kind of effect and method."""
    torch.set_num_threads(1)
    folder = settings.work / f"seed-{seed}"
    own = replace(
        FROM_STATES,
        source=replace(FROM_STATES.source, iterations=settings.source_iterations),
        tuning=replace(FROM_STATES.tuning, iterations=settings.iterations),
    )
    setup = cartpole_states(with_history=True, settings=own)
    numbers = {name: getattr(settings, name) for name in ("episodes", "samples", "exploration")}
    open_run(folder, {"seed": seed, **numbers, **own.numbers()})
    source = setup.pretrain(folder / "policy.safetensors", seed)
    scores = {}
    for kind, hidden in HIDDEN.items():
        effects = [hidden()]
        target = SyntheticTarget(lambda batch, generator, effects=effects: effects)  # type: ignore[misc]
        for method in (NONE, FOUND, TRUE):
            path = folder / f"score-{kind}-{method}.json".replace(" ", "-")
            policy = source
            if method != NONE and not path.exists():
                policy = _tuned(source, target, kind, method, own.tuning, settings, seed)
            scores[kind, method] = kept_score(path, policy, target, settings.episodes)
    return scores


def _tuned(
    source: Policy, target: SyntheticTarget, kind: str, method: str, how: TuneSettings, settings: Settings, seed: int
) -> Policy:
    """The source policy, tuned in a world with the effect as it was found, or as it is."""
    windows = Windows.cut(_recorded(source, target, settings, seed), "state")
    effect = HIDDEN[kind]()
    if method == FOUND:
        names = [parameter.name for parameter in effect.table]
        effect = type(effect)(**dict(zip(names, neutral(type(effect)), strict=True)))
    world = World(CartPole(), [effect])
    if method == FOUND:
        fit_named(world, windows)
    policy = copy.deepcopy(source)
    tune(policy, world, None, how, torch.Generator().manual_seed(seed), windows)
    return policy


def _recorded(policy: Policy, target: SyntheticTarget, settings: Settings, seed: int) -> list[Episode]:
    """Episodes of `settings.samples` samples in all, one after the other."""
    ledger, generator = Ledger(settings.samples), torch.Generator().manual_seed(1000 + seed)
    episodes: list[Episode] = []
    while ledger.left:
        episodes.append(run(target, policy, 1, ledger.left, generator, settings.exploration)[0].episode)
        ledger.count("data", episodes[-1].samples)
    return episodes


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

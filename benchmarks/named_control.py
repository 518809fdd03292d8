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
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
import tyro

from visadapt.effects import ActuatorDelay, Effect, FrictionPatch, PeriodicForce, ViscousFriction
from visadapt.estimation.fit_states import neutral
from visadapt.evaluation.cartpole_score import Evaluation, evaluate
from visadapt.evaluation.result_tables import say, speed_row, write_rows
from visadapt.learning.grounding import fit_named
from visadapt.learning.ledger import Ledger
from visadapt.learning.policy import tune
from visadapt.learning.windows import Windows
from visadapt.policies import StatePolicy
from visadapt.recordings import Episode
from visadapt.setups.cartpole_states import StateSettings, pretrain
from visadapt.storage.run_folder import once, open_run
from visadapt.systems import CartPole
from visadapt.targets import SyntheticTarget
from visadapt.targets.rollout import run, see_states
from visadapt.world import World

SCORE_SEED = 2026
HIDDEN: dict[str, Callable[[], Effect]] = {
    "steady": lambda: ViscousFriction(coefficient=5.0),
    "in time": lambda: PeriodicForce(amplitude=2.0, frequency=0.5, phase=1.0, offset=1.0),
    "with memory": lambda: ActuatorDelay(delay=0.08),
    "in space": lambda: FrictionPatch(start=-0.3, end=0.1, coefficient=15.0),
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
        say(row)


def _scores(settings: Settings, seed: int) -> dict[tuple[str, str], Evaluation]:
    """Scores of one seed, by kind of effect and method."""
    torch.set_num_threads(1)
    folder = settings.work / f"seed-{seed}"
    training = StateSettings(with_history=True)
    training = replace(
        training,
        source=replace(training.source, iterations=settings.source_iterations),
        adapted=replace(training.adapted, iterations=settings.iterations),
    )
    about = {"seed": seed, "episodes": settings.episodes, "samples": settings.samples, **asdict(training)}
    open_run(folder, {**about, "exploration": settings.exploration})
    source = pretrain(World(CartPole()), training, folder / "policy.safetensors", seed)
    scores = {}
    for kind, hidden in HIDDEN.items():
        effects = [hidden()]
        target = SyntheticTarget(lambda batch, generator, effects=effects: effects)  # type: ignore[misc]
        for method in (NONE, FOUND, TRUE):

            def score(kind: str = kind, method: str = method, target: SyntheticTarget = target) -> dict[str, object]:
                policy = source if method == NONE else _tuned(source, target, kind, method, training, settings, seed)
                return asdict(evaluate(target, policy, see_states, SCORE_SEED, settings.episodes)[0])

            path = folder / f"score-{kind}-{method}.json".replace(" ", "-")
            scores[kind, method] = Evaluation(**once(path, score))
    return scores


def _tuned(
    source: StatePolicy,
    target: SyntheticTarget,
    kind: str,
    method: str,
    training: StateSettings,
    settings: Settings,
    seed: int,
) -> StatePolicy:
    """The source policy, tuned in a world with the effect as it was found, or as it is."""
    episodes = _recorded(source, target, settings, seed)
    windows = Windows.cut(episodes, "state")
    effect = HIDDEN[kind]()
    if method == FOUND:
        effect = type(effect)(**dict(zip((p.name for p in effect.table), neutral(type(effect)), strict=True)))
    world = World(CartPole(), [effect])
    if method == FOUND:
        fit_named(world, windows)
    policy = copy.deepcopy(source)
    tune(policy, world, None, training.adapted, torch.Generator().manual_seed(seed), windows)
    return policy


def _recorded(policy: StatePolicy, target: SyntheticTarget, settings: Settings, seed: int) -> Sequence[Episode]:
    """Episodes of as many samples as there are to be, one after the other."""
    ledger, generator = Ledger(settings.samples), torch.Generator().manual_seed(1000 + seed)
    episodes = []
    while ledger.left:
        episodes.append(run(target, policy, see_states, 1, ledger.left, generator, settings.exploration)[0].episode)
        ledger.count("data", episodes[-1].samples)
    return episodes


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

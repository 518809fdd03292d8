"""A policy of our quadrotor, flown on rotorpy's and tuned on 1,000 samples of it.

    python -m train.rotorpy_quadrotor [--budget 1000] [--seeds 0 1 2] [--out runs/rotorpy]

The target is one that no one here wrote: rotorpy's Crazyflie Brushless, with its rotor drag, motors that lag, and wind
(pip install 'visadapt[rotorpy]'). The source has the mass, arm and rate gain that rotorpy publishes, and no air. Since
thrust is mass-normalised, the shipped policy of the default quadrotor flies that source
as it is: nothing is trained there. In order:

    1. scores of that policy in the source, in rotorpy without air (what motors and rate loop cost), and in the target
    2. for every seed, with a residual that sees one state and with one that sees five: Algorithm 1, at most `budget`
       counted samples, and the score after it
    3. what the gap is: drag along each body axis, the lift of air across the rotors, the motors' lag and the steady
       wind, by least squares on the counted samples, beside what rotorpy's parameters say

Scores are over references that were not trained on. Writes the scores and metrics.json to `out`, and
results/rotorpy.csv. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from datasets import quadrotor_references
from experiments.endings import ends_in_one_line
from experiments.flights import flight_target
from experiments.kept_scores import kept_score
from experiments.result_tables import Row, miss_row, write_rows
from experiments.rotorpy_published import published
from visadapt.evaluation import FlightScore
from visadapt.policies import Policy
from visadapt.progress import reporting
from visadapt.recordings import Episode
from visadapt.setups.flight import quadrotor
from visadapt.storage.run_folder import once, open_run, write_json
from visadapt.systems.rigid_body import ATTITUDE, VELOCITY, matvec, rotation
from visadapt.targets.rotorpy import BREEZE, SOURCE, RotorpyTarget
from visadapt.targets.synthetic import FlightTarget
from visadapt.tasks.follow import Follow
from visadapt.weights import shipped
from visadapt.world import World

METHODS = {"ours, states": False, "ours, states with history": True}
"""Whether the residual sees what was left unexplained over the last periods."""
UNITS = {"drag_x": "1/s", "drag_y": "1/s", "drag_z": "1/s", "lift": "1/m", "lag": "s", "wind_x": "m/s", "wind_y": "m/s"}
"""What `explain` finds; drag and lift are divided by the mass."""


@dataclass(frozen=True)
class Settings:
    """What is adapted, and where results go."""

    budget: int = 1000
    """target samples of each adaptation, all counted"""
    round_samples: int = 200
    seeds: tuple[int, ...] = (0, 1, 2)
    methods: tuple[str, ...] = tuple(METHODS)
    """which of METHODS are run and tabled"""
    flights: int = 50
    """that each policy is scored on"""
    out: Path = Path("runs/rotorpy")
    results: Path = Path("results/rotorpy.csv")


def main(settings: Settings) -> None:
    """Do the whole job in `settings.out`, going on from what is there."""
    torch.set_num_threads(1)
    references = quadrotor_references.ready()
    train, test = (Follow(part) for part in references)
    source = World(SOURCE, period=train.period, substeps=2)
    setups = {method: quadrotor(*references, source, with_history) for method, with_history in METHODS.items()}
    setup = setups["ours, states"]
    policy = setup.load(shipped("quadrotor"))
    targets = {"source": flight_target(setup), "no air": RotorpyTarget(test, aero=False), "target": RotorpyTarget(test)}
    chosen = {key: getattr(settings, key) for key in ("budget", "round_samples", "flights")}
    training = {method: each.settings.numbers() for method, each in setups.items()}
    about = open_run(settings.out, {**chosen, "air": asdict(BREEZE), "training": training})
    before = {name: [_scored(settings, name.replace(" ", "-"), where, policy)] for name, where in targets.items()}
    after: dict[str, list[FlightScore]] = {method: [] for method in settings.methods}
    gaps = []
    with reporting() as report:
        for seed in settings.seeds:
            for method in settings.methods:
                adapting = copy.deepcopy(policy)
                name = f"{'history' if METHODS[method] else 'state'}-{seed}"
                work, target = settings.out / name, RotorpyTarget(train)
                counted = (settings.budget, settings.round_samples)
                adapted = setups[method].adapt(adapting, target, work, *counted, seed, report)
                after[method].append(_scored(settings, f"after-{name}", targets["target"], adapting))
                gaps.append(once(settings.out / f"gap-{name}.json", partial(explain, adapted.episodes)))
    true = published(RotorpyTarget(test))
    write_json(settings.out / "metrics.json", {"gaps": gaps, "published": true, **about})
    write_rows(settings.results, _rows(settings, before, after, gaps))
    for key, unit in UNITS.items():
        print(f"gap: {key:7} {np.mean([gap[key] for gap in gaps]):7.3f} {unit:4} rotorpy: {true[key]:.3f}")
    print(f"the share of what was unexplained that it explains: {np.mean([gap['explained'] for gap in gaps]):.2f}")


def explain(episodes: Sequence[Episode]) -> dict[str, float]:
    """The quantities of UNITS that explain best, by least squares, the acceleration that the source lacks.

    In body axes, the missing acceleration of a period is the mean acceleration over it, from the measured velocities,
    plus gravity, minus the thrust asked for; `explained` is the share of its mean square that they explain. In a wind w
    of constant velocity, with air = R^T (v - w):

        x, y:  -drag air        z:  -drag_z air_z + lift (air_x^2 + air_y^2) + thrust that lags - thrust asked for

    The attitude is the measured one, so the rate loop does not enter. Lags are tried one by one; the best is kept.
    """
    parts = [_missing(episode) for episode in episodes]
    missing, velocity, turned = (torch.cat([part[k] for part in parts]) for k in range(3))
    own = matvec(turned.mT, velocity)
    found: dict[str, float] = {}
    level = []
    for k, axis in enumerate("xy"):
        slope, pushed = _least_squares(missing[:, k], own[:, k], turned[:, k, k])
        found |= {f"drag_{axis}": -slope, f"wind_{axis}": -pushed / slope}
        level.append(slope * own[:, k] + pushed * turned[:, k, k])
    air = matvec(turned.mT, velocity - torch.tensor([found["wind_x"], found["wind_y"], 0.0]))
    across = air[:, :2].square().sum(1)
    best = float("inf")
    for lag in (0.002 * k for k in range(1, 76)):
        late = torch.cat([_lateness(episode, lag) for episode in episodes])
        slope, lift = _least_squares(missing[:, 2] - late, air[:, 2], across)
        upward = late + slope * air[:, 2] + lift * across
        error = float((missing[:, 2] - upward).square().mean())
        if error < best:
            best = error
            found |= {"drag_z": -slope, "lift": lift, "lag": lag}
            left = missing - torch.stack((*level, upward), 1)
    return {**found, "explained": float(1 - left.square().sum() / missing.square().sum())}


def _missing(episode: Episode) -> tuple[Tensor, Tensor, Tensor]:
    """Missing accelerations (T, 3) in body axes; velocities (T, 3) and rotation matrices (T, 3, 3) at mid-period."""
    assert episode.state is not None
    state = torch.as_tensor(episode.state)
    middle = (state[1:] + state[:-1]) / 2
    turned = rotation(middle[:, ATTITUDE])
    period = float(episode.time[1] - episode.time[0])
    gained = state[:, VELOCITY].diff(dim=0) / period + torch.tensor([0.0, 0.0, float(SOURCE.gravity)])
    missing = matvec(turned.mT, gained)
    missing[:, 2] -= SOURCE.thrust(torch.as_tensor(episode.action))[:-1]
    return missing, middle[:, VELOCITY], turned


def _lateness(episode: Episode, lag: float) -> Tensor:
    """By how much mean thrusts (T,) in m/s2 differ from those asked for, if motors follow in `lag` s from a hover."""
    period = float(episode.time[1] - episode.time[0])
    left = float(np.exp(-period / lag))
    now, out = float(SOURCE.gravity), []
    for asked in SOURCE.thrust(torch.as_tensor(episode.action))[:-1].tolist():
        out.append((now - asked) * lag / period * (1 - left))
        now = asked + (now - asked) * left
    return torch.tensor(out)


def _least_squares(wanted: Tensor, *parts: Tensor) -> list[float]:
    return list(torch.linalg.lstsq(torch.stack(parts, 1), wanted[:, None]).solution[:, 0].tolist())


def _scored(settings: Settings, name: str, target: FlightTarget, policy: Policy) -> FlightScore:
    found = kept_score(settings.out / f"{name}.json", policy, target, settings.flights)
    print(f"{name}: {found}", flush=True)
    return found


def _rows(
    settings: Settings,
    before: dict[str, list[FlightScore]],
    after: dict[str, list[FlightScore]],
    gaps: Sequence[dict[str, float]],
) -> list[Row]:
    """How far flights miss, and what the gap is: the spread of the latter is over adaptations."""
    what, system, used = "rotorpy", "rotorpy's Crazyflie Brushless", settings.budget

    def row(method: str, domain: str, samples: int, scores: Sequence[FlightScore]) -> Row:
        return miss_row(what, system, method, domain, samples, "mean tracking error", scores)

    rows = [
        row("unadapted", "source", 0, before["source"]),
        row("unadapted, without air", "target", 0, before["no air"]),
        row("unadapted", "target", 0, before["target"]),
    ]
    rows += [row(method, "adapted", used, scores) for method, scores in after.items()]
    for key, unit in {**UNITS, "explained": "1"}.items():
        found = np.array([gap[key] for gap in gaps])
        mean, std, seeds = round(float(found.mean()), 4), round(float(found.std()), 4), len(settings.seeds)
        rows.append(Row(what, system, "least squares", "target", used, f"gap: {key}", unit, mean, std, None, 0, seeds))
    return rows


if __name__ == "__main__":
    with ends_in_one_line("rotorpy_quadrotor"):
        main(tyro.cli(Settings, description=__doc__))

"""Ambiguous diagnoses, and what settles them: the planned experiment, white noise of the same power, or more of before.

    python -m benchmarks.planned_experiments

The source policy runs gently on a cart-pole with one hidden effect: 80 noisy rows, diagnosed with the whole catalogue.
Where the diagnosis is ambiguous, 200 more rows are recorded in three ways: with the excitation of `visadapt.plan` added
to the policy's commands, with white noise of the same root mean square, and with neither. Each is diagnosed together
with the first recording, and is right where nothing but the hidden effect is then named, and those that no motion tells
from it, as a bias of the motor from a force. Ambiguities that no excitation is expected to settle are left as they are.

Writes results/planned_experiments.csv. Interrupt it anywhere; started again, it goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

import visadapt as va
from experiments.parallel import Jobs, in_processes
from experiments.result_tables import Row, write_rows
from visadapt import effects
from visadapt.diagnosis.result import AMBIGUOUS, Diagnosis, without_slight
from visadapt.effects.catalogue import twins
from visadapt.storage.run_folder import once, open_run
from visadapt.weights import shipped

STATES = ("x", "x_dot", "theta", "theta_dot")
NOISE = np.array([0.005, 0.02, 0.009, 0.05])
"""m, m/s, rad, rad/s: standard deviations of the measurement noise"""
EPISODES, ROWS, MORE_ROWS = 1, 80, 200
GENTLE = 0.05
"""standard deviation of white noise on the commands of the first recording, in [-1, 1]"""

HIDDEN: Mapping[str, Callable[[], va.Effect]] = {
    "viscous friction 0.6 N s/m": lambda: effects.ViscousFriction(coefficient=0.6),
    "viscous friction 1.5 N s/m": lambda: effects.ViscousFriction(coefficient=1.5),
    "drag 2 N s2/m2": lambda: effects.QuadraticDrag(coefficient=2.0),
    "drag 5 N s2/m2": lambda: effects.QuadraticDrag(coefficient=5.0),
    "dry friction 0.5 N": lambda: effects.CoulombFriction(force=0.5),
    "dry friction 1 N": lambda: effects.CoulombFriction(force=1.0),
    "gear friction 0.3": lambda: effects.LoadDependentFriction(share=0.3),
    "Stribeck friction 0.5 to 1 N": lambda: effects.StribeckFriction(force=0.5, breakaway=1.0, velocity=0.1),
    "dry friction 1 N forward, 0.4 N back": lambda: effects.DirectionalFriction(forward=1.0, backward=0.4),
    "friction patch 5 N s/m": lambda: effects.FrictionPatch(start=-0.1, end=0.3, coefficient=5.0),
    "hinge damping 0.02": lambda: effects.PoleDamping(coefficient=0.02),
    "hinge friction 0.02 N m": lambda: effects.PoleFriction(torque=0.02),
    "hinge spring 0.3 N m/rad": lambda: effects.PoleSpring(stiffness=0.3),
    "cart 1.4 times as heavy": lambda: effects.CartMass(scale=1.4),
    "pole 3 times as heavy": lambda: effects.PoleMass(scale=3.0),
    "pole 1.3 times as long": lambda: effects.PoleLength(scale=1.3),
    "gain 0.7": lambda: effects.ActuatorGain(scale=0.7),
    "lag 0.03 s": lambda: effects.ActuatorLag(time_constant=0.03),
    "delay 0.02 s": lambda: effects.ActuatorDelay(delay=0.02),
    "dead zone 0.03": lambda: effects.ActuatorDeadzone(width=0.03),
    "backlash 0.06": lambda: effects.ActuatorBacklash(width=0.06),
    "force 0.5 N": lambda: effects.ConstantForce(force=0.5),
    "tilt 0.02 rad": lambda: effects.TrackTilt(angle=0.02),
    "spring 1 N/m": lambda: effects.Spring(stiffness=1.0, rest=0.0),
    "late angle 0.02 s": lambda: effects.AngleDelay(delay=0.02),
    "angle offset 0.01 rad": lambda: effects.AngleOffset(offset=0.01),
}
"""Small enough that a gentle recording may leave the cause open."""
GENTLY, PLANNED, WHITE, NEITHER = "gently run", "as planned", "white noise of the same power", "no excitation"
OUTCOMES = SETTLED, OTHERWISE, OPEN = "the hidden effect alone, or with twins", "another answer", "ambiguous"
"""Twins are effects that no motion tells apart."""


@dataclass(frozen=True)
class Settings:
    """What is run, and where."""

    seeds: int = 3
    """recordings of each hidden effect"""
    hidden: tuple[str, ...] = tuple(HIDDEN)
    """which of HIDDEN"""
    jobs: Jobs = 2
    """recordings at once, one core each"""
    work: Path = Path("runs/planned_experiments")
    out: Path = Path("results/planned_experiments.csv")


def main(settings: Settings) -> None:
    """Run what is missing, then write the table."""
    jobs = [(name, seed) for name in settings.hidden for seed in range(settings.seeds)]
    found = list(in_processes(_settled, settings, jobs).values())
    planned = [each for each in found if each["after"]]
    about = ("CartPole, states, one hidden effect", "cartpole")

    def rows_of(method: str, samples: int, answers: list[str]) -> list[Row]:
        count = max(1, len(answers))
        shares = {outcome: round(answers.count(outcome) / count, 4) for outcome in OUTCOMES}
        what, number = (*about, method, "target", samples), len(answers)
        return [
            Row(*what, outcome, "share", share, None, number, 0, settings.seeds) for outcome, share in shares.items()
        ]

    rows = rows_of(GENTLY, EPISODES * ROWS, [each["answer"] for each in found])
    for method in (PLANNED, WHITE, NEITHER):
        answers = [each["after"][method] for each in planned]
        rows += rows_of(f"{GENTLY}, then {method}", EPISODES * ROWS + MORE_ROWS, answers)
    write_rows(settings.out, rows)
    for each in rows:
        print(f"{each.method:60} {each.measure:24} {each.mean:.2f} of {each.episodes}")
    unsettled = sum(each["answer"] == OPEN for each in found) - len(planned)
    print(f"ambiguous where no excitation is expected to settle it: {unsettled}")


def _settled(settings: Settings, name: str, seed: int) -> dict[str, Any]:
    """What the gentle recording is answered, and, where an experiment is planned, what is answered with more rows."""
    torch.set_num_threads(1)
    folder = settings.work / name.replace(" ", "-").replace("/", "-").replace(",", "") / str(seed)
    rows = (EPISODES, ROWS, MORE_ROWS)
    open_run(folder, {"hidden": name, "seed": seed, "noise": NOISE.tolist(), "gentle": GENTLE, "rows": rows})
    return once(folder / "outcome.json", lambda: _outcome(HIDDEN[name](), seed))


def _outcome(hidden: va.Effect, seed: int) -> dict[str, Any]:
    policy, source = va.load_policy(shipped("cartpole_states")), va.World(va.CartPole())
    gentle = _recorded(policy, hidden, EPISODES, ROWS, seed, exploration=GENTLE)
    found = va.diagnose(gentle, source)
    out: dict[str, Any] = {"answer": _judged(found, hidden), "causes": _named(found), "plan": None, "after": None}
    if found.verdict != AMBIGUOUS:
        return out
    try:
        plan = va.plan(found, gentle, source, policy, MORE_ROWS, seed)
    except ValueError as error:
        return out | {"plan": str(error)}
    out["plan"] = str(plan)
    if not plan.settles:
        return out
    added = torch.from_numpy(plan.added)
    # Of another seed than the plan's own, which tries white noise too.
    noise = torch.randn(added.shape, generator=torch.Generator().manual_seed(200 + seed), dtype=added.dtype)
    white = added.square().mean().sqrt() * noise
    after = {}
    for method, excitation in ((PLANNED, added), (WHITE, white), (NEITHER, torch.zeros_like(added))):
        more = _recorded(policy, hidden, 1, MORE_ROWS, 100 + seed, added=excitation)
        both = va.Recording((*gentle.episodes, *more.episodes), STATES, gentle.period, (*gentle.sources, "more"))
        settled = va.diagnose(both, source)
        after[method] = _judged(settled, hidden)
        out[method] = {"verdict": settled.verdict, "causes": _named(settled)}
    return out | {"after": after}


def _named(found: Diagnosis) -> dict[str, list[str]]:
    """By cause that is not slight, those it cannot be told from."""
    return {cause.effect: list(cause.indistinguishable_from) for cause in without_slight(found.causes)}


def _judged(found: Diagnosis, hidden: va.Effect) -> str:
    named = _named(found).keys()
    alike = {hidden.name, *(twin.name for twin in twins(type(hidden), effects.EFFECTS.values(), va.CartPole()))}
    if hidden.name in named and named <= alike:
        return SETTLED
    return OPEN if found.verdict == AMBIGUOUS else OTHERWISE


def _recorded(
    policy: va.Policy,
    hidden: va.Effect,
    episodes: int,
    rows: int,
    seed: int,
    exploration: float = 0.0,
    added: Tensor | None = None,
) -> va.Recording:
    """Noisy states under the policy, and its commands."""
    rng, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    target = va.SyntheticTarget(lambda batch, generator: [hidden])
    runs = va.run(target, policy, episodes, rows, generator, exploration, added)
    noisy = []
    for episode in (run.episode for run in runs):
        assert episode.state is not None
        measured = episode.state + NOISE * rng.normal(size=episode.state.shape)
        noisy.append(va.Episode(episode.time, episode.action.astype(float), measured))
    return va.Recording(tuple(noisy), STATES, target.period, tuple(f"episode {k}" for k in range(episodes)))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

"""Recordings of a cart-pole with a hidden gap to the source, for a sealed check of diagnosis.

    python -m datasets.blind.gaps --out data/blind_hard --kind hard --count 200 --seed 7

Writes one CSV per recording and a separate key file (effects, parameters, strengths), whose SHA-256 is printed before
any recording is written. A diagnoser must never open the key. None of the library's physics is used.

Effects are scaled to a drawn strength: the root mean square, over rows and over x and theta, of the change that an
effect makes to the source's prediction half a second ahead from the true states, in units of the measurement noise; for
an effect on sensing, of the change in the readings. In a pair or triple, each effect has its strength when it acts
alone under the same controller.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from datasets.blind.control import draw_driver
from datasets.blind.kinds import INSEPARABLE, KINDS, REST, Effects, Shape, drawn
from datasets.blind.plant import PERIOD, Array
from datasets.blind.sealing import key_path, names, seal
from datasets.blind.simulation import Case, Run, simulate

CartPoleKind = Literal["easy", "hard", "large"]


@dataclass(frozen=True)
class Settings:
    """Which recordings are made, and where they are written."""

    out: Path
    """folder for the recordings"""
    kind: CartPoleKind = "hard"
    """easy: about 1,000 rows, little noise, all states; hard: about 400 rows, much noise, no velocities; large: as
    easy, with effects up to ten times as strong"""
    count: int = 200
    """how many recordings"""
    seed: int = 0
    """seed of all random numbers"""
    strengths: tuple[float, float] | None = None
    """weakest and strongest effect, in units of the noise; by default 2 to 30 (easy), 0.7 to 6 (hard), 10 to 300"""
    key: Path | None = None
    """file for the answers; by default beside the folder, <out>.key.json"""
    effects: Effects = "core"
    """the catalogue's effects that are drawn: core, as in the sets 2028 and 2029, rest, those beside it, or all"""


@dataclass(frozen=True)
class Difficulty:
    """Settings that differ between the two sets."""

    rows: int
    """rows of a recording, approximately"""
    episodes: tuple[int, int]
    """smallest and largest number of episodes"""
    noise: tuple[float, float, float, float]
    """standard deviations, m, m/s, rad, rad/s"""
    velocities: bool
    """whether they are measured"""
    strengths: tuple[float, float]
    """weakest and strongest effect"""
    mix: dict[str, float]
    """share of the recordings"""


DIFFICULTIES = {
    "easy": Difficulty(
        1000,
        (5, 12),
        (0.001, 0.005, 0.001, 0.005),
        True,
        (2.0, 30.0),
        {"single": 0.5, "pair": 0.2, "none": 0.15, "foreign": 0.15},
    ),
    # In the hard set velocities are not measured, and a controller with an observer does not have them either.
    "hard": Difficulty(
        400,
        (4, 8),
        (0.005, 0.0, 0.009, 0.0),
        False,
        (0.7, 6.0),
        {"single": 0.3, "pair": 0.2, "triple": 0.1, "none": 0.2, "foreign": 0.2},
    ),
    "large": Difficulty(
        1000,
        (5, 12),
        (0.001, 0.005, 0.001, 0.005),
        True,
        (10.0, 300.0),
        {"single": 0.5, "pair": 0.25, "none": 0.25},
    ),
}
"""the sets; a new one goes to the end, since a set's place seeds it"""

EFFECTS_IN = {"none": 0, "single": 1, "pair": 2, "triple": 3, "foreign": 1}
"""number of effects in a recording"""

COLUMNS = ("x", "x_dot", "theta", "theta_dot")
"""of the state"""

SEARCH_SUBSTEPS = 20
"""substeps of 2.5 ms in a period while sizes are searched"""
RECORDING_SUBSTEPS = 50
"""substeps of 1 ms in a period of the recordings that are written"""
CART_REACH, POLE_REACH = 1.5, 0.3
"""m and rad: |x| and |theta| of a recording never exceed these"""


@dataclass
class Draft:
    """A recording in the making."""

    rng: np.random.Generator
    """its own random numbers, so that redrawing one recording does not change the others"""
    mixture: str
    """single, pair, triple, none (that a recording could show) or foreign"""
    case: Case | None = None
    """its machine, controller and noise"""
    run: Run | None = None
    """what it measured"""
    strengths: dict[str, float] | None = None
    """by effect"""


def make(settings: Settings) -> list[Draft]:
    """Draw and run all recordings."""
    if settings.count < 1:
        raise ValueError(f"count is {settings.count}, must be at least 1")
    difficulty = DIFFICULTIES[settings.kind]
    if settings.strengths is not None:
        weakest, strongest = settings.strengths
        if not 0 < weakest < strongest:
            raise ValueError(f"strengths are {weakest:g} and {strongest:g}, must be positive and rise")
        difficulty = replace(difficulty, strengths=settings.strengths)
    if settings.effects == "rest":
        # No recording shows these effects: the right answer is that of a recording without any.
        difficulty = replace(difficulty, mix={"none": 1.0})
    seeds = np.random.SeedSequence([settings.seed, list(DIFFICULTIES).index(settings.kind)]).spawn(settings.count + 1)
    # Shares as exact as the count allows, in random order.
    edges = np.cumsum(list(difficulty.mix.values()))
    places = (np.arange(settings.count) + 0.5) / settings.count
    mixtures = np.array(list(difficulty.mix))[np.searchsorted(edges, places)]
    np.random.default_rng(seeds[0]).shuffle(mixtures)
    drafts = [Draft(np.random.default_rng(seed), str(m)) for seed, m in zip(seeds[1:], mixtures, strict=True)]
    for attempt in range(80):
        pending = [draft for draft in drafts if draft.run is None]
        if not pending:
            return drafts
        _attempt(pending, difficulty, settings.effects, 0.95 ** (attempt // 2))
    raise RuntimeError("some recordings could not be kept on the track; try another seed")


def _attempt(drafts: list[Draft], difficulty: Difficulty, effects: Effects, excitation: float) -> None:
    """Redraw and run the drafts; keep those that stay on the track upright and reach their strengths."""
    deviations = np.array(difficulty.noise)[[0, 2]]
    cases = [_draw_case(draft.rng, difficulty, excitation) for draft in drafts]
    # Most recordings that leave the track do so even without effects: these are dropped before the costly search.
    bare = simulate(cases, difficulty.velocities, SEARCH_SUBSTEPS)
    kept = [(draft, case) for draft, case, run in zip(drafts, cases, bare, strict=True) if _stayed(run)]
    parts: list[list[Job]] = []
    for draft, case in kept:
        chosen = _draw_kinds(draft.rng, draft.mixture, effects)
        parts.append([_draw_job(draft.rng, name, case, difficulty) for name in chosen])
    _seek([job for own in parts for job in own], difficulty.velocities, deviations)
    weakest, strongest = difficulty.strengths
    ready = []
    for (draft, case), own in zip(kept, parts, strict=True):
        if all(0.9 * weakest <= job.strength <= 1.1 * strongest for job in own):
            case.effects = {job.name: job.parameters for job in own}
            ready.append((draft, case, own))
    runs = simulate([case for _, case, _ in ready], difficulty.velocities, RECORDING_SUBSTEPS) if ready else []
    for (draft, case, own), run in zip(ready, runs, strict=True):
        if _stayed(run):
            draft.case, draft.run, draft.strengths = case, run, {job.name: job.strength for job in own}


def _stayed(run: Run) -> bool:
    x, theta = run.reach
    return x <= CART_REACH and theta <= POLE_REACH


def _draw_kinds(rng: np.random.Generator, mixture: str, effects: Effects) -> list[str]:
    if mixture == "none" and (effects == "rest" or (effects == "all" and rng.random() < 0.5)):
        return [REST[int(rng.integers(len(REST)))].name]
    kinds = drawn(mixture, effects)
    while True:
        chosen = [kinds[i].name for i in rng.choice(len(kinds), EFFECTS_IN[mixture], replace=False)]
        if not any(together <= set(chosen) for together in INSEPARABLE):
            return chosen


def _draw_case(rng: np.random.Generator, difficulty: Difficulty, excitation: float) -> Case:
    episodes = int(rng.integers(difficulty.episodes[0], difficulty.episodes[1] + 1))
    rows = round(difficulty.rows / episodes)
    noise = np.array(difficulty.noise)
    driver = draw_driver(rng, episodes, rows, noise, difficulty.velocities, excitation)
    return Case(driver, {}, rng.normal(size=(rows, 4, episodes)) * noise[:, None], rng.random((rows, episodes)))


@dataclass
class Job:
    """The search for the size of one effect, alone in its recording."""

    name: str
    """of the effect"""
    shape: Shape
    """fixed during the search"""
    case: Case
    """the recording with this effect alone"""
    target: float
    """strength to reach"""
    size: float
    """best so far"""
    strength: float = 0.0
    """at that size"""

    @property
    def parameters(self) -> Shape:
        """At the best size so far."""
        return KINDS[self.name].build(self.size, self.shape)


def _draw_job(rng: np.random.Generator, name: str, case: Case, difficulty: Difficulty) -> Job:
    kind = KINDS[name]
    shape = kind.draw(rng, case.shape[0] * PERIOD)
    target = float(np.exp(rng.uniform(*np.log(difficulty.strengths))))
    alone = Case(case.driver, {}, case.noise, case.loss_draws)
    return Job(name, shape, alone, target, float(np.sqrt(kind.low * kind.high)))


def _seek(jobs: list[Job], velocities: bool, deviations: Array, rounds: int = 8) -> None:
    """Bring every job's strength to its target: by proportion within the bracket, else by bisection."""
    low = [np.log(KINDS[job.name].low) for job in jobs]
    high = [np.log(KINDS[job.name].high) for job in jobs]
    trial = [np.log(job.size) for job in jobs]
    open_ = list(range(len(jobs)))
    for _ in range(rounds):
        if not open_:
            return
        for i in open_:
            jobs[i].case.effects = {jobs[i].name: KINDS[jobs[i].name].build(float(np.exp(trial[i])), jobs[i].shape)}
        runs = simulate([jobs[i].case for i in open_], velocities, SEARCH_SUBSTEPS)
        for i, run in zip(open_, runs, strict=True):
            job, sensing = jobs[i], KINDS[jobs[i].name].stage == "sensing"
            strength = run.sensed_gap(deviations) if sensing else run.predicted_gap(deviations)
            # A fallen pole gives no strength; the size is too large.
            fallen = run.reach[1] >= 0.9 or run.reach[0] >= 4.9
            if not fallen and (job.strength == 0 or _miss(strength, job.target) < _miss(job.strength, job.target)):
                job.size, job.strength = float(np.exp(trial[i])), strength
            if fallen or strength > job.target:
                high[i] = trial[i]
            else:
                low[i] = trial[i]
            guess = trial[i] + np.log(job.target / strength) if strength > 0 and not fallen else -np.inf
            trial[i] = guess if low[i] < guess < high[i] else 0.5 * (low[i] + high[i])
        open_ = [i for i in open_ if _miss(jobs[i].strength, jobs[i].target) > 0.03]


def _miss(strength: float, target: float) -> float:
    return float(abs(np.log(max(strength, 1e-9) / target)))


def key_text(settings: Settings, drafts: list[Draft]) -> str:
    """The answers as JSON; the same settings give the same text."""
    answers = []
    for name, draft in zip(names(len(drafts)), drafts, strict=True):
        assert draft.case is not None
        assert draft.strengths is not None
        effects = [
            {"effect": effect, "parameters": parameters, "strength": round(draft.strengths[effect], 4)}
            for effect, parameters in draft.case.effects.items()
        ]
        answers.append(
            {"file": name, "kind": draft.mixture, "effects": effects, "driver": draft.case.driver.description}
        )
    head = {"kind": settings.kind, "seed": settings.seed, "noise": DIFFICULTIES[settings.kind].noise}
    return json.dumps({**head, "recordings": answers}, indent=1) + "\n"


def lines(draft: Draft, velocities: bool) -> Iterator[str]:
    """The CSV of a recording."""
    assert draft.run is not None
    channels = range(4) if velocities else (0, 2)
    yield ",".join(("episode", "time", *(COLUMNS[c] for c in channels), "command"))
    rows, _, episodes = draft.run.measured.shape
    for episode in range(episodes):
        for row in range(rows):
            values = [f"{draft.run.measured[row, c, episode]:.7f}" for c in channels]
            yield ",".join((str(episode), f"{row * PERIOD:.2f}", *values, f"{draft.run.commands[row, episode]:.7f}"))


def main(settings: Settings) -> None:
    """Make the recordings, print the key's SHA-256, then write the key and the recordings."""
    key = key_path(settings.out, settings.key)
    drafts = make(settings)
    seal(
        settings.out,
        key,
        key_text(settings, drafts),
        (lines(draft, DIFFICULTIES[settings.kind].velocities) for draft in drafts),
    )


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from datasets.blind.drafts import RECORDING_SUBSTEPS, Draft, draw_case, lines, stayed
from datasets.blind.kinds import AS_ONE, INSEPARABLE, REST, Effects, drawn, evenly_mixed
from datasets.blind.plant import PERIOD, Array
from datasets.blind.rigs import Rig, draw_rig
from datasets.blind.sealing import as_csv, key_path, names, seal
from datasets.blind.simulation import Case, simulate
from datasets.blind.sizing import SEARCH_SUBSTEPS, Job, draw_job, seek
from datasets.blind.table import make_table

CartPoleKind = Literal["easy", "hard", "large", "rig", "table"]


@dataclass(frozen=True)
class Settings:
    """Which recordings are made, and where they are written."""

    out: Path
    """folder for the recordings"""
    kind: CartPoleKind = "hard"
    """easy: about 1,000 rows, little noise, all states; hard: about 400 rows, much noise, no velocities; large: as
    easy, with effects up to ten times as strong; rig: about 20 s as a lab's machine gives them; table: the recordings
    of datasets.blind.table"""
    count: int = 200
    """how many recordings; the table has its own count"""
    seed: int = 0
    """seed of all random numbers"""
    strengths: tuple[float, float] | None = None
    """weakest and strongest effect, in units of the noise; by default 2 to 30 (easy), 0.7 to 6 (hard), 10 to 300
    (large), and for rig 10 to 300 times 1 mm and 1 mrad"""
    key: Path | None = None
    """file for the answers; by default beside the folder, <out>.key.json"""
    effects: Effects = "core"
    """the catalogue's effects that are drawn: core, as in the sets 2028 and 2029, rest, those beside it, or all"""


@dataclass(frozen=True)
class Difficulty:
    """What a set of the cart-pole fixes."""

    rows: int
    """rows of a recording at 50 ms, approximately"""
    episodes: tuple[int, int]
    """smallest and largest number of episodes"""
    noise: tuple[float, float, float, float]
    """standard deviations, m, m/s, rad, rad/s"""
    velocities: bool
    """whether they are measured, and read by the controller; on a lab's machine they are drawn for the file alone"""
    strengths: tuple[float, float]
    """weakest and strongest effect"""
    mix: dict[str, float]
    """share of the recordings"""
    lab: bool = False
    """whether every recording has a lab's machine of its own: encoders, an unsteady loop, derived velocities"""
    in_pairs: tuple[str, ...] = ()
    """effects that every pair has"""

    @property
    def unit(self) -> Array:
        """Unit of strengths, (2,) in m and rad: the noise; for lab's machines, whose encoders are finer, as easy."""
        return np.array([0.001, 0.001] if self.lab else [self.noise[0], self.noise[2]])


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
    "rig": Difficulty(
        400,
        (3, 6),
        (2e-5, 0.005, 1e-4, 0.005),
        False,
        (10.0, 300.0),
        {"single": 0.5, "pair": 0.25, "none": 0.25},
        lab=True,
        in_pairs=("coulomb_friction",),
    ),
}
"""the sets; a new one goes to the end, since a set's place seeds it"""

EFFECTS_IN = {"none": 0, "single": 1, "pair": 2, "triple": 3, "foreign": 1}
"""number of effects in a recording"""


def make(settings: Settings) -> list[Draft]:
    """Draw and run all recordings."""
    if settings.kind == "table":
        return make_table(settings.seed)
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
    mixtures = evenly_mixed(difficulty.mix, settings.count)
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
    cases = [_draw_case(draft.rng, difficulty, excitation) for draft in drafts]
    # Most recordings that leave the track do so even without effects: these are dropped before the costly search.
    bare = simulate(cases, SEARCH_SUBSTEPS)
    kept = [(draft, case) for draft, case, run in zip(drafts, cases, bare, strict=True) if stayed(run)]
    parts: list[list[Job]] = []
    for draft, case in kept:
        chosen = draw_kinds(draft.rng, draft.mixture, effects, difficulty.in_pairs)
        parts.append([draw_job(draft.rng, name, case, difficulty.strengths) for name in chosen])
    seek([job for own in parts for job in own], difficulty.unit)
    weakest, strongest = difficulty.strengths
    ready = []
    for (draft, case), own in zip(kept, parts, strict=True):
        if all(0.9 * weakest <= job.strength <= 1.1 * strongest for job in own):
            case.effects = {job.name: job.parameters for job in own}
            ready.append((draft, case, own))
    runs = simulate([case for _, case, _ in ready], RECORDING_SUBSTEPS)
    for (draft, case, own), run in zip(ready, runs, strict=True):
        if stayed(run):
            draft.case, draft.run, draft.strengths = case, run, {job.name: job.strength for job in own}


def draw_kinds(rng: np.random.Generator, mixture: str, effects: Effects, in_pairs: tuple[str, ...]) -> list[str]:
    """Names of the effects of a recording, which data can tell apart."""
    if mixture == "none" and (effects == "rest" or (effects == "all" and rng.random() < 0.5)):
        return [REST[int(rng.integers(len(REST)))].name]
    fixed = list(in_pairs) if mixture == "pair" else []
    kinds = [kind.name for kind in drawn(mixture, effects) if kind.name not in fixed]
    apart = INSEPARABLE if effects == "core" else INSEPARABLE + AS_ONE
    while True:
        chosen = fixed + [kinds[i] for i in rng.choice(len(kinds), EFFECTS_IN[mixture] - len(fixed), replace=False)]
        if not any(together <= set(chosen) for together in apart):
            return chosen


def _draw_case(rng: np.random.Generator, difficulty: Difficulty, excitation: float) -> Case:
    episodes = int(rng.integers(difficulty.episodes[0], difficulty.episodes[1] + 1))
    rows, rig = round(difficulty.rows / episodes), Rig(velocities="measured" if difficulty.velocities else "absent")
    if difficulty.lab:
        rig, rows = draw_rig(rng, difficulty.rows * PERIOD, episodes)
    case = draw_case(rng, rows, episodes, np.array(difficulty.noise), rig, difficulty.velocities, excitation)
    return replace(case, turns_exactly=difficulty.lab)


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
        answer = {"file": name, "kind": draft.mixture, "effects": effects, "driver": draft.case.driver.description}
        if settings.kind in ("rig", "table"):
            answer |= {"row": draft.row} if draft.row else {}
            answer["rig"] = draft.case.rig.description
        answers.append(answer)
    head: dict[str, object] = {"kind": settings.kind, "seed": settings.seed}
    if settings.kind != "table":
        head["noise"] = DIFFICULTIES[settings.kind].noise
    return json.dumps({**head, "recordings": answers}, indent=1) + "\n"


def main(settings: Settings) -> None:
    """Make the recordings, print the key's SHA-256, then write the key and the recordings."""
    key = key_path(settings.out, settings.key)
    drafts = make(settings)
    seal(settings.out, key, key_text(settings, drafts), (as_csv(lines(draft)) for draft in drafts))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))

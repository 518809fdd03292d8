"""The search for the size of an effect that gives it a drawn strength."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from datasets.blind.kinds import KINDS, Shape
from datasets.blind.plant import Array
from datasets.blind.simulation import Case, Run, simulate

SEARCH_SUBSTEPS = 20
"""substeps of 2.5 ms in 50 ms while sizes are searched"""


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


def draw_job(rng: np.random.Generator, name: str, case: Case, strengths: tuple[float, float]) -> Job:
    """Draw an effect's shape, and its strength between the weakest and the strongest."""
    kind = KINDS[name]
    shape = kind.draw(rng, case.shape[0] * case.rig.period)
    target = float(np.exp(rng.uniform(*np.log(strengths))))
    return Job(name, shape, replace(case, effects={}), target, float(np.sqrt(kind.low * kind.high)))


def seek(jobs: list[Job], unit: Array, rounds: int = 8) -> None:
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
        runs = simulate([jobs[i].case for i in open_], SEARCH_SUBSTEPS)
        for i, run in zip(open_, runs, strict=True):
            job = jobs[i]
            strength = strength_of(job.name, run, unit)
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


def strength_of(effect: str, run: Run, unit: Array) -> float:
    """Strength of an effect that acts alone in a run, in units of `unit` (m, rad)."""
    return run.sensed_gap(unit) if KINDS[effect].stage == "sensing" else run.predicted_gap(unit)

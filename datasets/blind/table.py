"""Recordings that a diagnosis once got wrong, one for each row of a table, and those that pairs of effects imitate.

Effects and machines are fixed; controllers, first states and noise are drawn from the seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from datasets.blind.drafts import RECORDING_SUBSTEPS, Draft, draw_case, stayed
from datasets.blind.kinds import Shape
from datasets.blind.plant import PERIOD, Array
from datasets.blind.rigs import Rig, Velocities, late_rows, late_steps
from datasets.blind.simulation import Case, Run, simulate
from datasets.blind.sizing import SEARCH_SUBSTEPS, strength_of

CLEAN = (0.001, 0.005, 0.001, 0.005)
"""standard deviations, m, m/s, rad, rad/s: 1 mm, 1 mrad"""
COARSE = (0.005, 0.0, 0.009, 0.0)
"""those of the hard set"""
EXACT = (0.0, 0.0, 0.0, 0.0)
ENCODERS = (1e-4, 2 * np.pi / 4096)
"""m and rad of a count"""

Late = Callable[[np.random.Generator, int, int, float], Array]


@dataclass(frozen=True)
class Row:
    """One recording of the table."""

    name: str
    """what it shows"""
    effects: dict[str, Shape] = field(default_factory=dict)
    """the truth"""
    noise: tuple[float, float, float, float] = CLEAN
    """standard deviations, m, m/s, rad, rad/s"""
    velocities: Velocities = "measured"
    """where they come from"""
    counts: tuple[float, float] = (0.0, 0.0)
    """m and rad of one count of the encoders"""
    late: Late | None = None
    """how the loop is unsteady"""
    most: float = 0.1
    """by how much, in periods"""
    period: float = PERIOD
    """s"""
    rows: int = 125
    """of an episode"""
    episodes: int = 8

    def rig(self, rng: np.random.Generator) -> Rig:
        """Its sensors, and a clock drawn anew."""
        late = None if self.late is None else self.late(rng, self.rows, self.episodes, self.most * self.period)
        return Rig(self.period, late, self.counts, self.velocities)


def _lab(name: str, effects: dict[str, Shape], period: float = PERIOD, late: Late | None = late_steps) -> Row:
    """20 s in one episode, encoders, no velocities; steps last 0 to 20 % longer."""
    return Row(name, effects, EXACT, "absent", ENCODERS, late, 0.2, period, round(20.0 / period), 1)


DRY_AND_GAIN: dict[str, Shape] = {"coulomb_friction": {"force": 4.0}, "actuator_gain": {"scale": 0.8}}

ROWS = (
    Row("cart mass, also a gain and a pole mass", {"cart_mass": {"scale": 1.774}}),
    Row("dry friction", {"coulomb_friction": {"force": 1.42}}),
    Row("pole mass beyond the usual range", {"pole_mass": {"scale": 7.9}}),
    Row("lag and angle offset", {"actuator_lag": {"time_constant": 0.06}, "angle_offset": {"offset": 0.03}}),
    Row("times off the grid", {"viscous_friction": {"coefficient": 2.0}}, late=late_rows),
    Row("the same jitter accumulating", {"viscous_friction": {"coefficient": 2.0}}, late=late_steps),
    Row("encoders", {"viscous_friction": {"coefficient": 2.0}}, EXACT, "absent", ENCODERS),
    Row("dry friction and gain", DRY_AND_GAIN),
    Row("the same without velocities", DRY_AND_GAIN, velocities="absent"),
    Row("delay with measured velocities", {"actuator_delay": {"delay": 0.05}}),
    _lab("lab's machine, 20 ms, nothing", {}, 0.02),
    _lab("lab's machine, 20 ms, viscous friction", {"viscous_friction": {"coefficient": 3.0}}, 0.02),
    _lab("lab's machine, dry friction", {"coulomb_friction": {"force": 1.3}}),
    _lab("lab's machine, dry friction and gain", DRY_AND_GAIN),
    replace(
        _lab("lab's machine, derived velocities", {"viscous_friction": {"coefficient": 3.0}}), velocities="differences"
    ),
    _lab("encoders alone, nothing", {}, late=None),
    _lab("encoders alone, viscous friction", {"viscous_friction": {"coefficient": 3.0}}, late=None),
    _lab("encoders alone, dry friction", {"coulomb_friction": {"force": 3.0}}, late=None),
    replace(_lab("jitter alone, nothing", {}), noise=CLEAN, counts=(0.0, 0.0)),
    _lab(
        "lab's machine, two sensors' clocks apart",
        {"angle_delay": {"delay": 0.02}, "viscous_friction": {"coefficient": 2.0}},
    ),
    Row("a spring at the hinge, also a sensor scale and a pole length", {"pole_spring": {"stiffness": 0.3}}),
    Row("noisy, gain", {"actuator_gain": {"scale": 0.8}}, COARSE, "absent", rows=67, episodes=6),
    Row("noisy, pole mass", {"pole_mass": {"scale": 2.0}}, COARSE, "absent", rows=67, episodes=6),
    # One effect that two others imitate exactly (kinds.INSEPARABLE); a cart mass is above.
    Row("gain, also a cart mass and a pole mass", {"actuator_gain": {"scale": 0.7}}),
    Row("pole mass, also a gain and a cart mass", {"pole_mass": {"scale": 2.0}}),
    Row("tilt, also an angle offset and a push", {"track_tilt": {"angle": 0.03}}),
    Row("angle offset, also a tilt and a push", {"angle_offset": {"offset": 0.03}}),
    Row("push, also a tilt and an angle offset", {"constant_force": {"force": 0.5}}),
    Row("bias, also a tilt and an angle offset", {"actuator_bias": {"offset": 0.02}}),
    Row("friction by direction, also dry friction and a push", {"directional_friction": {"forward": 3, "backward": 1}}),
)
"""in the order of the files"""

EXCITATIONS = (0.3, 0.45, 0.65, 0.85, 1.0)
"""that are tried at once, as shares of the usual strength"""
MIXTURES = ("none", "single", "pair")
"""by the number of effects"""


def make_table(seed: int) -> list[Draft]:
    """Draw and run the recordings of all rows."""
    seeds = np.random.SeedSequence(seed).spawn(len(ROWS))
    drafts = [
        Draft(np.random.default_rng(own), MIXTURES[len(row.effects)], row=row.name)
        for own, row in zip(seeds, ROWS, strict=True)
    ]
    for _ in range(20):
        pending = [(draft, row) for draft, row in zip(drafts, ROWS, strict=True) if draft.run is None]
        if not pending:
            return drafts
        trials = [(draft, _draw(draft.rng, row, level)) for draft, row in pending for level in EXCITATIONS]
        bare = simulate([case for _, case in trials], SEARCH_SUBSTEPS)
        # Of each row, the most excited that stayed.
        kept = {id(draft): (draft, case) for (draft, case), run in zip(trials, bare, strict=True) if stayed(run)}
        runs = simulate([case for _, case in kept.values()], RECORDING_SUBSTEPS)
        for (draft, case), run in zip(kept.values(), runs, strict=True):
            if stayed(run):
                draft.case, draft.run, draft.strengths = case, run, _strengths(case, run)
    raise RuntimeError("some recordings could not be kept on the track; try another seed")


def _draw(rng: np.random.Generator, row: Row, excitation: float) -> Case:
    # The controller of the hard set and of lab's machines has no velocities.
    velocities = row.noise == CLEAN and row.velocities == "measured"
    case = draw_case(rng, row.rows, row.episodes, np.array(row.noise), row.rig(rng), velocities, excitation)
    return replace(case, effects=row.effects, turns_exactly=True)


def _strengths(case: Case, run: Run) -> dict[str, float]:
    """By effect, each alone, in units of 1 mm and 1 mrad."""
    alone = [replace(case, effects={name: values}) for name, values in case.effects.items()]
    runs = [run] if len(alone) == 1 else simulate(alone, SEARCH_SUBSTEPS)
    return {
        name: strength_of(name, own, np.array([0.001, 0.001])) for name, own in zip(case.effects, runs, strict=True)
    }

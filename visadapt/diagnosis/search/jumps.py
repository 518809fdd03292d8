"""The search made with another process noise, where the usual one does not suit what is left unexplained.

A load that is missing from a model moves all joints through the mass matrix, and so does process noise. But a machine
whose parts bend, or whose motors are late, misses its model in each velocity by itself; taken for loads, that falsifies
masses and inertias: of a real double pendulum inertias and a motor were named that closed nothing of the gap. There
process noise is a jump of each velocity.
"""

from __future__ import annotations

from dataclasses import replace

from visadapt.diagnosis.search.search import Search
from visadapt.estimation.fit_states import QUICK

CLEARLY = 50.0
"""Log posterior odds by which jumps must be likelier: with them the source of a real double pendulum is 470 and more
ahead of every effect; that of simulated cart-poles at most 11, of a real one far behind."""


def with_jumps(search: Search) -> Search | None:
    """The same search with jumps of the velocities as process noise, of sets of one and of two effects, where with
    them the source alone is clearly likelier than every effect without them; else None.

    The set to which the search grows with loads as noise is fitted with jumps too: what a transmission that gives, or a
    late motor, does to a velocity looks like a jump, which hides it. On the double pendulum that transmission is the
    first effect found with loads, and none of the first with jumps.

    Where what these leave is not white, larger sets are looked for with coloured noise only (`coloured.py`). Jumps
    describe a resonance of the machine with the power of the whole of it at every frequency, against which a third
    effect hardly counts: of a real double pendulum six effects gained 390 in log odds, none of them the truth, and the
    colour 1,200.
    """
    search.fit_singles()
    other = Search(search.system, replace(search.rows, jumps=True), search.catalogue, jobs=search.jobs)
    if other.source.log_odds < search.best.log_odds + CLEARLY:
        return None
    alone = sorted(other.fit_singles(), key=lambda each: -each.log_odds)
    other.extend(alone[: other.profile.beam_width])
    search.grow_best()
    noise = {"log_process": other.source.fits.log_process, "log_noise": other.source.fits.log_noise}
    other.fit([(search.best.effects, replace(search.best.fits, **noise))], QUICK)
    return other

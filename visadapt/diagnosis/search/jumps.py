"""The search made with another process noise, where the usual one does not suit what is left unexplained.

The usual process noise is a load on a joint: like a load that is missing from a model, it moves all joints through the
mass matrix. But if a machine's parts bend, or its motors are late, each velocity departs from the model independently
of the others. Described as loads, such errors falsify masses and inertias: for a real double pendulum, inertias and a
motor were named that closed nothing of the gap. There, process noise is an independent jump of each velocity.
"""

from __future__ import annotations

from dataclasses import replace

from visadapt.diagnosis.search.search import Search
from visadapt.estimation.fit_states import QUICK

CLEARLY = 50.0
"""Log posterior odds by which the source with jumps must lead the best set with loads as process noise. For a real
double pendulum it leads by 470 or more, for simulated cart-poles by at most 11; for a real one it is far behind."""


def with_jumps(search: Search) -> Search | None:
    """The same search with jumps of the velocities as process noise, over sets of one and of two effects; None unless
    the source alone is clearly likelier with jumps than every effect is with loads as process noise.

    The set to which the search grows with loads is fitted with jumps too. A compliant transmission, or a late motor,
    changes a velocity much as a jump does, so jumps as noise hide these effects: on the double pendulum, the
    transmission is the first effect found with loads, and not among the first with jumps.

    If the innovations of these sets are not white, larger sets are looked for with coloured noise only (`coloured.py`).
    Jumps that are strong enough for a resonance of the machine are as strong at every other frequency, and a third
    effect hardly counts against them: on a real double pendulum, six effects gained 390 in log odds, none of them the
    truth, and coloured noise gained 1,200.
    """
    search.fit_singles()
    rows, rival = replace(search.rows, jumps=True), float(search.best.fits.likelihood[0])
    other = Search(search.system, rows, search.catalogue, jobs=search.jobs, rival=rival)
    if other.source.log_odds < search.best.log_odds + CLEARLY:
        return None
    alone = sorted(other.fit_singles(), key=lambda each: -each.log_odds)
    other.extend(alone[: other.profile.beam_width])
    search.grow_best()
    noise = {"log_process": other.source.fits.log_process, "log_noise": other.source.fits.log_noise}
    other.fit([(search.best.effects, replace(search.best.fits, **noise))], QUICK)
    return other

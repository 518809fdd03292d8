"""Numbers, units, names and lists in words, as reports, warnings and the command line state them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from visadapt.diagnosis.result import Estimate

UNKNOWN = "unknown"

BESIDE_PUSHES = (
    "the rows within pushes were left out, since pushes hide what else acts: the gap and its causes are those of the "
    "other rows"
)
"""The warning of a diagnosis for which pushes were set aside."""

ONE_BY_ONE = "each recording is explained by itself, but not all together"
"""What the warning begins with of recordings between which the machine was changed."""

CHANGES = "the size of an effect changes within the recording"
"""What the warning begins with of a recording in which the size of an effect changes."""

CHANGES_BETWEEN = "the size of an effect changes from one recording to the next"
"""What it begins with where the size is another in each of several recordings."""

A_ROW_LATE = "the commands were moved a row up"
"""What it warns of where each command was recorded a row late."""
PART_LATE = "they were moved earlier by as much"
"""What it warns of where the commands are late by part of a row."""
OWN_CLOCK = "by a clock that is not that of the rows: a command is the mean of what was sent until the next row"
"""What it warns of where the controller sends at other times than the rows'."""
BETWEEN_ROWS = (
    "commands change between the rows: those that are in no row were estimated from the readings, so sizes are not "
    "exact"
)
"""What it warns of where the controller is faster than the rows."""

THINNED = (
    "a log that keeps only some of the commands that were sent makes them late by half the time between those that it "
    "keeps; if this one does, sizes are not exact"
)
"""What it warns of where commands that have stamps of their own act before these."""

OPPOSITE = " has the opposite sign of the source's"
"""What a diagnosis warns of, after the quantity's name, where it inverted a sign of the recording."""

DERIVED = "derived from it on the rig, or filtered; left out"
"""What it warns of where it set a velocity aside."""

LASTING = (
    "errors of readings last, as those of a state estimator do; a gap that is no larger than these errors does not show"
)
"""What it warns of where errors of readings are correlated in time, before it says for how long."""

MISFIT = "root mean square of frames less those drawn by the renderer, in grey levels of 255"
"""`Gap.measure` of a film whose motion shows no gap."""


def number(value: float, digits: int = 3) -> str:
    """A number with this many significant digits; with an exponent below 1e-4 and from 1e6 on."""
    if not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"


LEAST_P = 1e-9  # p-values below it are not told apart: so far out no distribution of errors is known


def chance(p_value: float) -> str:
    """A p-value in words: "p = 0.0004", or "p < 1e-09"."""
    return f"p = {p_value:.2g}" if p_value >= LEAST_P else f"p < {LEAST_P:g}"


def percent(share: float) -> str:
    """A share as a percentage; "unknown" for NaN."""
    return f"{round(100 * share)} %" if math.isfinite(share) else UNKNOWN


def closed(share: float) -> str:
    """A share of the gap that is closed, as a percentage: beyond 100 %, errors below the noise floor are chance."""
    return percent(1.0 if share > 1 else share)


def with_unit(text: str, unit: str) -> str:
    """A number and its unit, which is "1" where there is none."""
    return text if unit in ("1", "") else f"{text} {unit}"


def estimate(one: Estimate) -> str:
    """A parameter's value, rounded to two significant digits of its interval's width."""
    return with_unit(_rounded(one.value, one), one.unit)


def interval(one: Estimate) -> str:
    """A parameter's 90 % interval."""
    low, high = (_rounded(edge, one) if math.isfinite(edge) else "open" for edge in one.ci90)
    return with_unit(f"{low} to {high}", one.unit)


def _rounded(value: float, one: Estimate) -> str:
    width = one.ci90[1] - one.ci90[0]
    if not math.isfinite(width) or width <= 0 or not math.isfinite(value) or width < 1e-6 * abs(value):
        return number(value)
    decimals = 1 - math.floor(math.log10(width))
    if decimals > 6:
        digits = decimals + math.floor(math.log10(abs(value))) if value else 0
        return f"{value:.{max(0, digits)}e}"
    return f"{value:.{decimals}f}" if decimals > 0 else f"{round(value, decimals):.0f}"


def printable(text: str) -> str:
    """The text, with question marks for the bytes of a file's name that are no characters."""
    return text.encode("utf-8", "replace").decode()


def plain(name: str) -> str:
    """A standard name with spaces."""
    return name.replace("_", " ").replace(".", " ")


def listed(words: Sequence[str], last: str = "and") -> str:
    """ "a", "a and b", "a, b and c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}"

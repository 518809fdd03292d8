"""How the effects of a system of one's own are stated, and what their ranges and units follow from."""

from __future__ import annotations

from typing import Any

from visadapt.effects.base import Effect
from visadapt.systems import Variable

ALL_COMMANDS, ALL_SENSORS = "commands", "sensors"
"""Before the dot in the name of an effect on all commands, or on all readings."""

Made = tuple[str, type[Effect], dict[str, Any]]
"""An effect's name, the class it derives from, and its attributes."""


def largest(variable: Variable) -> float:
    """The largest size in a variable's range."""
    return max(abs(variable.low), abs(variable.high))

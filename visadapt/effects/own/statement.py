"""How the effects of a system of one's own are stated, and the names of those on all commands or readings."""

from __future__ import annotations

from typing import Any

from visadapt.effects.base import Effect
from visadapt.systems import System

ALL_COMMANDS, ALL_SENSORS = "commands", "sensors"
"""What stands before the dot in the name of an effect on all commands, or on all readings."""

Made = tuple[str, type[Effect], dict[str, Any]]
"""An effect's name, the class it derives from, and its attributes."""


def delay_of_all(system: type[System]) -> str:
    """Name of the delay that all commands have in common, which passive data cannot tell from that of all sensors."""
    return f"{system.actions[0].name if len(system.actions) == 1 else ALL_COMMANDS}.actuator_delay"

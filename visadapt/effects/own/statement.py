"""How the effects of a system of one's own are stated, and the names of those on all commands or readings."""

from __future__ import annotations

import math
import re
from typing import Any

from visadapt.effects.base import Effect
from visadapt.systems import System, Variable

ALL_COMMANDS, ALL_SENSORS = "commands", "sensors"
"""What stands before the dot in the name of an effect on all commands, or on all readings."""

Made = tuple[str, type[Effect], dict[str, Any]]
"""An effect's name, the class it derives from, and its attributes."""


MIN_RANGE = 4 * math.pi
"""Range of an angle, rad, above which what returns in every turn is told from what acts at single angles."""


def turns(angle: Variable) -> bool:
    """Whether a position is an angle of more than two turns."""
    return angle.unit == "rad" and angle.high - angle.low > MIN_RANGE


STILL = re.compile(
    r"[kcm]?m|m3|[cdm]?[lL]|K|°C|degC|[mu]?A|[mk]?V|[hkM]?Pa|m?bar|[mk]?mol(/.*)?|k?g(/.*)?|(m3|[cdm]?[lL])/(s|min|h)|"
    r"[kM]?[JW]|%"
)
"""Units of levels, temperatures, currents, pressures, amounts and flows: of what does not move"""


def slides(position: Variable | None, velocity: Variable) -> bool:
    """Whether a coordinate moves, so that dry friction can hold it; a level, a temperature or a current does not."""
    return position is not None or STILL.fullmatch(velocity.unit) is None


def delay_of_all(system: type[System]) -> str:
    """Name of the delay that all commands have in common, which passive data cannot tell from that of all sensors."""
    return f"{system.actions[0].name if len(system.actions) == 1 else ALL_COMMANDS}.actuator_delay"

"""The map between a gymnasium environment's numbers and frames and ours, declared in code or in a TOML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from visadapt.storage.toml_file import is_number, read_toml
from visadapt.systems import System
from visadapt.targets.base import TargetError

ASPECT_TOLERANCE = 0.01
"""Relative difference between the aspects of crop and frame; more would distort a turning pole."""


@dataclass(frozen=True)
class Entry:
    """One entry of the environment's observation or action vector, and the linear map between it and our variable.

    >>> import visadapt as va
    >>> va.Entry(index=2, scale=-1.0).offset
    0.0
    """

    index: int
    scale: float = 1.0
    """negative where the environment's sign is the opposite"""
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.index, int) or isinstance(self.index, bool) or self.index < 0:
            raise TargetError(f"index must be a whole number from 0 on, got {self.index!r}")
        for name, value in (("scale", self.scale), ("offset", self.offset)):
            if not is_number(value):
                raise TargetError(f"{name} must be a finite number, got {value!r}")
        if self.scale == 0:
            raise TargetError("scale must not be 0")


@dataclass(frozen=True)
class EnvMap:
    """The map of an environment.

    A TOML file has the same names: `actions`, `period`, `crop`, `contrast`, `width`, `height` at its top, and below
    them the tables `[states]` (`x = { index = 0 }`), `[limits]`, `[start]` and `[options]`.

    >>> import visadapt as va
    >>> states = {"x": va.Entry(0), "theta": va.Entry(1), "x_dot": va.Entry(2), "theta_dot": va.Entry(3)}
    >>> va.EnvMap(states, actions=(va.Entry(0),), crop=(0, 0, 240, 200)).height
    100
    """

    states: Mapping[str, Entry]
    """by the name of our state: state = scale observation[index] + offset, in SI units"""
    actions: tuple[Entry, ...]
    """for each of our commands: action[index] = scale command + offset; the other entries are 0"""
    period: float | None = None
    """s between actions; None: what the environment states, its `tau`, `dt` or `render_fps`"""
    crop: tuple[int, int, int, int] | None = None
    """left, top, right, bottom in px of the environment's frame; right and bottom are the first px left out. None: the
    whole frame"""
    contrast: tuple[float, float] = (0.0, 255.0)
    """grey levels, 0 to 255, that become black and white"""
    limits: Mapping[str, float] = field(default_factory=dict)
    """by the name of our state: its largest absolute value, beyond which an episode ends"""
    start: Mapping[str, float] | None = None
    """by the name of our state: half-width, around 0, of the uniform distribution in which episodes start; 0 for states
    that are not named. None: the environment's own reset"""
    options: Mapping[str, Any] = field(default_factory=dict)
    """arguments of gymnasium.make, such as the size of the frame and the camera's place"""
    width: int | None = None
    """px, of our frames; None: in proportion to the crop"""
    height: int = 100
    """px"""

    def __post_init__(self) -> None:
        for name, side in (("height", self.height), ("width", self.width)):
            if side is not None and not (_is_positive(side) and isinstance(side, int)):
                raise TargetError(f"{name} must be a positive whole number of px, got {side!r}")
        if self.crop is not None:
            self._check_crop(*self.crop)
        if self.period is not None and not _is_positive(self.period):
            raise TargetError(f"period must be a positive number of seconds, got {self.period!r}")
        numbers = all(isinstance(grey, int | float) for grey in self.contrast)
        if len(self.contrast) != 2 or not numbers or not self.contrast[0] < self.contrast[1]:
            raise TargetError(f"contrast must be two rising grey levels, got {self.contrast!r}")
        if not self.actions:
            raise TargetError("actions is empty: say which entry of the environment's action our command sets")
        for table, entries in (("limits", self.limits), ("start", self.start or {})):
            for name, number in entries.items():
                if not _is_positive(number):
                    raise TargetError(f"{table}: {name} must be positive, got {number!r}")

    def _check_crop(self, *crop: int) -> None:
        if len(crop) != 4 or not all(isinstance(edge, int) for edge in crop):
            raise TargetError(f"crop must be left, top, right, bottom in whole px, got {crop!r}")
        left, top, right, bottom = crop
        if not (0 <= left < right and 0 <= top < bottom):
            raise TargetError(f"crop {crop} holds no pixel: left < right and top < bottom, all from 0 on")
        self._check_aspect(f"crop {crop}", right - left, bottom - top)

    def _check_aspect(self, part: str, columns: int, rows: int) -> None:
        wanted, given = self._width(columns, rows) / self.height, columns / rows
        if self.width is not None and abs(given / wanted - 1) > ASPECT_TOLERANCE:
            raise TargetError(
                f"{part} is {columns} x {rows} px, {given:.3f} wide for 1 high; "
                f"frames of {self.width} x {self.height} px need {wanted:.3f}"
            )

    def _width(self, columns: int, rows: int) -> int:
        """Width in px of the frames that a crop of these columns and rows becomes."""
        return round(self.height * columns / rows) if self.width is None else self.width

    @classmethod
    def load(cls, path: str | Path) -> EnvMap:
        """Read a map from a TOML file.

        Raises:
            TargetError: the file is missing or no TOML, a key is unknown, missing or impossible; names file and key.
        """
        table = read_toml(path, TargetError)
        known = [item.name for item in fields(cls)]
        for key in table:
            if key not in known:
                raise TargetError(f"{path}: unknown key {key!r}; there are {', '.join(known)}")
        for key in ("states", "actions"):
            if key not in table:
                raise TargetError(f"{path}: {key!r} is missing")
        try:
            states = {name: Entry(**entry) for name, entry in table.pop("states").items()}
            actions = tuple(Entry(**entry) for entry in table.pop("actions"))
            for key in {"crop", "contrast"} & table.keys():
                table[key] = tuple(table[key])
            return cls(states=states, actions=actions, **table)
        except (TargetError, TypeError, AttributeError, ArithmeticError) as error:
            raise TargetError(f"{path}: {error}") from error

    def check(self, name: str, system: type[System], n_observation: int, n_action: int) -> None:
        """Raises TargetError unless the map fits the environment `name` and our system."""
        ours = [variable.name for variable in system.states]
        if sorted(self.states) != sorted(ours):
            raise TargetError(f"{name}: the map is of the states {', '.join(self.states)}; ours are {', '.join(ours)}")
        for does, entries in (("limits", self.limits), ("starts", self.start or {})):
            for state in entries:
                if state not in ours:
                    raise TargetError(f"{name}: the map {does} {state!r}; our states are {', '.join(ours)}")
        if len(self.actions) != len(system.actions):
            count = len(system.actions)
            raise TargetError(f"{name}: the map has {len(self.actions)} actions, {system.name} has {count}")
        read = [entry.index for entry in self.states.values()]
        if twice := [name for name, entry in self.states.items() if read.count(entry.index) > 1]:
            raise TargetError(f"{name}: the map takes {' and '.join(twice)} from the same entry of the observation")
        written = [entry.index for entry in self.actions]
        if again := [index for index in written if written.count(index) > 1]:
            raise TargetError(f"{name}: the map sets action entry {again[0]} more than once")
        taken = [(f"takes {state} from observation", entry, n_observation) for state, entry in self.states.items()]
        for does, entry, count in (*taken, *(("sets action", entry, n_action) for entry in self.actions)):
            if entry.index >= count:
                raise TargetError(f"{name}: the map {does} entry {entry.index}; there are {count}, counted from 0")

    def check_range(
        self, name: str, system: type[System], low: NDArray[np.floating], high: NDArray[np.floating]
    ) -> None:
        """Raises TargetError where a command of our system leaves the actions (n_action,) that the environment takes.

        It would clip them, and the machine would do less than what is recorded.
        """
        for entry, ours in zip(self.actions, system.actions, strict=True):
            least, most = sorted(entry.offset + entry.scale * command for command in (ours.low, ours.high))
            rounding = 1e-6 * max(abs(least), abs(most))
            if least < low[entry.index] - rounding or most > high[entry.index] + rounding:
                raise TargetError(
                    f"{name}: the map sets action entry {entry.index} from {least:g} to {most:g}, the environment "
                    f"takes {low[entry.index]:g} to {high[entry.index]:g}: change scale or offset if its unit is "
                    f"another one; if the machine takes less, a {system.name} whose {ours.name} has that range is right"
                )

    def state(self, observation: NDArray[np.floating], system: type[System]) -> NDArray[np.floating]:
        """Our state (n_state,), in our system's order, for an observation."""
        entries = [self.states[variable.name] for variable in system.states]
        return np.array([entry.scale * observation[entry.index] + entry.offset for entry in entries])

    def observation(
        self, state: NDArray[np.floating], system: type[System], rest: NDArray[np.floating]
    ) -> NDArray[np.floating]:
        """The observation for our state; entries that the map does not name are those of `rest`."""
        out = np.array(rest, dtype=float)
        for value, variable in zip(state, system.states, strict=True):
            entry = self.states[variable.name]
            out[entry.index] = (value - entry.offset) / entry.scale
        return out

    def action(self, command: NDArray[np.floating], size: int) -> NDArray[np.floating]:
        """The environment's action (size,) for our command (n_action,)."""
        out = np.zeros(size)
        for value, entry in zip(command, self.actions, strict=True):
            out[entry.index] = entry.scale * value + entry.offset
        return out

    def frame(self, name: str, picture: object) -> NDArray[np.uint8]:
        """Our frame (height, width) of a picture (rows, columns, 3) or (rows, columns) uint8 of the environment."""
        sizes = (2, ()), (3, (3,))  # number of axes, and the size of those after rows and columns
        if (
            not isinstance(picture, np.ndarray)
            or picture.dtype != np.uint8
            or (picture.ndim, picture.shape[2:]) not in sizes
        ):
            got = f"{picture.dtype} {picture.shape}" if isinstance(picture, np.ndarray) else type(picture).__name__
            raise TargetError(f"{name}: render() gave {got}; a picture (rows, columns, 3) of uint8 is needed")
        left, top, right, bottom = self.crop or (0, 0, picture.shape[1], picture.shape[0])
        if self.crop is None:
            self._check_aspect(f"{name}: its frame", right, bottom)
        if right > picture.shape[1] or bottom > picture.shape[0]:
            raise TargetError(
                f"{name}: its frames are {picture.shape[1]} x {picture.shape[0]} px, "
                f"but the crop reaches to column {right} and row {bottom}: change the crop or the frame's size"
            )
        # In floating point, so that stretching the contrast of a dark picture does not leave gaps between grey levels.
        part = picture[top:bottom, left:right].astype(np.float32)
        grey = cv2.cvtColor(part, cv2.COLOR_RGB2GRAY) if part.ndim == 3 else part
        width = self._width(right - left, bottom - top)
        small = cv2.resize(grey, (width, self.height), interpolation=cv2.INTER_AREA)
        low, high = self.contrast
        return np.clip(np.rint((small - low) * (255 / (high - low))), 0, 255).astype(np.uint8)


def _is_positive(value: Any) -> bool:
    """Whether it is a finite number above 0."""
    return is_number(value) and value > 0

"""One step of a quadrotor or a fixed wing with the core of the catalogue: the model of the baselines on flights.

The physics are those that made the recordings (`datasets.blind.flight_plants`), which a diagnoser would not have: that
favours the baselines. All 13 states are measured, and the noise is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.fitting import Candidate, Free, on_any, one
from benchmarks.blind.onestep import Array, Values, actuate, episodes_of
from datasets.blind import flight_kinds as blind_flight_kinds
from datasets.blind.flight_control import PERIODS
from datasets.blind.flight_plants import PLANTS, RESTING, Motion, step
from datasets.blind.flights import ACTIONS, NOISE, STATES, as_states

SUBSTEPS = 4

NEUTRAL: Values = {
    **blind_flight_kinds.NEUTRAL,
    "measurement_delay.delay": 0.0,
    # amplitude cos(phase), -amplitude sin(phase): linear, unlike the two themselves.
    "periodic_force.cosine": 0.0,
    "periodic_force.sine": 0.0,
    "periodic_force.frequency": 1.0,
    "periodic_wind.frequency": 1.0,
}
"""every parameter at the value without effect"""


@dataclass
class FlightSteps:
    """A recording as pairs of rows."""

    system: str
    commands: Array
    """(episodes, rows, 4), zero after the end of a short episode"""
    where: tuple[NDArray[np.intp], NDArray[np.intp]]
    """episode and row of each pair's first, (n,) each"""
    state: Array
    """(n, 13) measured"""
    after: Array
    """(n, 13) one row later"""
    neutral: Values = field(default_factory=lambda: dict(NEUTRAL))
    scale: Array = field(init=False)
    """(13, 1) standard deviations of the source's one-step error, by the noise of both rows"""

    def __post_init__(self) -> None:
        small, source = 1e-4, self.predicted(self.state, self.neutral)
        shifted = [self.predicted(self.state + small * unit, self.neutral) for unit in np.eye(13)]
        slopes = np.stack([(each - source) / small for each in shifted], 1)
        self.scale = np.sqrt(NOISE**2 + np.mean(slopes**2, 0).T @ NOISE**2)[:, None]

    @property
    def size(self) -> int:
        """Number of residuals."""
        return int(self.state.size)

    @property
    def rows_lost(self) -> NDArray[np.bool_]:
        """(n,): none, since no flight has lost rows."""
        return np.zeros(len(self.state), bool)

    angle_held = rows_lost

    def residual(self, p: Values) -> Array:
        """(13, n) in standard deviations of the noise."""
        return (self.after - self.predicted(self.state, p)).T / self.scale

    def predicted(self, state: Array, p: Values) -> Array:
        """States (n, 13) a row after `state` (n, 13)."""
        period = PERIODS[self.system]
        h = period / SUBSTEPS
        inputs = np.stack([actuate(self.commands[..., k], p, period, SUBSTEPS) for k in range(4)], -1)[self.where]
        amplitude, phase = np.hypot(p["periodic_force.cosine"], p["periodic_force.sine"]), 0.0
        if amplitude > 0:
            phase = -np.arctan2(p["periodic_force.sine"], p["periodic_force.cosine"])
        own = {**p, "periodic_force.amplitude": amplitude, "periodic_force.phase": phase}
        parameters = {name: np.full(len(state), value) for name, value in own.items()}
        at = _motion(state)
        for k in range(SUBSTEPS):
            # The plants accept one time or a time for every row.
            time: float = (self.where[1] * period + k * h).astype(np.float64)  # type: ignore[assignment]
            at = step(PLANTS[self.system], parameters, time, at, inputs[:, k], h)
        return as_states(at, state[:, 6:10])


def _motion(state: Array) -> Motion:
    w, x, y, z = (state[:, 6:10] / np.linalg.norm(state[:, 6:10], axis=1, keepdims=True)).T
    turned = np.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        -1,
    ).reshape(-1, 3, 3)
    return Motion(state[:, :3], state[:, 3:6], turned, state[:, 10:], RESTING)


def system_of(path: Path) -> str:
    """The system of a recording, by the names of its commands."""
    with path.open(encoding="utf-8") as file:
        columns = set(file.readline().strip().split(","))
    return next((name for name, actions in ACTIONS.items() if columns.issuperset(actions)), "cartpole")


def read_flights(path: Path) -> FlightSteps:
    """Read one recording."""
    system = system_of(path)
    episodes = episodes_of(path)
    commands = np.zeros((len(episodes), max(map(len, episodes.values())), 4))
    states, afters, places = [], [], []
    for number, episode in enumerate(episodes.values()):
        state = _columns(episode, STATES)
        commands[number, : len(episode)] = _columns(episode, ACTIONS[system])
        states.append(state[:-1])
        # Of the two signs of a quaternion, the one nearer to the row before.
        signs = np.where((state[1:, 6:10] * state[:-1, 6:10]).sum(1) < 0, -1.0, 1.0)
        afters.append(np.concatenate([state[1:, :6], state[1:, 6:10] * signs[:, None], state[1:, 10:]], 1))
        places.append(np.stack([np.full(len(state) - 1, number), np.arange(len(state) - 1)]))
    first = np.concatenate(places, 1)
    return FlightSteps(system, commands, (first[0], first[1]), np.concatenate(states), np.concatenate(afters))


def _columns(lines: Sequence[dict[str, str]], names: Sequence[str]) -> Array:
    return np.array([[float(line[name]) for name in names] for line in lines])


def flight_candidates(system: str) -> list[Candidate]:
    """The core of the catalogue, with grids of frequencies, phases and directions."""
    frequencies = [float(f) for f in np.geomspace(0.2, 2.5, 10)]
    force = tuple(Free(f"periodic_force.{name}", -10, 10, 0.001) for name in ("cosine", "sine", "offset"))
    drag = 0.0 if system == "fixed_wing" else 0.3
    winds = [
        {
            "periodic_wind.frequency": f,
            "periodic_wind.phase": phase,
            "periodic_wind.direction": direction,
            "periodic_wind.amplitude": 1.0,
            "periodic_wind.coefficient": drag,
        }
        for f in frequencies
        for phase in (0.0, 1.5)
        for direction in (-0.8, 0.8)
    ]
    blowing = (
        Free("periodic_wind.amplitude", 0.0, 10.0, 0.001),
        Free("periodic_wind.frequency", 0.05, 5.0, 0.0001),
        Free("periodic_wind.phase", -7.0, 7.0, 0.001),
        Free("periodic_wind.direction", -1.6, 1.6, 0.001),
    )
    # On the wing, wind acts without a drag coefficient.
    dragging = ("wind", "periodic_wind") if drag else ()
    coefficients = tuple(Free(f"{name}.coefficient", 0.0, 3.0, 0.0001) for name in dragging)
    steady = tuple(Free(f"wind.velocity_{axis}", -10.0, 10.0, 0.001) for axis in "xyz")
    both = [
        *on_any(0.8, 0.4, 0.15),
        Candidate(
            "periodic_force",
            (*force, Free("periodic_force.frequency", 0.05, 5.0, 0.0001)),
            tuple({"periodic_force.frequency": f} for f in frequencies),
            4,
        ),
        one("linear_drag.coefficient", 0.0, 3.0, 0.0001, 0.0),
        one("quadratic_drag.coefficient", 0.0, 3.0, 0.0001, 0.0),
        Candidate("wind", steady + coefficients[:1], ({"wind.coefficient": drag},), 3 + bool(coefficients)),
        Candidate("periodic_wind", blowing + coefficients[1:], tuple(winds), 4 + bool(coefficients)),
        one("thrust_gain.scale", 0.3, 2.0, 0.0001, 1.0),
    ]
    if system == "fixed_wing":
        return [
            *both,
            *(one(f"{name}.scale", 0.2, 4.0, 0.0001, 1.0) for name in ("mass", "lift_slope", "drag")),
            _several("control_effectiveness", ("scale_elevator", "scale_aileron", "scale_rudder"), 0.1, 2.0, 0.0001),
            _several("trim_offset", ("elevator", "aileron", "rudder"), -0.2, 0.2, 0.00001),
        ]
    return [
        *both,
        one("payload.mass", 0.0, 1.0, 0.0001, 0.0),
        one("battery_sag.rate", 0.0, 0.2, 0.00001, 0.0),
        _several("center_of_mass_offset", ("x", "y"), -0.1, 0.1, 0.000001),
        _several("inertia", ("scale_x", "scale_y", "scale_z"), 0.3, 4.0, 0.0001),
        _several("rotor_efficiency", tuple(f"scale_{k}" for k in (1, 2, 3, 4)), 0.1, 1.5, 0.00001),
    ]


def _several(effect: str, names: Sequence[str], low: float, high: float, step: float) -> Candidate:
    return Candidate(effect, tuple(Free(f"{effect}.{name}", low, high, step) for name in names), ({},), len(names))

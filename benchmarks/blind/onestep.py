"""One step of a cart-pole with the core of the catalogue: the model of the baselines (numpy alone).

From the measured state at row t it predicts the state at row t + 1. Velocities that were not measured are central
differences, corrected for the known jumps of the command. Effects are parameters of one model; at `NEUTRAL` it is the
source. Held readings (dropout, frozen_zone) show as rows that repeat exactly, and are left out of the sum.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Values = dict[str, float]

PERIOD = 0.05
SUBSTEPS = 5
ALL_STATES = [0, 1, 2, 3]

NEUTRAL: Values = {
    "actuator_gain.scale": 1.0,
    "actuator_bias.offset": 0.0,
    "actuator_delay.delay": 0.0,
    "actuator_lag.time_constant": 0.0,
    "actuator_deadzone.width": 0.0,
    "actuator_saturation.limit": 1.0,
    "actuator_backlash.width": 0.0,
    "constant_force.force": 0.0,
    # amplitude cos(phase), -amplitude sin(phase): linear, unlike the two themselves.
    "periodic_force.cosine": 0.0,
    "periodic_force.sine": 0.0,
    "periodic_force.frequency": 1.0,
    "periodic_force.offset": 0.0,
    "gust.force": 0.0,
    "gust.start": 0.0,
    "gust.end": 0.0,
    "viscous_friction.coefficient": 0.0,
    "coulomb_friction.force": 0.0,
    "quadratic_drag.coefficient": 0.0,
    "friction_patch.coefficient": 0.0,
    "friction_patch.start": 0.0,
    "friction_patch.end": 0.0,
    "spring.stiffness": 0.0,
    # stiffness times rest, N: linear, unlike the rest itself.
    "spring.pull": 0.0,
    "pole_damping.coefficient": 0.0,
    "track_tilt.angle": 0.0,
    "cart_mass.scale": 1.0,
    "pole_mass.scale": 1.0,
    "pole_length.scale": 1.0,
    "angle_offset.offset": 0.0,
    "measurement_delay.delay": 0.0,
    "sensor_scale.position": 1.0,
    "sensor_scale.angle": 1.0,
}
"""every parameter at the value without effect"""


@dataclass
class Steps:
    """A recording as pairs of rows."""

    commands: Array
    """(episodes, rows), zero after the end of a short episode"""
    where: tuple[NDArray[np.intp], NDArray[np.intp]]
    """episode and row of each pair's first, (n,) each"""
    state: Array
    """(4, n) measured: m, m/s, rad, rad/s"""
    after: Array
    """(4, n) one row later"""
    rows_lost: NDArray[np.bool_]
    """(n,): whether either row repeats the one before"""
    angle_held: NDArray[np.bool_]
    """(n,): whether an angle of either repeats, and the position does not"""
    rate: float
    """share of rows that repeat the row before"""
    zone: tuple[float, float] | None
    """rad: the angles between which readings hold"""
    noise: Array
    """(4,) standard deviations of the states, known"""
    channels: list[int]
    """columns of the state whose prediction errors count: the measured ones alone. Where velocities are not
    measured they are central differences, whose noise is that of the positions they are made of"""
    scale: Array = field(init=False)
    """(channels, 1) standard deviations of the source's one-step error, by the noise of both rows"""
    system: str = "cartpole"
    neutral: Values = field(default_factory=lambda: dict(NEUTRAL))

    def __post_init__(self) -> None:
        if self.channels != ALL_STATES:
            # The error of x_(t+1) is then half a second difference, with weights (1, -2, 1) / 2 on the noise.
            self.scale = (self.noise[self.channels] * 1.5**0.5)[:, None]
            return
        small, still = 1e-4, np.zeros((1, SUBSTEPS))
        slopes = np.concatenate([advance(small * unit[:, None], still, np.zeros(1), NEUTRAL) for unit in np.eye(4)], 1)
        self.scale = np.sqrt(self.noise**2 + ((slopes / small) ** 2) @ self.noise**2)[:, None]

    @property
    def time(self) -> Array:
        """s since the episode began, (n,)."""
        return self.where[1].astype(np.float64) * PERIOD

    @property
    def size(self) -> int:
        """Number of residuals."""
        return len(self.channels) * self.state.shape[1]

    def residual(self, p: Values) -> Array:
        """(channels, n) in standard deviations of the noise."""
        gain = np.array([p["sensor_scale.position"]] * 2 + [p["sensor_scale.angle"]] * 2)[:, None]
        offset = np.array([0.0, 0.0, p["angle_offset.offset"], 0.0])[:, None]
        inputs = actuate(self.commands, p)[self.where]
        predicted = advance((self.state - offset) / gain, inputs, self.time, p) * gain + offset
        return (self.after - predicted)[self.channels] / self.scale


def actuate(commands: Array, p: Values, period: float = PERIOD, substeps: int = SUBSTEPS) -> Array:
    """Motor inputs (episodes, rows, substeps) in units of the command.

    A delayed measurement is equivalent to a delayed command: the two delays add up.
    """
    u: Array = np.repeat(commands, substeps, 1)
    delay = (p["actuator_delay.delay"] + p["measurement_delay.delay"]) * substeps / period
    if delay > 0:
        whole, part = int(delay), delay % 1
        padded = np.pad(u, ((0, 0), (whole + 1, 0)))
        u = (1 - part) * padded[:, 1 : 1 + u.shape[1]] + part * padded[:, : u.shape[1]]
    if half := p["actuator_backlash.width"] / 2:
        play, inputs, u = np.zeros(len(u)), u, np.empty_like(u)
        for k in range(u.shape[1]):
            play = np.minimum(np.maximum(play, inputs[:, k] - half), inputs[:, k] + half)
            u[:, k] = play
    u = np.copysign(np.maximum(np.abs(u) - p["actuator_deadzone.width"], 0.0), u)
    u = np.clip(u, -p["actuator_saturation.limit"], p["actuator_saturation.limit"])
    u = p["actuator_gain.scale"] * u + p["actuator_bias.offset"]
    if p["actuator_lag.time_constant"] > 1e-6:
        ratio = period / substeps / p["actuator_lag.time_constant"]
        keep = np.exp(-ratio)
        lagged, inputs, u = np.zeros(len(u)), u, np.empty_like(u)
        for k in range(u.shape[1]):
            # Its mean over the substep.
            u[:, k] = inputs[:, k] + (lagged - inputs[:, k]) * (1 - keep) / ratio
            lagged = inputs[:, k] + (lagged - inputs[:, k]) * keep
    return u.reshape(*commands.shape, substeps)


def advance(state: Array, inputs: Array, time: Array, p: Values) -> Array:
    """(4, n) one period after `state` under motor inputs (n, SUBSTEPS), by the midpoint rule."""
    h = PERIOD / SUBSTEPS
    for k in range(SUBSTEPS):
        now = time + k * h
        middle = state + 0.5 * h * rates(state, inputs[:, k], now, p)
        state = state + h * rates(middle, inputs[:, k], now + 0.5 * h, p)
    return state


def rates(s: Array, u: Array, t: Array, p: Values) -> Array:
    """Barto et al. (1983) with a force on the cart (N), a torque at the pivot (N m) and a tilted gravity."""
    x, v, angle, rate = s
    cart, pole, half = p["cart_mass.scale"], 0.1 * p["pole_mass.scale"], 0.5 * p["pole_length.scale"]
    total, moment, tilt = cart + pole, pole * half, p["track_tilt.angle"]
    turn = 2 * np.pi * p["periodic_force.frequency"] * t
    force = (
        30.0 * u
        + p["constant_force.force"]
        + p["periodic_force.cosine"] * np.cos(turn)
        + p["periodic_force.sine"] * np.sin(turn)
        + p["periodic_force.offset"]
        + p["gust.force"] * ((t >= p["gust.start"]) & (t < p["gust.end"]))
        - p["viscous_friction.coefficient"] * v
        # Smoothed within 1 cm/s, so that it has a derivative.
        - p["coulomb_friction.force"] * np.tanh(v / 0.01)
        - p["quadratic_drag.coefficient"] * v * np.abs(v)
        - p["friction_patch.coefficient"] * v * ((x >= p["friction_patch.start"]) & (x < p["friction_patch.end"]))
        - p["spring.stiffness"] * x
        + p["spring.pull"]
        - total * 9.8 * np.sin(tilt)
    )
    torque = moment * 9.8 * np.sin(angle - tilt) - p["pole_damping.coefficient"] * rate
    sine, cosine = np.sin(angle), np.cos(angle)
    push = (force + moment * rate**2 * sine) / total
    turning = (torque / moment - cosine * push) / (half * (4 / 3 - pole * cosine**2 / total))
    return np.stack((v, push - moment * turning * cosine / total, rate, turning))


def episodes_of(path: Path) -> dict[str, list[dict[str, str]]]:
    """The lines of a recording by their episode."""
    episodes: dict[str, list[dict[str, str]]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            episodes.setdefault(line["episode"], []).append(line)
    return episodes


def read_steps(path: Path) -> Steps:
    """Read one recording; its noise is that of its set, which the columns identify."""
    episodes = episodes_of(path)
    fast = "x_dot" in next(iter(episodes.values()))[0]
    rows = max(len(episode) for episode in episodes.values())
    commands = np.zeros((len(episodes), rows))
    parts: list[tuple[NDArray[np.intp], ...]] = []
    states, afters, lost, held, repeats = [], [], [], [], []
    lowest, highest = np.inf, -np.inf
    for number, episode in enumerate(episodes.values()):
        column = {name: np.array([float(line[name]) for line in episode]) for name in episode[0] if name != "episode"}
        commands[number, : len(episode)] = column["command"]
        x, theta = column["x"], column["theta"]
        v, w = (column["x_dot"], column["theta_dot"]) if fast else (np.gradient(x, PERIOD), np.gradient(theta, PERIOD))
        same_angle = np.diff(theta, prepend=np.nan) == 0
        same_row = same_angle & (np.diff(x, prepend=np.nan) == 0)
        only_angle = same_angle & ~same_row
        repeats.append(same_row[1:])
        if only_angle.any():
            live = np.flatnonzero(~same_angle)
            between = np.interp(np.flatnonzero(only_angle), live, theta[live])
            lowest, highest = min(lowest, between.min()), max(highest, between.max())
        s = np.stack((x, v, theta, w))
        if not fast:
            # The error of a central difference from the command's jump at its middle: P/4 (a_t - a_(t-1)).
            now, before = (
                rates(s, u, np.zeros(len(x)), NEUTRAL) for u in (column["command"], _late(column["command"]))
            )
            s[[1, 3]] -= PERIOD / 4 * (now - before)[[1, 3]]
        # Central differences are undefined at the ends, and affected by a repeated row on either side.
        margin = 0 if fast else 1
        first = np.arange(margin, len(x) - 1 - margin)
        parts.append((np.full(len(first), number), first))
        states.append(s[:, first])
        afters.append(s[:, first + 1])
        lost.append(_touched(same_row, margin)[first])
        held.append(_touched(only_angle, margin)[first])
    x_noise, theta_noise = (0.001, 0.001) if fast else (0.005, 0.009)
    differences = 1 / (np.sqrt(2) * PERIOD)
    v_noise, w_noise = (0.005, 0.005) if fast else (x_noise * differences, theta_noise * differences)
    return Steps(
        commands,
        (np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])),
        np.concatenate(states, 1),
        np.concatenate(afters, 1),
        np.concatenate(lost),
        np.concatenate(held),
        float(np.concatenate(repeats).mean()),
        (float(lowest), float(highest)) if highest >= lowest else None,
        np.array([x_noise, v_noise, theta_noise, w_noise]),
        ALL_STATES if fast else [0, 2],
    )


def _late(command: Array) -> Array:
    return np.concatenate(([0.0], command[:-1]))


def _touched(same: NDArray[np.bool_], margin: int) -> NDArray[np.bool_]:
    """Whether a pair that begins at a row uses a repeated row, directly or through a central difference."""
    return np.array([same[max(0, k - margin) : k + 2 + margin].any() for k in range(len(same))])

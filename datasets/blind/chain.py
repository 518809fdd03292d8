"""Actuation and sensing of the blind recordings: from a command to the motor's input, from a state to its reading.

The actuation chain runs delay, backlash, dead zone, saturation, gain, bias, lag; the sensing chain runs delay, scale,
offset, noise, and last the effects that hold a reading. Widths, limits and offsets of the actuation chain are in units
of the command. Before an episode commands are zero, the lag has settled on the bias, and the machine rests in its
first state.
"""

from __future__ import annotations

import numpy as np

from datasets.blind.plant import PERIOD, Array, Parameters

NEUTRAL: dict[str, float] = {
    "actuator_delay.delay": 0.0,
    "actuator_backlash.width": 0.0,
    "actuator_deadzone.width": 0.0,
    "actuator_saturation.limit": np.inf,
    "actuator_gain.scale": 1.0,
    "actuator_bias.offset": 0.0,
    "actuator_lag.time_constant": 0.0,
    "directional_gain.share": 0.0,
    "even_motor.coefficient": 0.0,
    "fading_gain.rate": 0.0,
    "angle_offset.offset": 0.0,
    "position_offset.offset": 0.0,
    "measurement_delay.delay": 0.0,
    "sensor_scale.position": 1.0,
    "sensor_scale.angle": 1.0,
    "frozen_zone.start": np.inf,
    "frozen_zone.end": -np.inf,
    "frozen_zone.holds_rate": 0.0,
    "dropout.rate": 0.0,
    "encoder_ripple.amplitude": 0.0,
    "encoder_ripple.wavelength": 1.0,
    "encoder_ripple.phase": 0.0,
    "angle_drift.rate": 0.0,
    "angle_quantisation.step": 0.0,
}
"""every parameter of both chains at the value without effect: s, units of the command, m, rad, 1/s, rad/s"""


class Actuation:
    """The actuation chains of n machines, with their memory."""

    def __init__(self, parameters: Parameters, n: int) -> None:
        self.p = parameters
        self.play = np.zeros(n)
        self.lagged = parameters["actuator_bias.offset"].copy()
        self.commands = np.zeros((0, n))

    def push(self, command: Array) -> None:
        """Append the commands (n,) of the next period."""
        self.commands = np.concatenate((self.commands, command[None]))

    def __call__(self, t: float, h: float) -> Array:
        """Mean of the motor's input over [t, t + h], (n,)."""
        p = self.p
        u = self._delayed(t, h)
        # Backlash: the output holds until the input has crossed the play, whose full width is `width`.
        half = 0.5 * p["actuator_backlash.width"]
        u = self.play = np.minimum(np.maximum(self.play, u - half), u + half)
        u = np.sign(u) * np.maximum(np.abs(u) - p["actuator_deadzone.width"], 0.0)
        u = np.clip(u, -p["actuator_saturation.limit"], p["actuator_saturation.limit"])
        u = u * (1 + p["directional_gain.share"] * np.sign(u)) + p["even_motor.coefficient"] * u**2
        u = u * (1 - p["fading_gain.rate"] * t)
        u = p["actuator_gain.scale"] * u + p["actuator_bias.offset"]
        constant = np.maximum(p["actuator_lag.time_constant"], 1e-12)
        before, self.lagged = self.lagged, u + (self.lagged - u) * np.exp(-h / constant)
        # Mean of an exponential over the substep; without a lag, u itself.
        return u + constant / h * (before - self.lagged)

    def _delayed(self, t: float, h: float) -> Array:
        shifted = t - self.p["actuator_delay.delay"]
        # 1e-9: a time that rounding put just before the start of a period belongs to it.
        first = np.floor(shifted / PERIOD + 1e-9).astype(int)
        last = np.floor((shifted + h) / PERIOD - 1e-9).astype(int)
        share = np.where(last > first, np.clip((last * PERIOD - shifted) / h, 0.0, 1.0), 1.0)
        return share * self._at(first) + (1 - share) * self._at(last)

    def _at(self, index: np.ndarray) -> Array:
        rows = np.clip(index, 0, len(self.commands) - 1)
        return np.where(index >= 0, self.commands[rows, np.arange(len(rows))], 0.0)


class Sensing:
    """The sensors of n machines, with past states and readings."""

    def __init__(self, parameters: Parameters, start: Array, h: float) -> None:
        self.p, self.h = parameters, h
        # States over the longest delay, newest first.
        reach = int(np.ceil(parameters["measurement_delay.delay"].max() / h)) + 2
        self.past = np.repeat(start[None, :4], reach, 0)
        self.delayed = bool(reach > 2)
        self.reading: Array | None = None
        self.clean = start[:4]

    def pass_by(self, state: Array) -> None:
        """Append the states (4, n) at the end of a substep."""
        if self.delayed:
            self.past = np.concatenate((state[None, :4], self.past[:-1]))

    def noiseless(self, t: float, state: Array) -> Array:
        """Readings without noise and holds, (4, n) in m, m/s, rad, rad/s."""
        p = self.p
        y = state[:4]
        if self.delayed:
            back = p["measurement_delay.delay"] / self.h
            whole = np.floor(back).astype(int)
            part, columns = back - whole, np.arange(y.shape[1])
            y = (1 - part) * self.past[whole, :, columns].T + part * self.past[whole + 1, :, columns].T
        y = y.copy()
        y[:2] *= p["sensor_scale.position"]
        y[2:] *= p["sensor_scale.angle"]
        y[2] += p["angle_offset.offset"]
        y[0] += p["position_offset.offset"]
        turns = state[0] / p["encoder_ripple.wavelength"]
        y[0] += p["encoder_ripple.amplitude"] * np.sin(2 * np.pi * turns + p["encoder_ripple.phase"])
        y[2] += p["angle_drift.rate"] * t
        return y

    def read(self, t: float, state: Array, noise: Array, loss_draws: Array) -> tuple[Array, Array]:
        """Readings (4, n), and readings without noise.

        While the true angle is inside a frozen zone, the angle's reading holds, and with `holds_rate` the angular
        velocity's too; a dropout holds the whole row. `loss_draws` (n,) are uniform on [0, 1). The first row of an
        episode is never held.
        """
        p, clean = self.p, self.noiseless(t, state)
        step = p["angle_quantisation.step"]
        y = clean + noise
        safe = np.maximum(step, 1e-12)
        y[2] = np.where(step > 0, np.round(y[2] / safe) * safe, y[2])
        clean[2] = np.where(step > 0, y[2] - noise[2], clean[2])
        if self.reading is not None:
            frozen = (state[2] >= p["frozen_zone.start"]) & (state[2] < p["frozen_zone.end"])
            lost = loss_draws < p["dropout.rate"]
            holds = (lost, lost, frozen | lost, frozen & (p["frozen_zone.holds_rate"] > 0) | lost)
            for channel, held in enumerate(holds):
                y[channel] = np.where(held, self.reading[channel], y[channel])
                clean[channel] = np.where(held, self.clean[channel], clean[channel])
        self.reading, self.clean = y, clean
        return y, clean

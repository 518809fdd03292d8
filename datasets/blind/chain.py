"""Actuation and sensing of the blind recordings: from a command to the motor's input, from a state to its reading.

The actuation chain runs delay, backlash, dead zone, saturation, gain, bias, lag; the sensing chain runs delay, scale,
offset, noise, encoder, velocities derived from its positions, and last the effects that hold a reading. Widths, limits
and offsets of the actuation chain are in units of the command. Before an episode commands are zero, the lag has settled
on the bias, and the machine rests in its first state.
"""

from __future__ import annotations

import numpy as np

from datasets.blind.plant import Array, Parameters, Time

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
    "position_delay.delay": 0.0,
    "angle_delay.delay": 0.0,
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
    "encoder.position": 0.0,
    "encoder.angle": 0.0,
    "velocity.derived": 0.0,
    "velocity.time_constant": 0.0,
}
"""every parameter of both chains at the value without effect: s, units of the command, m, rad, 1/s, rad/s; an
encoder has the size of its counts"""


class Actuation:
    """The actuation chains of n machines, with their memory."""

    def __init__(self, parameters: Parameters, n: int) -> None:
        self.p = parameters
        self.play = np.zeros(n)
        self.lagged = parameters["actuator_bias.offset"].copy()
        self.commands, self.stamps = np.zeros((0, n)), np.zeros((0, n))

    def push(self, t: Time, command: Array) -> None:
        """Append the commands (n,) that act from time t (s) on."""
        self.commands = np.concatenate((self.commands, command[None]))
        self.stamps = np.concatenate((self.stamps, np.broadcast_to(t, command.shape)[None]))
        # What every machine has done with is dropped.
        older = (self.stamps <= self.stamps[-1] - self.p["actuator_delay.delay"]).all(1).sum()
        self.commands, self.stamps = self.commands[max(older - 1, 0) :], self.stamps[max(older - 1, 0) :]

    def __call__(self, t: Time, h: Time) -> Array:
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

    def _delayed(self, t: Time, h: Time) -> Array:
        shifted = t - self.p["actuator_delay.delay"]
        # 1e-10 s: a time that rounding put just before a stamp belongs to what begins there.
        first = (self.stamps <= shifted + 1e-10).sum(0) - 1
        last = (self.stamps <= shifted + h - 1e-10).sum(0) - 1
        rows, columns = np.maximum(last, 0), np.arange(len(last))
        share = np.where(last > first, np.clip((self.stamps[rows, columns] - shifted) / h, 0.0, 1.0), 1.0)
        return share * self._at(first) + (1 - share) * self._at(last)

    def _at(self, index: np.ndarray) -> Array:
        return np.where(index >= 0, self.commands[np.maximum(index, 0), np.arange(len(index))], 0.0)


class Sensing:
    """The sensors of n machines, with past states and readings."""

    def __init__(self, parameters: Parameters, start: Array, shortest: float) -> None:
        self.p = parameters
        # States over the longest delay, newest first, and their times; `shortest` is the shortest substep in s.
        position, angle = (parameters[f"{sensor}_delay.delay"] for sensor in ("position", "angle"))
        self.late = parameters["measurement_delay.delay"] + np.stack((position, position, angle, angle))  # s, (4, n)
        reach = int(np.ceil(self.late.max() / shortest)) + 2
        self.times = np.repeat(-shortest * np.arange(reach)[:, None], start.shape[1], 1)
        # The log begins while the machine moves, each joint at its first speed.
        self.past = np.repeat(start[None, :4], reach, 0)
        self.past[:, ::2] += self.times[:, None] * start[1:4:2]
        self.delayed = bool(reach > 2)
        self.counted: tuple[Time, Array, Array] | None = None
        self.reading: Array | None = None
        self.clean = start[:4]

    def pass_by(self, t: Time, state: Array) -> None:
        """Append the states (4, n) at time t (s), the end of a substep."""
        if self.delayed:
            self.past = np.concatenate((state[None, :4], self.past[:-1]))
            self.times = np.concatenate((np.broadcast_to(t, state[:1].shape), self.times[:-1]))

    def noiseless(self, t: Time, state: Array) -> Array:
        """Readings without noise and holds, (4, n) in m, m/s, rad, rad/s."""
        p = self.p
        y = state[:4]
        if self.delayed:
            channels, columns = np.arange(4)[:, None], np.arange(y.shape[1])
            seen = t - self.late
            older = np.clip((self.times[:, None] > seen + 1e-10).sum(0), 1, len(self.times) - 1)
            newer = older - 1
            since = self.times[older, columns]
            part = (seen - since) / (self.times[newer, columns] - since)
            y = (1 - part) * self.past[older, channels, columns] + part * self.past[newer, channels, columns]
        y = y.copy()
        y[:2] *= p["sensor_scale.position"]
        y[2:] *= p["sensor_scale.angle"]
        y[2] += p["angle_offset.offset"]
        y[0] += p["position_offset.offset"]
        turns = state[0] / p["encoder_ripple.wavelength"]
        y[0] += p["encoder_ripple.amplitude"] * np.sin(2 * np.pi * turns + p["encoder_ripple.phase"])
        y[2] += p["angle_drift.rate"] * t
        return y

    def read(self, t: Time, state: Array, noise: Array, loss_draws: Array) -> tuple[Array, Array]:
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
        self._count(t, y)
        if self.reading is not None:
            frozen = (state[2] >= p["frozen_zone.start"]) & (state[2] < p["frozen_zone.end"])
            lost = loss_draws < p["dropout.rate"]
            holds = (lost, lost, frozen | lost, frozen & (p["frozen_zone.holds_rate"] > 0) | lost)
            for channel, held in enumerate(holds):
                y[channel] = np.where(held, self.reading[channel], y[channel])
                clean[channel] = np.where(held, self.clean[channel], clean[channel])
        self.reading, self.clean = y, clean
        return y, clean

    def _count(self, t: Time, y: Array) -> None:
        """Round positions to whole counts; derive velocities from them where the rig does, 0 in the first row."""
        p = self.p
        for channel, name in ((0, "encoder.position"), (2, "encoder.angle")):
            count = np.where(p[name] > 0, p[name], 1.0)
            y[channel] = np.where(p[name] > 0, np.round(y[channel] / count) * count, y[channel])
        velocity = np.zeros((2, y.shape[1]))
        if self.counted is not None:
            before, positions, filtered = self.counted
            passed = t - before
            weight = 1.0 - np.exp(-passed / np.maximum(p["velocity.time_constant"], 1e-12))
            velocity = filtered + weight * ((y[::2] - positions) / passed - filtered)
        self.counted = t, y[::2].copy(), velocity
        y[1::2] = np.where(p["velocity.derived"] > 0, velocity, y[1::2])

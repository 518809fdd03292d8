"""The cart-pole that makes the blind recordings: code of its own, not the library's (numpy alone, float64).

Equations of motion by the mass matrix, with q = (x in m, theta in rad), positive towards +x, 0 = upright:

    [ mc + mp         mp l cos(theta) ] [ x''     ]   [ F + mp l theta'^2 sin(theta) - (mc + mp) g sin(tilt) ]
    [ mp l cos(theta) 4/3 mp l^2      ] [ theta'' ] = [ tau + mp g l sin(theta - tilt)                       ]

mc cart mass (kg), mp mass (kg) and l half-length (m) of a uniform pole, g gravity (m/s2), F force on the cart (N), tau
torque at the pivot (N m), tilt (rad) positive where the track rises towards +x; theta is measured from the track's
normal. The explicit midpoint rule at 1 ms moves all smooth terms. Dry friction is an impulse at the end of a substep,
never larger than what stops the motion (Moreau's time stepping), so that sign(v) is exact and a stuck cart stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Parameters = dict[str, Array]
Time = float | Array
"""s, one for all machines or one for each (n,)"""

PERIOD = 0.05
"""s between commands"""
GRAVITY = 9.8
"""m/s2"""
MAX_FORCE = 30.0
"""N at a command of 1"""
CART_MASS, POLE_MASS, HALF_LENGTH = 1.0, 0.1, 0.5
"""kg, kg and m of the source"""

Load = Callable[[Parameters, Array, Array], Array]
"""(parameters, times in s (n,), states (4, n)) -> N on the cart or N m at the pivot, (n,)"""


def _inside(value: Array, start: Array, end: Array) -> Array:
    return ((value >= start) & (value < end)).astype(np.float64)


def _path(p: Parameters, t: Array) -> Array:
    """Value at time t of a force path that is sampled every 10 ms."""
    sample = np.minimum((t / 0.01 + 1e-6).astype(int), p["path"].shape[1] - 1)
    return p["path"][np.arange(len(sample)), sample]


CART_FORCES: dict[str, Load] = {
    "constant_force": lambda p, t, s: p["force"],
    "periodic_force": lambda p, t, s: (
        p["amplitude"] * np.cos(2 * np.pi * p["frequency"] * t + p["phase"]) + p["offset"]
    ),
    "gust": lambda p, t, s: p["force"] * ((t >= p["start"]) & (t < p["end"])),
    "viscous_friction": lambda p, t, s: -p["coefficient"] * s[1],
    "quadratic_drag": lambda p, t, s: -p["coefficient"] * s[1] * np.abs(s[1]),
    "friction_patch": lambda p, t, s: -p["coefficient"] * s[1] * _inside(s[0], p["start"], p["end"]),
    "spring": lambda p, t, s: -p["stiffness"] * (s[0] - p["rest"]),
    # Dry friction of unequal directions is that of their mean (below) and this constant force, also at rest.
    "directional_friction": lambda p, t, s: 0.5 * (p["backward"] - p["forward"]),
    # From here on: foreign to the catalogue.
    "cogging": lambda p, t, s: p["amplitude"] * np.sin(2 * np.pi * s[0] / p["wavelength"] + p["phase"]),
    "hardening_spring": lambda p, t, s: -p["stiffness"] * (s[0] - p["rest"]) ** 3,
    "random_force": lambda p, t, s: p["deviation"] * _path(p, t),
    "kicks": lambda p, t, s: p["force"] * _path(p, t),
    "magnet": lambda p, t, s: (
        p["force"]
        * (s[0] - p["position"])
        / p["reach"]
        * np.exp(0.5 - 0.5 * ((s[0] - p["position"]) / p["reach"]) ** 2)
    ),
    "one_way_drag": lambda p, t, s: -p["coefficient"] * np.maximum(p["side"] * s[1], 0.0) * p["side"],
    "aerodynamic_coupling": lambda p, t, s: -p["coefficient"] * s[1] * s[3],
}
"""forces on the cart in N"""

PIVOT_TORQUES: dict[str, Load] = {
    "pole_damping": lambda p, t, s: -p["coefficient"] * s[3],
    "pole_spring": lambda p, t, s: -p["stiffness"] * s[2],
    "pivot_detent": lambda p, t, s: p["torque"] * np.sin(p["teeth"] * s[2] + p["phase"]),
    "pivot_cable": lambda p, t, s: p["torque"] * (s[2] / 0.1) ** 2,
}
"""torques at the pivot in N m"""

CART_DRY: dict[str, Load] = {
    "coulomb_friction": lambda p, t, s: p["force"],
    "directional_friction": lambda p, t, s: 0.5 * (p["backward"] + p["forward"]),
    "stribeck_friction": lambda p, t, s: p["force"] * (0.1 + 0.9 * np.exp(-((s[1] / p["speed"]) ** 2))),
}
"""largest dry friction on the cart in N"""

PIVOT_DRY: dict[str, Load] = {
    "pole_friction": lambda p, t, s: p["torque"],
    "sticky_bearing": lambda p, t, s: p["torque"] * _inside(s[2], p["start"], p["end"]),
}
"""largest dry friction at the pivot in N m"""

Table = list[tuple[NDArray[np.intp], Parameters, Load]]


@dataclass
class Plant:
    """A batch of n cart-poles, each with its own loads."""

    cart_mass: Array
    """kg, (n,)"""
    pole_mass: Array
    """kg, (n,)"""
    half_length: Array
    """m, (n,)"""
    tilt: Array
    """rad, (n,)"""
    forces: Table = field(default_factory=list)
    """forces on the cart: which rows, their parameters, the law"""
    torques: Table = field(default_factory=list)
    """torques at the pivot"""
    dry_forces: Table = field(default_factory=list)
    """dry friction on the cart"""
    dry_torques: Table = field(default_factory=list)
    """dry friction at the pivot"""
    turns_exactly: bool = False
    """whether dry friction turns round within a substep, where a velocity passes 0; the older sets do without"""
    gear: Array | None = None
    """dry friction on the cart as a share of the motor's force, (n,)"""
    slosh: tuple[Array, Array, Array] | None = None
    """mass (kg, zero where there is none), angular frequency (rad/s) and damping ratio of a mass hidden in the cart"""

    def acceleration(self, t: Time, state: Array, force: Array) -> tuple[Array, Array]:
        """Smooth part of (x'' in m/s2, theta'' in rad/s2) under the motor's `force` (N)."""
        _, _, angle, rate = state[:4]
        push = force + _total(self.forces, t, state)
        torque = _total(self.torques, t, state)
        total, moment = self.cart_mass + self.pole_mass, self.pole_mass * self.half_length
        if self.slosh is not None:
            mass, omega, ratio = self.slosh
            push = push + mass * (omega**2 * (state[4] - state[0]) + 2 * ratio * omega * (state[5] - state[1]))
        push = push + moment * rate**2 * np.sin(angle) - total * GRAVITY * np.sin(self.tilt)
        torque = torque + moment * GRAVITY * np.sin(angle - self.tilt)
        return self._solve(angle, push, torque)

    def _solve(self, angle: Array, push: Array, torque: Array) -> tuple[Array, Array]:
        """The mass matrix' inverse times (N, N m)."""
        m11, m12 = self.cart_mass + self.pole_mass, self.pole_mass * self.half_length * np.cos(angle)
        m22 = 4.0 / 3.0 * self.pole_mass * self.half_length**2
        determinant = m11 * m22 - m12**2
        return (m22 * push - m12 * torque) / determinant, (m11 * torque - m12 * push) / determinant

    def _rates(self, t: Time, state: Array, force: Array) -> Array:
        rates = np.zeros_like(state)
        rates[0], rates[2] = state[1], state[3]
        rates[1], rates[3] = self.acceleration(t, state, force)
        if self.slosh is not None:
            _, omega, ratio = self.slosh
            rates[4] = state[5]
            rates[5] = -(omega**2) * (state[4] - state[0]) - 2 * ratio * omega * (state[5] - state[1])
        return rates

    def step(self, t: Time, state: Array, force: Array, h: Time) -> Array:
        """States (4 or 6, n) after h seconds under a motor force (N) held constant; rows 4 and 5 are the slosh's."""
        middle = state + 0.5 * h * self._rates(t, state, force)
        after = state + h * self._rates(t + 0.5 * h, middle, force)
        if self.dry_forces or self.dry_torques or self.gear is not None:
            after = self._rub(t, state, after, force, h)
        return after

    def _rub(self, t: Time, before: Array, after: Array, force: Array, h: Time) -> Array:
        """Apply the impulse of dry friction, at most to a standstill, to velocities and positions."""
        zero = np.zeros_like(after[0])
        geared = zero if self.gear is None else self.gear * np.abs(force)
        for axis, table, more in ((1, self.dry_forces, geared), (3, self.dry_torques, zero)):
            most = _total(table, t, before) + more
            if not most.any():
                continue
            unit = (np.ones_like(zero), zero) if axis == 1 else (zero, np.ones_like(zero))
            per_impulse = self._solve(before[2], *unit)  # m/s and rad/s for each N s or N m s
            own = per_impulse[0] if axis == 1 else per_impulse[1]
            impulse = -np.clip(after[axis] / own, -most * h, most * h)
            if self.turns_exactly:
                impulse = self._turn(before[axis], after[axis], own, most, h, impulse)
            for velocity, gain in zip((1, 3), per_impulse, strict=True):
                after[velocity] += gain * impulse
                after[velocity - 1] += 0.5 * h * gain * impulse
        return after

    @staticmethod
    def _turn(before: Array, after: Array, own: Array, most: Array, h: Time, impulse: Array) -> Array:
        """The impulse where a velocity passes 0 and slides on: friction turns round at that instant."""
        drive, against = np.abs(after - before) / h, np.abs(after - before) / h + own * most
        passes = (before * (after - before) < 0) & (np.abs(before) < against * h) & (drive > own * most)
        left = h - np.abs(before) / np.where(against > 0, against, 1.0)
        return np.where(passes, np.sign(before) * most * (2 * left - h), impulse)


def _total(table: Table, t: Time, state: Array) -> Array:
    total = np.zeros(state.shape[1])
    times = np.broadcast_to(t, total.shape)
    for rows, parameters, law in table:
        total[rows] += law(parameters, times[rows], state[:, rows])
    return total


def nominal(n: int) -> Plant:
    """n source cart-poles without any load."""
    return Plant(np.full(n, CART_MASS), np.full(n, POLE_MASS), np.full(n, HALF_LENGTH), np.zeros(n))


def predict(start: Array, commands: Array, lengths: Array | None = None) -> Array:
    """States that the source predicts from `start` (4, n) under commands (steps, n): (4, n) at the end.

    Each command acts for its length in s (steps, n), or for 50 ms, in 8 substeps in 50 ms and at least 2.
    """
    plant, state = nominal(start.shape[1]), start
    for command, length in zip(commands, np.full(commands.shape, PERIOD) if lengths is None else lengths, strict=True):
        substeps = max(2, round(8 * float(length.mean()) / PERIOD))
        for _ in range(substeps):
            state = plant.step(0.0, state, MAX_FORCE * command, length / substeps)
    return state

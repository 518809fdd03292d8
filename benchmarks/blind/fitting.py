"""Least squares on one-step residuals: the effects that the baselines try, their starting points, and the fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.onestep import Array, Steps, Values


class Data(Protocol):
    """A recording as one-step errors under any parameters: of a cart-pole or of a flight."""

    @property
    def system(self) -> str:
        """Its name."""

    @property
    def neutral(self) -> Values:
        """Every parameter at the value without effect."""

    @property
    def size(self) -> int:
        """Number of residuals."""

    @property
    def rows_lost(self) -> NDArray[np.bool_]:
        """(n,) whether either row of a pair repeats the one before."""

    @property
    def angle_held(self) -> NDArray[np.bool_]:
        """(n,) whether an angle of either repeats, and the position does not."""

    def residual(self, p: Values) -> Array:
        """(channels, n) in standard deviations of the noise."""


@dataclass(frozen=True)
class Free:
    """A parameter that is fitted."""

    name: str
    """in the recording's `neutral`"""
    low: float
    high: float
    step: float
    """of the difference quotient; about the smallest change that matters"""


@dataclass(frozen=True)
class Candidate:
    """An effect, its free parameters, and the starting points of its fit."""

    effect: str
    free: tuple[Free, ...]
    starts: tuple[Values, ...]
    counted: int
    """number of parameters for BIC, including those on the grid"""


def one(name: str, low: float, high: float, step: float, *starts: float) -> Candidate:
    """An effect with one parameter, and the starting points of its fit."""
    effect = name.split(".")[0]
    return Candidate(effect, (Free(name, low, high, step),), tuple({name: start} for start in starts), 1)


def on_any(*limits: float) -> list[Candidate]:
    """Faults of the commands of any system, and a constant force; a saturation is searched from `limits`."""
    return [
        one("actuator_gain.scale", 0.4, 2.0, 0.001, 1.0),
        one("actuator_bias.offset", -0.35, 0.35, 0.0001, 0.0),
        one("actuator_delay.delay", 0.0, 0.2, 0.0005, 0.005, 0.05),
        one("actuator_lag.time_constant", 0.0, 0.3, 0.0005, 0.005, 0.05),
        one("actuator_deadzone.width", 0.0, 0.6, 0.0005, 0.005, 0.05),
        one("actuator_saturation.limit", 0.02, 1.0, 0.001, *limits),
        one("actuator_backlash.width", 0.0, 1.0, 0.0005, 0.01, 0.1),
        one("constant_force.force", -10, 10, 0.001, 0.0),
    ]


def candidates(data: Steps) -> list[Candidate]:
    """The core of the catalogue, with grids of places, times and frequencies."""
    longest = float(data.time.max())
    reach = float(np.percentile(data.state[0], 2)), float(np.percentile(data.state[0], 98))
    times, places = np.linspace(0, longest, 9), np.linspace(*reach, 8)
    gusts = [(a, b) for i, a in enumerate(times) for b in times[i + 1 :] if b - a <= 0.6 * longest]
    patches = [(a, b) for i, a in enumerate(places) for b in places[i + 1 :] if 0.15 <= b - a <= 0.8]
    periodic = tuple(Free(f"periodic_force.{name}", -10, 10, 0.01) for name in ("cosine", "sine", "offset"))
    return [
        *on_any(0.5, 0.25, 0.12),
        Candidate(
            "periodic_force",
            (*periodic, Free("periodic_force.frequency", 0.05, 5.0, 0.001)),
            tuple({"periodic_force.frequency": float(f)} for f in np.geomspace(0.2, 3.0, 14)),
            4,
        ),
        Candidate(
            "gust",
            (Free("gust.force", -15, 15, 0.01),),
            tuple({"gust.start": float(a), "gust.end": float(b)} for a, b in gusts),
            3,
        ),
        one("viscous_friction.coefficient", 0.0, 15.0, 0.001, 0.0),
        one("coulomb_friction.force", 0.0, 6.0, 0.001, 0.0),
        one("quadratic_drag.coefficient", 0.0, 20.0, 0.001, 0.0),
        Candidate(
            "friction_patch",
            (Free("friction_patch.coefficient", 0.0, 40.0, 0.01),),
            tuple({"friction_patch.start": float(a), "friction_patch.end": float(b)} for a, b in patches),
            3,
        ),
        Candidate(
            "spring", (Free("spring.stiffness", 0.0, 50.0, 0.001), Free("spring.pull", -40, 40, 0.001)), ({},), 2
        ),
        one("pole_damping.coefficient", 0.0, 0.3, 0.0001, 0.0),
        one("track_tilt.angle", -0.3, 0.3, 0.0001, 0.0),
        one("cart_mass.scale", 0.4, 3.0, 0.001, 1.0),
        one("pole_mass.scale", 0.2, 5.0, 0.01, 1.0),
        one("pole_length.scale", 0.4, 2.5, 0.001, 1.0),
        one("angle_offset.offset", -0.2, 0.2, 0.0001, 0.0),
        one("measurement_delay.delay", 0.0, 0.2, 0.0005, 0.005, 0.05),
        one("sensor_scale.position", 0.5, 2.0, 0.001, 1.0),
        one("sensor_scale.angle", 0.5, 2.0, 0.001, 1.0),
        *(Candidate(effect, (), ({},), count) for effect, count in (("dropout", 1), ("frozen_zone", 2))),
    ]


@dataclass
class Fit:
    """A set of effects with the parameters that fit best."""

    members: tuple[Candidate, ...]
    values: Values
    """of all effects"""
    chi2: float
    """sum of squared one-step residuals in standard deviations"""
    bic: float
    """chi2 + parameters log(residuals), for Gaussian noise of known size (Schwarz 1978)"""
    deviations: Values
    """standard deviations of the free parameters"""

    @property
    def effects(self) -> list[str]:
        """Names, in the order in which they were added."""
        return [member.effect for member in self.members]


def chi_squared(data: Data, residual: Array, effects: Sequence[str]) -> float:
    """Sum of squared residuals; steps held by a dropout or frozen zone of the set count with their expectation."""
    out = held(data, effects)
    return float((residual[:, ~out] ** 2).sum()) + len(residual) * int(out.sum())


def held(data: Data, effects: Sequence[str]) -> NDArray[np.bool_]:
    """(N,) steps whose readings are held by a dropout or a frozen zone of the set."""
    lost, frozen = ("dropout" in effects) & data.rows_lost, ("frozen_zone" in effects) & data.angle_held
    return np.asarray(lost | frozen)


def fit(data: Data, members: Sequence[Candidate], start: Values | None = None, thorough: bool = True) -> Fit:
    """Gauss-Newton from every point of the last member's grid, all parameters together.

    On a grid, one step is made from every point, and the best three are continued to convergence.
    """
    base = {**data.neutral, **(start or {})}
    starts = [{**base, **point} for point in members[-1].starts] if members else [base]
    if len(starts) > 3:
        rough = sorted((_descend(data, members, point, 1) for point in starts), key=lambda fit: fit.chi2)
        starts = [fit.values for fit in rough[:3]]
    return min((_descend(data, members, point, 10 if thorough else 3) for point in starts), key=lambda fit: fit.chi2)


def _descend(data: Data, members: Sequence[Candidate], start: Values, rounds: int) -> Fit:
    free = [parameter for member in members for parameter in member.free]
    effects = [member.effect for member in members]
    values, inverse = dict(start), np.zeros((len(free), len(free)), np.float64)
    residual = data.residual(values)
    best = chi_squared(data, residual, effects)
    keep = ~held(data, effects)
    for _ in range(rounds if free else 0):
        slopes = np.stack([_slope(data, values, parameter, residual)[:, keep].ravel() for parameter in free], 1)
        normal = slopes.T @ slopes
        # A parameter without a derivative here (a limit that is never reached) does not move.
        inverse = np.asarray(np.linalg.pinv(normal + 1e-9 * np.diag(np.diag(normal) + 1e-12)), np.float64)
        move = -inverse @ (slopes.T @ residual[:, keep].ravel())
        for share in (1.0, 0.3, 0.1):
            trial = dict(values)
            for parameter, change in zip(free, move, strict=True):
                trial[parameter.name] = float(
                    np.clip(values[parameter.name] + share * change, parameter.low, parameter.high)
                )
            tried = data.residual(trial)
            chi2 = chi_squared(data, tried, effects)
            if chi2 < best:
                break
        else:
            break
        gain, best, values, residual = best - chi2, chi2, trial, tried
        if gain < 0.01:
            break
    count = sum(member.counted for member in members)
    bic = best + count * float(np.log(residual.size))
    deviations = {p.name: float(s) for p, s in zip(free, np.sqrt(np.maximum(np.diag(inverse), 0.0)), strict=True)}
    return Fit(tuple(members), values, best, bic, deviations)


def _slope(data: Data, values: Values, parameter: Free, residual: Array) -> Array:
    """Forward difference, backward at the upper bound."""
    step = parameter.step if values[parameter.name] + parameter.step <= parameter.high else -parameter.step
    return (data.residual({**values, parameter.name: values[parameter.name] + step}) - residual) / step

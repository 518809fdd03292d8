"""Baseline diagnosers: each takes the path of a recording's CSV and returns an answer in the JSON of docs/diagnosis.md.

- afternoon: what a careful engineer writes in an afternoon. Least squares on the one-step prediction errors of the
  source with one effect at a time, known noise, BIC; if the best fit is poor, the answer is unexplained.
- greedy: forward selection by BIC on the same residuals, up to three effects.
- refit: all parameters at once by one ridge least-squares step; names those beyond three standard deviations.
- pysindy: sparse regression of the residual forces on a library of features, by the package pysindy.
- chance: guesses with the mixture of the sets.

All know the core of the catalogue (`datasets.blind.kinds`); afternoon, greedy, refit and chance that of the vehicles
too.
"""

from __future__ import annotations

import hashlib
import importlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.blind.answers import answer_of, cause_of
from benchmarks.blind.fitting import Candidate, Data, Fit, candidates, chi_squared, fit
from benchmarks.blind.flight_onestep import flight_candidates, read_flights, system_of
from benchmarks.blind.onestep import NEUTRAL, PERIOD, Values, read_steps
from benchmarks.blind.scoring import Answer
from datasets.blind import flight_kinds
from datasets.blind.kinds import NAMED

POOR_FIT = 1.5
"""chi-squared per residual above which a fit is called poor"""
NAMED_FROM = 3.0
"""standard deviations above which refit names a parameter"""
CART_POLE_MIX, FLIGHT_MIX = (0.2, 0.3, 0.2, 0.1, 0.2), (0.165, 0.67, 0.0, 0.0, 0.165)
"""shares of recordings without effect, with one, two and three, and with a foreign one"""
RIDGE = 1.0
"""prior precision of every parameter, where a parameter is measured in units of 30 times its `Free.step`"""


def opened(path: Path) -> tuple[Data, list[Candidate]]:
    """A recording, and the effects that it may have."""
    if (system := system_of(path)) != "cartpole":
        return read_flights(path), flight_candidates(system)
    data = read_steps(path)
    return data, candidates(data)


def core(system: str) -> list[str]:
    """The names of the effects that a set's core is drawn from, sorted: those that the baselines know."""
    kinds = NAMED if system == "cartpole" else flight_kinds.named("core", system)
    return sorted(kind.name for kind in kinds)


def afternoon(path: Path) -> Answer:
    """One effect at a time."""
    data, pool = opened(path)
    fits = [fit(data, ()), *(fit(data, (candidate,)) for candidate in pool)]
    return _judged(data, fits)


def greedy(path: Path) -> Answer:
    """Adds one effect at a time while BIC falls; all parameters are refitted each time."""
    data, pool = opened(path)
    seen = [fit(data, ())]
    best = seen[0]
    for _ in range(3):
        left = [c for c in pool if not any(c.free == m.free and c.effect == m.effect for m in best.members)]
        tried = [fit(data, (*best.members, c), best.values, thorough=False) for c in left]
        seen += tried
        leader = min(tried, key=lambda f: f.bic)
        if leader.bic >= best.bic:
            break
        best = leader
    return _judged(data, seen)


def _judged(data: Data, fits: Sequence[Fit]) -> Answer:
    """The set of the lowest BIC; unexplained where even that fits poorly."""
    best = min(fits, key=lambda f: f.bic)
    if best.chi2 / data.size > POOR_FIT:
        return answer_of(data, fits, "unexplained")
    return answer_of(data, fits, "identified" if best.members else "no_gap")


def refit(path: Path) -> Answer:
    """(J'J + ridge)^-1 J'r at the source, for all parameters with a derivative there; names the significant ones."""
    data, every = opened(path)
    aliases = _ALIASES[data.system]
    pool = [_without_alias(c) for c in every if c.free and len(c.starts) <= 2 and c.effect not in aliases]
    # At the source a saturation of 1 and regions without width have no derivative; a dropout has no fitted parameter.
    free = [parameter for candidate in pool for parameter in candidate.free]
    base = data.residual(dict(data.neutral))
    keep = ~(data.rows_lost | data.angle_held)
    slopes = np.stack(
        [
            ((data.residual({**data.neutral, p.name: data.neutral[p.name] + p.step}) - base)[:, keep] / p.step).ravel()
            for p in free
        ],
        1,
    )
    scale = np.array([30 * p.step for p in free])
    inverse = np.linalg.inv(slopes.T @ slopes + RIDGE * np.diag(scale**-2.0))
    change = -inverse @ (slopes.T @ base[:, keep].ravel())
    spread = np.sqrt(np.diag(inverse))
    values: Values = dict(data.neutral) | {
        p.name: data.neutral[p.name] + float(d) for p, d in zip(free, change, strict=True)
    }
    deviations = {p.name: float(s) for p, s in zip(free, spread, strict=True)}
    outstanding = {p.name: abs(float(d / s)) for p, d, s in zip(free, change, spread, strict=True)}
    named = [c for c in pool if max(outstanding[p.name] for p in c.free) > NAMED_FROM]
    named.sort(key=lambda c: -max(outstanding[p.name] for p in c.free))
    chi2 = chi_squared(data, data.residual(values), ("dropout", "frozen_zone"))
    fits = [Fit((), dict(data.neutral), chi_squared(data, base, ()), 0.0, {})]
    if named:
        fits.append(Fit(tuple(named), values, chi2, -1.0, deviations))
    return answer_of(data, fits, "identified" if named else "no_gap")


_ALIASES: dict[str, tuple[str, ...]] = {
    "cartpole": ("actuator_bias", "measurement_delay"),
    "quadrotor": ("payload", "wind"),
    "fixed_wing": (),
}
"""left out, as their columns equal those of constant_force and actuator_delay (cart-pole), thrust_gain and, at the
source, linear_drag (quadrotor)"""


def _without_alias(candidate: Candidate) -> Candidate:
    """The candidate without a spring's pull, which equals a constant force."""
    return replace(candidate, free=tuple(p for p in candidate.free if p.name != "spring.pull"))


def pysindy(path: Path) -> Answer:
    """STLSQ on the force on the cart and the torque at the pivot that the source does not explain (finite differences).

    F = (mc + mp) x'' + mp l (theta'' cos - theta'^2 sin) - 30 u, tau = mp l x'' cos + 4/3 mp l^2 theta'' - mp g l sin.
    """
    package = importlib.import_module("pysindy")
    data = read_steps(path)
    _, v, angle, rate = middle = 0.5 * (data.state + data.after)
    acceleration, turning = (data.after - data.state)[[1, 3]] / PERIOD
    command = data.commands[data.where]
    force = 1.1 * acceleration + 0.05 * (turning * np.cos(angle) - rate**2 * np.sin(angle)) - 30 * command
    torque = 0.05 * acceleration * np.cos(angle) + turning / 30 - 0.49 * np.sin(angle)
    features = {
        "constant_force.force": np.ones_like(v),
        "viscous_friction.coefficient": -v,
        "coulomb_friction.force": -np.sign(v),
        "quadratic_drag.coefficient": -v * np.abs(v),
        "spring.stiffness": -middle[0],
        "actuator_gain.scale": 30 * command,
    }
    # In N, so that one threshold serves all.
    sizes = {name: float(np.sqrt(np.mean(column**2))) for name, column in features.items()}
    library = np.stack([column / sizes[name] for name, column in features.items()], 1)
    # Four standard errors of a coefficient, since the noise is known.
    few = 4 * np.sqrt(2 / len(v)) / PERIOD
    limits = few * 1.1 * data.noise[1], few * data.noise[3] / 30
    with warnings.catch_warnings():
        # An empty model is a valid answer.
        warnings.filterwarnings("ignore", "Sparsity parameter is too big")
        pushes = package.STLSQ(threshold=limits[0], alpha=1e-3).fit(library, force[:, None]).coef_[0]
        turning_sizes = np.array([np.sqrt(np.mean(rate**2)), np.sqrt(np.mean(angle**2))])
        pole = np.stack((-rate, angle), 1) / turning_sizes
        turns = package.STLSQ(threshold=limits[1], alpha=1e-3).fit(pole, torque[:, None]).coef_[0] / turning_sizes
    values = dict(NEUTRAL)
    for (name, size), coefficient in zip(sizes.items(), pushes, strict=True):
        values[name] = NEUTRAL[name] + float(coefficient) / size
    values["pole_damping.coefficient"] = float(turns[0])
    active = [(abs(c), name.split(".")[0]) for name, c in zip(features, pushes, strict=True) if c != 0]
    # A longer or heavier pole leaves a torque proportional to the angle; the longer one is taken.
    active += [(abs(c) * 20, n) for n, c in zip(("pole_damping", "pole_length"), turns, strict=True) if c != 0]
    named = [effect for _, effect in sorted(active, reverse=True)]
    answer = answer_of(data, [Fit((), dict(NEUTRAL), 1.0, 0.0, {})], "identified" if named else "no_gap")
    answer["causes"] = [cause_of(effect, values, {}, data, 1.0) for effect in named]
    answer["ranking"] = [{"effects": named, "probability": None, "gap_closed": None}]
    answer["gap"] = {}
    return answer


def chance(path: Path) -> Answer:
    """A guess, the same for the same file name: nothing, something foreign, or one to three effects."""
    rng = np.random.default_rng(
        int.from_bytes(hashlib.sha256(f"{path.parent.name}/{path.name}".encode()).digest()[:8], "big")
    )
    system = system_of(path)
    effects = core(system)
    guess = int(rng.choice(5, p=CART_POLE_MIX if system == "cartpole" else FLIGHT_MIX))
    named = [str(n) for n in rng.choice(effects, guess, replace=False)] if guess < 4 else []
    rest = [[str(n)] for n in rng.choice(effects, 2, replace=False)]
    verdict = "unexplained" if guess == 4 else "identified" if named else "no_gap"
    return {
        "schema": 2,
        "system": system,
        "verdict": verdict,
        "where": {"regions": []},
        "causes": [{"effect": name, "parameters": {}, "indistinguishable_from": []} for name in named],
        "ranking": [{"effects": named, "probability": 1 / len(effects)}, *({"effects": r} for r in rest)],
        "gap": {},
    }


BASELINES: dict[str, Callable[[Path], Answer]] = {
    "afternoon": afternoon,
    "greedy": greedy,
    "refit": refit,
    "pysindy": pysindy,
    "chance": chance,
}
"""by name"""

FLYING = ("afternoon", "greedy", "refit", "chance")
"""the baselines that also diagnose the vehicles"""

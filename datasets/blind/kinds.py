"""The effects that blind recordings of the cart-pole may have: those of the catalogue, and foreign ones.

Each kind draws its shape (direction, places, times, frequencies) once and has one size, a positive number with which
its strength grows. Names and parameters of the named kinds are those of docs/effects.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Shape = dict[str, float]
Draw = Callable[[np.random.Generator, float], Shape]
Build = Callable[[float, Shape], Shape]


@dataclass(frozen=True)
class Kind:
    """One kind of effect."""

    name: str
    """the catalogue's name, or for a foreign kind a name of its own"""
    stage: str
    """actuation, dynamics or sensing"""
    low: float
    """smallest size"""
    high: float
    """largest size that is physically plausible"""
    build: Build
    """(size, shape) -> parameters"""
    draw: Draw = lambda rng, length: {}
    """(random numbers, episode length in s) -> shape"""


def sign(rng: np.random.Generator, _: float = 0.0) -> Shape:
    """Draws the sign of an effect."""
    return {"sign": float(rng.choice((-1.0, 1.0)))}


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def plain(parameter: str) -> Build:
    """The size is the value of the parameter."""
    return lambda size, shape: {parameter: size}


def signed(parameter: str) -> Build:
    """The size is the magnitude of the parameter, with the sign that was drawn."""
    return lambda size, shape: {parameter: shape["sign"] * size}


def scale(size: float, shape: Shape) -> Shape:
    """The size is the magnitude of the logarithm of a factor."""
    return {"scale": float(np.exp(shape["sign"] * size))}


def _shaped(parameter: str) -> Build:
    """The size, with the shape's sign where it has one, and the shape itself."""
    return lambda size, shape: {
        parameter: shape.get("sign", 1.0) * size,
        **{name: value for name, value in shape.items() if name != "sign"},
    }


def _span(rng: np.random.Generator, centre: float, width: float) -> Shape:
    middle = rng.uniform(-centre, centre)
    return {"start": float(middle - width / 2), "end": float(middle + width / 2)}


def _periodic(rng: np.random.Generator, _: float) -> Shape:
    offset = float(rng.uniform(-1, 1)) if rng.random() < 0.5 else 0.0
    return {"frequency": _log(rng, 0.2, 2.5), "phase": float(rng.uniform(-np.pi, np.pi)), "ratio": offset}


def _gust(rng: np.random.Generator, length: float) -> Shape:
    lasts = float(rng.uniform(0.15, 0.4)) * length
    start = float(rng.uniform(0.1 * length, 0.9 * length - lasts))
    return sign(rng) | {"start": round(start, 3), "end": round(start + lasts, 3)}


def _scaled_sensor(rng: np.random.Generator, _: float) -> Shape:
    return sign(rng) | {"position": float(rng.random() < 0.5)}


def _patch(rng: np.random.Generator, _: float) -> Shape:
    return _span(rng, 0.4, float(rng.uniform(0.2, 0.6)))


NAMED: tuple[Kind, ...] = (
    Kind("actuator_gain", "actuation", 0.01, 0.7, scale, sign),
    Kind("actuator_bias", "actuation", 0.001, 0.3, signed("offset"), sign),
    Kind("actuator_delay", "actuation", 0.001, 0.15, plain("delay")),
    Kind("actuator_lag", "actuation", 0.001, 0.25, plain("time_constant")),
    Kind("actuator_deadzone", "actuation", 0.001, 0.3, plain("width")),
    # A size of 0 would limit commands to 1, which they never exceed; 3.5 limits them to 0.03.
    Kind("actuator_saturation", "actuation", 0.05, 3.5, lambda size, shape: {"limit": float(np.exp(-size))}),
    Kind("actuator_backlash", "actuation", 0.002, 0.5, plain("width")),
    Kind("constant_force", "dynamics", 0.02, 8.0, signed("force"), sign),
    Kind(
        "periodic_force",
        "dynamics",
        0.02,
        10.0,
        lambda size, shape: {
            "amplitude": size,
            "frequency": shape["frequency"],
            "phase": shape["phase"],
            "offset": size * shape["ratio"],
        },
        _periodic,
    ),
    Kind("gust", "dynamics", 0.05, 15.0, _shaped("force"), _gust),
    Kind("viscous_friction", "dynamics", 0.02, 15.0, plain("coefficient")),
    Kind("coulomb_friction", "dynamics", 0.02, 6.0, plain("force")),
    Kind("quadratic_drag", "dynamics", 0.02, 20.0, plain("coefficient")),
    Kind("friction_patch", "dynamics", 0.1, 40.0, _shaped("coefficient"), _patch),
    Kind(
        "spring", "dynamics", 0.05, 40.0, _shaped("stiffness"), lambda rng, _: {"rest": float(rng.uniform(-0.4, 0.4))}
    ),
    Kind("pole_damping", "dynamics", 0.0003, 0.15, plain("coefficient")),
    Kind("track_tilt", "dynamics", 0.001, 0.2, signed("angle"), sign),
    Kind("cart_mass", "dynamics", 0.01, 1.1, scale, sign),
    Kind("pole_mass", "dynamics", 0.05, 1.6, scale, sign),
    Kind("pole_length", "dynamics", 0.01, 0.9, scale, sign),
    Kind("angle_offset", "sensing", 0.0005, 0.2, signed("offset"), sign),
    Kind("measurement_delay", "sensing", 0.001, 0.15, plain("delay")),
    Kind(
        "sensor_scale",
        "sensing",
        0.005,
        0.7,
        lambda size, shape: {
            "position": float(np.exp(shape["sign"] * size * shape["position"])),
            "angle": float(np.exp(shape["sign"] * size * (1 - shape["position"]))),
        },
        _scaled_sensor,
    ),
    Kind(
        "frozen_zone",
        "sensing",
        0.002,
        0.25,
        lambda size, shape: {
            "start": shape["centre"] - size / 2,
            "end": shape["centre"] + size / 2,
            "holds_rate": shape["holds_rate"],
        },
        lambda rng, _: {"centre": float(rng.normal(0, 0.04)), "holds_rate": float(rng.random() < 0.5)},
    ),
    Kind("dropout", "sensing", 0.005, 0.5, plain("rate")),
)
"""the core of the catalogue, from which the sets 2028 and 2029 are drawn; adding a kind here would change them"""

REST: tuple[Kind, ...] = (Kind("position_offset", "sensing", 0.001, 0.4, signed("offset"), sign),)
"""the rest of the catalogue: a cart-pole moves alike at every place, so that no recording shows where x is 0"""

LATER: tuple[Kind, ...] = (
    Kind(
        "directional_friction",
        "dynamics",
        0.02,
        12.0,
        lambda size, shape: {"forward": size * shape["forward"], "backward": size * (1 - shape["forward"])},
        lambda rng, _: {"forward": float(rng.uniform(0.1, 0.9))},
    ),
    Kind("pole_friction", "dynamics", 0.0002, 0.3, plain("torque")),
    Kind("pole_spring", "dynamics", 0.001, 1.0, plain("stiffness")),
    Kind("load_dependent_friction", "dynamics", 0.005, 0.7, plain("share")),
    Kind("position_delay", "sensing", 0.001, 0.1, plain("delay")),
    Kind("angle_delay", "sensing", 0.0005, 0.1, plain("delay")),
)
"""effects that joined the catalogue after the sets 2028 and 2029 were made"""

Effects = Literal["core", "rest", "all"]
"""what a set is drawn from: the core of the catalogue, the effects that no recording shows, or the whole catalogue"""


def _seeded(rng: np.random.Generator, **more: float) -> Shape:
    return {"path_seed": float(rng.integers(2**31)), **more}


FOREIGN: tuple[Kind, ...] = (
    Kind(
        "cogging",
        "dynamics",
        0.1,
        30.0,
        _shaped("amplitude"),
        lambda rng, _: {"wavelength": _log(rng, 0.06, 0.25), "phase": float(rng.uniform(-np.pi, np.pi))},
    ),
    Kind("hardening_spring", "dynamics", 0.5, 400.0, _shaped("stiffness"), lambda rng, _: {"rest": 0.0}),
    Kind(
        "stribeck_friction", "dynamics", 0.05, 10.0, _shaped("force"), lambda rng, _: {"speed": _log(rng, 0.05, 0.15)}
    ),
    Kind(
        "random_force",
        "dynamics",
        0.05,
        10.0,
        _shaped("deviation"),
        lambda rng, _: _seeded(rng, correlation=_log(rng, 0.15, 0.8)),
    ),
    Kind("kicks", "dynamics", 0.2, 40.0, _shaped("force"), lambda rng, _: _seeded(rng, interval=_log(rng, 0.6, 1.5))),
    Kind(
        "magnet",
        "dynamics",
        0.1,
        20.0,
        _shaped("force"),
        lambda rng, _: sign(rng) | {"position": float(rng.uniform(-0.3, 0.3)), "reach": float(rng.uniform(0.05, 0.15))},
    ),
    Kind("one_way_drag", "dynamics", 0.1, 30.0, _shaped("coefficient"), lambda rng, _: {"side": sign(rng)["sign"]}),
    Kind("aerodynamic_coupling", "dynamics", 0.1, 80.0, _shaped("coefficient"), sign),
    Kind(
        "sloshing",
        "dynamics",
        0.02,
        1.5,
        _shaped("mass"),
        lambda rng, _: {"frequency": _log(rng, 0.8, 2.5), "damping": float(rng.uniform(0.03, 0.15))},
    ),
    Kind(
        "pivot_detent",
        "dynamics",
        0.001,
        0.5,
        _shaped("torque"),
        lambda rng, _: {"teeth": float(rng.uniform(20, 50)), "phase": float(rng.uniform(-np.pi, np.pi))},
    ),
    Kind("pivot_cable", "dynamics", 0.001, 0.5, _shaped("torque"), sign),
    Kind(
        "sticky_bearing",
        "dynamics",
        0.001,
        0.5,
        _shaped("torque"),
        lambda rng, _: _span(rng, 0.04, float(rng.uniform(0.04, 0.1))),
    ),
    Kind("directional_gain", "actuation", 0.01, 0.7, signed("share"), sign),
    Kind("even_motor", "actuation", 0.02, 4.0, signed("coefficient"), sign),
    Kind("fading_gain", "actuation", 0.002, 0.15, plain("rate")),
    # No drift of the position: at a constant rate, it is a change of the inertial frame, which no recording shows.
    Kind(
        "encoder_ripple",
        "sensing",
        0.0003,
        0.1,
        _shaped("amplitude"),
        lambda rng, _: {"wavelength": _log(rng, 0.1, 0.4), "phase": float(rng.uniform(-np.pi, np.pi))},
    ),
    Kind("angle_drift", "sensing", 0.0003, 0.05, signed("rate"), sign),
    Kind("angle_quantisation", "sensing", 0.002, 0.15, plain("step")),
)
"""kinds that no effect of the catalogue described when the sets 2028 and 2029 were made"""

STRIBECK = "stribeck_friction"
"""foreign when the sets 2028 and 2029 were made; in the catalogue since"""


def evenly_mixed(mix: Mapping[str, float], count: int) -> NDArray[np.str_]:
    """(count,) mixtures in shares as close to `mix` as the count allows, in its order."""
    places = (np.arange(count) + 0.5) / count
    return np.array(list(mix))[np.searchsorted(np.cumsum(list(mix.values())), places)]


def drawn(mixture: str, effects: Effects) -> tuple[Kind, ...]:
    """The kinds that recordings of a mixture are drawn from."""
    if mixture == "foreign":
        return FOREIGN if effects == "core" else tuple(kind for kind in FOREIGN if kind.name != STRIBECK)
    if effects == "core":
        return NAMED
    return (*NAMED, *LATER, *(kind for kind in FOREIGN if kind.name == STRIBECK))


INSEPARABLE: tuple[frozenset[str], ...] = (
    frozenset({"actuator_bias", "constant_force"}),
    # Any two of these are the same as any other two.
    *map(frozenset, combinations(("actuator_delay", "measurement_delay", "position_delay", "angle_delay"), 2)),
    frozenset({"actuator_gain", "cart_mass", "pole_mass"}),
    frozenset({"track_tilt", "angle_offset", "constant_force"}),
    frozenset({"track_tilt", "angle_offset", "actuator_bias"}),
    frozenset({"directional_friction", "constant_force"}),
    frozenset({"directional_friction", "actuator_bias"}),
    frozenset({"directional_friction", "coulomb_friction"}),
    frozenset({"directional_friction", STRIBECK}),
    frozenset({"coulomb_friction", STRIBECK}),
)
"""never together in one recording, since other sizes of some or all of them give the same data"""

AS_ONE: tuple[frozenset[str], ...] = (
    frozenset({"coulomb_friction", "constant_force"}),
    frozenset({"coulomb_friction", "actuator_bias"}),
)
"""never together where the whole catalogue is drawn: a friction by direction is the same, and one effect less"""

KINDS: dict[str, Kind] = {kind.name: kind for kind in NAMED + REST + LATER + FOREIGN}
"""by name"""

"""What a diagnosis needs to know of a system in addition to its physics, for each system that can be diagnosed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache

from visadapt.systems import SYSTEMS, CartPole, FixedWing, Quadrotor, System
from visadapt.systems.base import Parameters, parameters
from visadapt.systems.rigid_body import ATTITUDE, POSITION, RATES, VELOCITY, RigidBody
from visadapt.systems.stiffness import longest_step

Columns = tuple[int, ...]
"""Indices into the state vector."""


@dataclass(frozen=True)
class Convention:
    """Signs with which a recording may differ from the source."""

    name: str  # the quantity of opposite sign, as the warning calls it
    columns: Columns  # states that change sign
    commands: Columns = ()  # commands that change sign


@dataclass(frozen=True)
class SystemProfile:
    """What estimation and diagnosis must know of a system: its sensors, and how much work the search may spend."""

    driven: tuple[Columns, ...]
    """velocities that the loads drive, one for each load in the order of the loads; process noise, which is a load, has
    the same variance in each velocity of a group"""
    position_of: Mapping[int, int]
    """column of a velocity to the column of its position, for velocities that a recording may lack"""
    sensors: tuple[Columns, ...]  # columns that one kind of sensor measures, with the same noise variance
    quaternion: Columns  # columns of the attitude quaternion, which means the same with either sign; empty without one
    initial_variance: tuple[float, ...]
    """(n,) variance of the first state of a window around its measurement, in the states' units squared"""
    region_variables: Mapping[str, str]  # unit of a region's edges to the variable along which that region lies
    plotted_variables: tuple[str, ...]  # variables over which the report plots the disturbance, most instructive first
    residual_name: str  # the first load in words, as the report's figures label it
    smooth_function_factors: Mapping[str, tuple[str | None, ...]]
    """load to the variables that multiply a smooth function on it (None: no factor); (None,) for loads not listed"""
    search_rows: int = 1200
    """rows that the search uses: of a longer recording, windows spread evenly over it, before the best sets are fitted
    to every row"""
    is_aircraft: bool = False  # whether experiments are advised as flights instead of motions on a track
    window_rows: int = 120
    """rows of a window; longer episodes are cut, which loses little since states far apart hardly inform each other"""
    longest_step: float = 0.025
    """s, the longest Runge-Kutta step for smooth physics when an effect is fitted (screening takes one per period): one
    of 0.05 s errs by 3e-4 of a velocity that friction damps at 10 1/s, more than the noise of a good sensor"""
    coarsest_step: float = math.inf  # s, the longest step in the screening, beyond which Runge-Kutta is unstable
    fine_step: float = math.inf
    """s, the longest step of the final fits, in which an oscillation keeps its frequency to within an encoder's step"""
    longest_abrupt_steps: tuple[float, ...] = (float("inf"), 0.0125, 0.005)
    """s, the longest integration steps under abrupt effects, at the accuracies COARSEST, COARSE and FINE"""
    relinearise_every: int = 1
    """iterations of a fit between two computations of the derivatives by the states; more than 1 is accurate enough
    where all states are measured"""
    check_sensors: bool = True
    """whether to look for defective angle sensors, and other sign conventions"""
    angle_sensor: Columns = ()  # columns of the angle, and of its rate, whose sensor is checked for defects
    sign_conventions: tuple[Convention, ...] = ()
    """sign conventions, other than the source's, in which a recording may be"""
    min_gain: float = 1.0  # log likelihood that an effect must gain in the screening to be fitted
    min_gain_per_parameter: float = 0.0  # log likelihood required in addition for each of the effect's parameters
    min_gain_share: float = 0.0  # share of the best candidate's gain that a candidate must reach to be fitted
    smooth_function_threshold: float = 4.0  # log odds above which a smooth function counts as something unexplained
    compared_models: int = 8  # models, the most probable ones, that are compared
    folds: int = 4  # folds of the cross-validation
    beam_width: int = 3  # models of each size to which the search adds another effect
    screening_rows: float = 4e5
    """rows times parameter points per effect; above it the screening uses every 2nd, 4th, ... window"""

    @property
    def driven_columns(self) -> list[int]:
        """The driven columns of all groups."""
        return [column for group in self.driven for column in group]


_CART_POLE = SystemProfile(
    driven=((1,), (3,)),
    position_of={1: 0, 3: 2},
    sensors=((0,), (1,), (2,), (3,)),
    quaternion=(),
    initial_variance=(0.3**2, 2.0**2, 0.3**2, 3.0**2),
    region_variables={"s": "time", "m": "x", "rad": "theta"},
    plotted_variables=("x_dot", "x", "command", "time", "theta", "theta_dot"),
    residual_name="force on the cart",
    smooth_function_factors={"cart_force": (None, "x_dot", "command"), "pivot_torque": (None, "theta_dot")},
    angle_sensor=(2, 3),
    sign_conventions=(
        Convention("the angle", (2, 3)),
        Convention("the command", (), (0,)),
        Convention("the position", (0, 1)),
    ),
)


def _span(columns: slice) -> Columns:
    return tuple(range(columns.start, columns.stop))


_VEHICLE = SystemProfile(
    driven=(_span(VELOCITY), _span(RATES)),
    position_of=dict(zip(_span(VELOCITY), _span(POSITION), strict=True)),
    sensors=tuple(_span(columns) for columns in (POSITION, VELOCITY, ATTITUDE, RATES)),
    quaternion=_span(ATTITUDE),
    initial_variance=(3.0**2,) * 6 + (0.1**2,) * 4 + (1.0,) * 3,  # a GNSS is noisy, and late at any speed
    region_variables={"s": "time", "m": "z"},
    plotted_variables=("x_dot", "thrust", "time", "z"),
    residual_name="force along x",
    smooth_function_factors={},
    search_rows=650,
    is_aircraft=True,
    window_rows=25,
    longest_abrupt_steps=(0.05, 0.034, 0.0125),
    relinearise_every=4,
    check_sensors=False,
    min_gain_per_parameter=3.0,
    min_gain_share=0.3,
    # With more functions to choose from, the largest log odds by chance are higher.
    smooth_function_threshold=6.0,
    compared_models=4,
    folds=2,
    beam_width=2,
    screening_rows=1.5e4,
)
"""Common to quadrotor and fixed wing: all 13 states are measured, so that short windows and few rows suffice."""


PROFILES: dict[type[System], SystemProfile] = {
    CartPole: _CART_POLE,
    # Runge-Kutta must be stable: the rate loop decays at 16.6 1/s, the wing's roll rate at 1.95 per metre flown.
    Quadrotor: replace(_VEHICLE, longest_step=0.035),
    FixedWing: replace(_VEHICLE, longest_step=0.025, longest_abrupt_steps=(0.025, 0.017, 0.0125)),
    # Of one's own, with actions of any name.
    RigidBody: replace(_VEHICLE, plotted_variables=("x_dot", "time", "z")),  # type: ignore[type-abstract]
}
"""The profile of each system class, for its default parameters."""


def profile_of(system: System) -> SystemProfile:
    """The profile of a system, or of the class that it derives from; of a system of one's own, made from its class.

    Integration steps are those for the default parameters, shorter where these of `system` make it faster.

    Raises:
        ValueError: a system of one's own does not state `coordinates` for each of its loads.
    """
    return _profile_of(type(system), parameters(system))


@lru_cache(256)
def _profile_of(kind: type[System], values: Parameters) -> SystemProfile:
    profile = next((each for base, each in PROFILES.items() if issubclass(kind, base)), None) or _own_profile(kind)
    longest = longest_step(kind(**dict(values)))
    if kind in SYSTEMS.values() and longest >= longest_step(kind()):
        return profile  # which says what is fast enough
    return replace(
        profile,
        longest_step=min(profile.longest_step, longest),
        coarsest_step=min(profile.coarsest_step, longest),
        fine_step=math.inf if kind in SYSTEMS.values() else FINE_SHARE * longest,
        longest_abrupt_steps=tuple(min(step, longest) for step in profile.longest_abrupt_steps),
    )


FINE_SHARE = 1 / 3
"""Step of the final fits, over the longest one. The longest may leave a stiffness 1e-3 off, which an encoder shows on a
lightly damped joint; a third of it leaves 2e-5 (the error of the Runge-Kutta method grows with the fourth power)."""

FIRST_STATE_SHARE = 0.3
"""Deviation of a window's first state from its measurement, as a share of the largest size in the state's range."""


@cache
def _own_profile(system: type[System]) -> SystemProfile:
    """From the states, actions, loads and coordinates of a system of one's own, each sensor and each joint alone."""
    if not system.coordinates or len(system.coordinates) != len(system.loads):
        raise ValueError(
            f"{system.name} cannot be diagnosed: its coordinates are {system.coordinates!r}; a pair (column of the "
            f"position, column of the velocity) for each of its {len(system.loads)} loads, as in ((0, 1),), is right"
        )
    names, units = [state.name for state in system.states], [state.unit for state in system.states]
    positions, velocities = system.velocity_of(), [velocity for _, velocity in system.coordinates]
    by_unit = {units[p]: names[p] for p in positions if sum(units[p] == units[q] for q in positions) == 1}
    along = system.coordinates[0][0]
    slower = system.prediction_time / System.prediction_time
    return SystemProfile(
        driven=tuple((velocity,) for velocity in velocities),
        position_of={velocity: position for position, velocity in positions.items()},
        sensors=tuple((column,) for column in range(len(names))),
        quaternion=(),
        initial_variance=tuple((FIRST_STATE_SHARE * s.largest) ** 2 for s in system.states),
        region_variables={"s": "time", **by_unit},
        plotted_variables=(
            names[velocities[0]],
            *([] if along is None else [names[along]]),
            system.actions[0].name,
            "time",
        ),
        residual_name=system.loads[0].name.replace("_", " "),
        smooth_function_factors={
            load.name: (None, names[velocity]) for load, velocity in zip(system.loads, velocities, strict=True)
        },
        sign_conventions=tuple(_own_conventions(system)),
        longest_step=slower * SystemProfile.longest_step,
        longest_abrupt_steps=tuple(slower * step for step in SystemProfile.longest_abrupt_steps),
    )


def _own_conventions(system: type[System]) -> Iterator[Convention]:
    """Commands of the other sign, one by one and all of them, each joint, and each state that belongs to no joint."""
    signed = [k for k, action in enumerate(system.actions) if action.low < 0]
    for k in signed:
        yield Convention(system.actions[k].name, (), (k,))
    if len(signed) > 1:
        yield Convention("every command", (), tuple(signed))
    alone = [(column,) for column in system.outside_joints()]
    for columns in (*system.velocity_of().items(), *alone):
        if all(system.states[column].low < 0 for column in columns):
            yield Convention(system.states[columns[0]].name, columns)

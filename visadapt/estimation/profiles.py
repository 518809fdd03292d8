"""What a diagnosis needs to know of a system beside its physics, in one place for each system that can be diagnosed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from visadapt.systems import CartPole, FixedWing, Quadrotor, System
from visadapt.systems.rigid_body import ATTITUDE, POSITION, RATES, VELOCITY

Columns = tuple[int, ...]
"""Of the state."""


@dataclass(frozen=True)
class Convention:
    """Another sign convention than the source's."""

    what: str
    states: float
    """factor on the columns that a worn sensor holds: the angle and its rate"""
    command: float


@dataclass(frozen=True)
class SystemProfile:
    """A system as the diagnosis sees it."""

    driven: tuple[Columns, ...]
    """velocities, in which process noise enters, one for each load in the order of the loads; those of a group have
    the same variance"""
    slopes: Mapping[int, int]
    """of a velocity that may be missing from a recording: the column that it is the rate of"""
    sensors: tuple[Columns, ...]
    """columns that one kind of sensor reads, with the same noise"""
    attitude: Columns
    """of a quaternion, which is the same attitude with either sign; none where there is none"""
    spread: tuple[float, ...]
    """variances of the first state around the measured one"""
    places: Mapping[str, str]
    """by unit, the variable along which regions of that unit lie"""
    drawn: tuple[str, ...]
    """variables over which the report draws what is left, the most telling first"""
    residual: str
    """what the first load is, in words"""
    factors: Mapping[str, tuple[str | None, ...]]
    """by which variables a black box's function on each load is multiplied; (None,) where it is not listed"""
    rows: int = 1600
    """that a search uses; of more, windows spread evenly over the recording are taken"""
    flies: bool = False
    """what is worth recording of it next is told in other words"""
    window: int = 120
    """rows of a window; a longer episode is cut, since states far apart say nothing about each other's noise"""
    smooth_step: float = float("inf")
    """s, the longest step of Runge-Kutta's that smooth physics bears where an effect is not only to be proposed"""
    substeps: tuple[int, int, int] = (1, 4, 10)
    """in a period where an effect changes within one: to propose it, to try it, and for figures that are reported"""
    refresh: int = 1
    """iterations of a fit for which derivatives by the states are kept: those of states that are all measured change
    little on the way"""
    doubted: bool = True
    """whether worn sensors, other conventions, and velocities that are no measurements of their own are looked for"""
    held: Columns = ()
    """an angle and its rate, of whose sensor defects are looked for"""
    conventions: tuple[Convention, ...] = ()
    """other sign conventions in which a recording may be"""
    promising: tuple[float, float] = (1.0, 0.0)
    """log likelihood that a lead must promise to be fitted, and more of it for each parameter; an effect costs more"""
    rivalling: float = 0.0
    """share of what the best lead promises that another must promise to be fitted"""
    retried: bool = False
    """whether a subset of a set that was fitted before is fitted again from the set's own parameters"""
    function: float = 4.0
    """log odds of a function of the black box beside a set from which on it counts as something unexplained"""
    weighed: int = 8
    """sets, the most probable ones, of which it is asked what they leave unexplained"""
    folds: int = 4
    """in which episodes are held out"""
    beam: int = 3
    """sets that are taken further at each size"""
    tried_rows: float = float("inf")
    """rows, over all points at which an effect is tried, beyond which only some of the windows are looked at"""

    @property
    def columns(self) -> list[int]:
        """All driven columns."""
        return [column for group in self.driven for column in group]


_CART_POLE = SystemProfile(
    driven=((1,), (3,)),
    slopes={1: 0, 3: 2},
    sensors=((0,), (1,), (2,), (3,)),
    attitude=(),
    spread=(0.3**2, 2.0**2, 0.3**2, 3.0**2),
    places={"s": "time", "m": "x", "rad": "theta"},
    drawn=("x_dot", "x", "command", "time", "theta", "theta_dot"),
    residual="force on the cart",
    factors={"cart_force": (None, "x_dot", "command"), "pivot_torque": (None, "theta_dot")},
    held=(2, 3),
    conventions=(
        Convention("the angle", -1, 1),
        Convention("the command", 1, -1),
        # The position's sign is that of angle and command together, by the symmetry of the cart-pole.
        Convention("the position", -1, -1),
    ),
)


def _span(columns: slice) -> Columns:
    return tuple(range(columns.start, columns.stop))


_VEHICLE = SystemProfile(
    driven=(_span(VELOCITY), _span(RATES)),
    slopes=dict(zip(_span(VELOCITY), _span(POSITION), strict=True)),
    sensors=tuple(_span(columns) for columns in (POSITION, VELOCITY, ATTITUDE, RATES)),
    attitude=_span(ATTITUDE),
    spread=(0.3**2,) * 3 + (1.0,) * 3 + (0.1**2,) * 4 + (1.0,) * 3,
    places={"s": "time", "m": "z"},
    drawn=("x_dot", "thrust", "time", "z"),
    residual="force along x",
    factors={},
    rows=650,
    flies=True,
    window=25,
    substeps=(2, 3, 4),
    refresh=4,
    doubted=False,
    promising=(1.0, 3.0),
    rivalling=0.3,
    retried=True,
    # Of more functions the most evident is more evident by chance.
    function=6.0,
    weighed=4,
    folds=2,
    beam=2,
    tried_rows=1.5e4,
)
"""What quadrotor and fixed wing share: 13 states, all of them measured, so that short windows and few rows will do."""


PROFILES: dict[type[System], SystemProfile] = {
    CartPole: _CART_POLE,
    # The rate loop decays at 16.6 a second, the wing's roll rate at 1.95 a metre.
    Quadrotor: replace(_VEHICLE, smooth_step=0.035),
    FixedWing: replace(_VEHICLE, smooth_step=0.025),
}
"""By the class of the system."""

DIAGNOSABLE: dict[str, type[System]] = {system.name: system for system in PROFILES}
"""The systems that can be diagnosed, by name."""


def profile_of(system: System) -> SystemProfile:
    """What is known of a system, or of one derived from it.

    Raises:
        ValueError: it cannot be diagnosed.
    """
    for kind, profile in PROFILES.items():
        if isinstance(system, kind):
            return profile
    raise ValueError(f"diagnose: {', '.join(DIAGNOSABLE)} is what can be diagnosed, got {system.name}")

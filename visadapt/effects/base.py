"""The one idea: everything that separates the target from the source is an Effect.

An effect acts at one stage along a step (actuation, dynamics, sensing, camera, or any). Its class states all that the
rest of the library must know of it: equation, source, parameters with unit, searched range and role, its place among
the effects of its stage, and which effects it is indistinguishable from. Subclasses register themselves by name, so
adding an effect means adding one class.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import Any, ClassVar, Self, TypeAlias

import torch
from torch import Tensor, nn

from visadapt.systems import SYSTEMS, System
from visadapt.systems.integrators import Duration

__all__ = ["EFFECTS", "ActuationEffect", "DynamicsEffect", "Effect", "Parameter", "Role", "SensingEffect", "Stage"]


class Stage(StrEnum):
    """Where along a step an effect acts."""

    ACTUATION = "actuation"
    DYNAMICS = "dynamics"
    SENSING = "sensing"
    CAMERA = "camera"
    ANY = "any"


class Role(StrEnum):
    """What a parameter stands for, where a fit must treat it in a special way."""

    PLAIN = "plain"  # Nothing special: a strength, or a shape such as a spring's rest position
    START = "start"  # Where a region of a state or of time starts; searched within what the recording covers
    END = "end"  # Where that region ends
    FREQUENCY = "frequency"  # In Hz; searched on a logarithmic grid
    PHASE = "phase"  # In rad; equal modulo a turn
    EPISODE_PHASE = "episode phase"  # Phase of one episode after the first, where each has its own
    WAVES = "waves"  # How often something returns within a turn; tried at whole numbers
    COMMAND = "command"  # A size of the command; tried at values up to the largest that was recorded


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect: its unit, the range searched, and the value at which the effect vanishes.

    `neutral` is None for a parameter (a phase, for example) that shapes the effect and cannot switch it off; where
    several parameters have a neutral value, the effect vanishes when all of them take it. `linear` states that what
    the effect adds (to the load, the command or the reading) is proportional to value - neutral while its nonlinear
    parameters are fixed; the contributions of several linear parameters add up.

    >>> import visadapt as va
    >>> va.effects.ViscousFriction.table[0].unit
    'N s/m'
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float | None
    linear: bool = False
    role: Role = Role.PLAIN

    @property
    def is_edge(self) -> bool:
        """Whether it is the start or the end of a region."""
        return self.role in (Role.START, Role.END)

    @property
    def is_phase(self) -> bool:
        """Whether it is a phase, of all episodes or of one."""
        return self.role in (Role.PHASE, Role.EPISODE_PHASE)

    @property
    def is_strength(self) -> bool:
        """Whether it switches the effect off at its neutral value; the edges of a region set its place instead."""
        return self.neutral is not None and not self.is_edge


class Effect(nn.Module):
    """Base of all effects. Parameters are tensors in physical units: scalars, or one value per batch row (B,).

    >>> import visadapt as va
    >>> friction = va.effects.ViscousFriction(coefficient=2.0)
    >>> isinstance(friction, va.Effect), friction.name, friction.stage.value
    (True, 'viscous_friction', 'dynamics')
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    systems: ClassVar[tuple[type[System], ...]] = (System,)
    """The systems that it acts on; every system by default."""
    equation: ClassVar[str]
    source: ClassVar[str]
    table: ClassVar[tuple[Parameter, ...]] = ()
    indistinguishable_from: ClassVar[tuple[str, ...]] = ()
    """Names of the effects that passive data (without a dedicated experiment) cannot separate from this one."""
    separable_on: ClassVar[tuple[type[System], ...]] = ()
    """Systems on which passive data do separate it from those effects."""
    settled_by: ClassVar[Mapping[str, str]] = {}
    """The experiment that tells this effect from another one, by the other's name; stated on one of the two."""
    caveat: ClassVar[str] = ""
    """What else could explain a recording that shows this effect; the diagnosis adds it as a warning."""
    order: ClassVar[int] = 1000
    """Position among the effects of its stage, which act in ascending order; without one, it acts last."""
    abrupt: ClassVar[bool] = False
    """Whether it changes suddenly within a control period, which must then be integrated in several substeps."""
    repeats_readings: ClassVar[bool] = False
    """Whether it shows as readings that repeat exactly; it is then counted from those instead of being fitted."""
    no_gradient: ClassVar[str] = ""
    """Why there is no gradient in the parameters; empty where there is one."""

    def __init_subclass__(cls, **kwargs: object) -> None:
        super().__init_subclass__(**kwargs)
        if "name" in cls.__dict__:
            taken = EFFECTS.get(cls.name)
            if taken is not None and taken.__qualname__ != cls.__qualname__:
                raise ValueError(f"the effect name {cls.name!r} is taken by {taken.__module__}.{taken.__qualname__}")
            own = ("training", *Effect.__annotations__)
            for parameter in cls.table:
                if parameter.name in own or callable(getattr(cls, parameter.name, None)):
                    raise ValueError(
                        f"{cls.name}: every effect has something else that is called {parameter.name}, so no parameter "
                        "can be called so: name it otherwise"
                    )
            EFFECTS[cls.name] = cls

    def __init__(self, **values: float | Tensor) -> None:
        super().__init__()
        known = {parameter.name for parameter in self.table}
        if values.keys() != known:
            raise ValueError(
                f"{self.name} takes the parameters {', '.join(sorted(known)) or 'none'}; "
                f"got {', '.join(sorted(values)) or 'none'}"
            )
        for key, value in values.items():
            self._parameters[key] = nn.Parameter(torch.as_tensor(value, dtype=torch.get_default_dtype()))

    def extra_repr(self) -> str:
        """The parameters with their values, as `print` shows them.

        >>> import visadapt as va
        >>> va.effects.CoulombFriction(force=1.5)
        CoulombFriction(force=1.5)
        """
        values = {parameter.name: getattr(self, parameter.name) for parameter in self.table}
        return ", ".join(f"{name}={v.item():.6g}" for name, v in values.items() if v.numel() == 1)

    @classmethod
    def is_simpler(cls, values: Sequence[float]) -> bool:
        """Whether, at these values of its parameters (P,), some of them do nothing: a simpler effect does the same."""
        return False

    def with_values(self, values: Tensor) -> Self:
        """The same effect with other parameters: (P,) in the order of `table`, or (B, P), a row for each batch row."""
        # Plain tensors in the place of registered parameters, so that a gradient flows back to `values`.
        plain = {parameter.name: values[..., column] for column, parameter in enumerate(self.table)}
        made = object.__new__(type(self))
        made.__dict__ = {**self.__dict__, "_parameters": {}, **plain}
        return made

    @classmethod
    def rubs(cls) -> bool:
        """Whether it is, or brings, dry friction."""
        return False

    @classmethod
    def region(cls) -> tuple[Parameter, Parameter] | None:
        """The parameters at which the region that it acts in starts and ends; None where it acts everywhere."""
        edges = {parameter.role: parameter for parameter in cls.table if parameter.is_edge}
        return (edges[Role.START], edges[Role.END]) if len(edges) == 2 else None

    def value(self, name: str, like: Tensor) -> Tensor:
        """The parameter `name` with the device and dtype of `like`."""
        # Not get_parameter, which refuses the tensors of torch.func.functional_call.
        values: Tensor = getattr(self, name)
        return values.to(like)

    def column(self, name: str, like: Tensor) -> Tensor:
        """The parameter `name`, () or (B, 1, 1), to multiply tensors (B, time, n)."""
        values = self.value(name, like)
        return values if values.dim() == 0 else values[:, None, None]


class ActuationEffect(Effect):
    """Changes the command on its way to the physics.

    >>> import visadapt as va
    >>> isinstance(va.effects.ActuatorGain(scale=0.8), va.ActuationEffect)
    True
    """

    stage = Stage.ACTUATION
    # Commands jump between periods; a delay, a lag or a play turns such a jump into a change within a period.
    abrupt = True

    def acting_on(self, system: System) -> Self:
        """The effect bound to parameters of the altered system that it needs; itself where it needs none."""
        return self

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        """The effect's memory at the start of an episode, (B, any, n_action).

        `commands` (B, S, n_action), those of a period, give shape and dtype; before an episode the command was zero.
        """
        return commands[:, :0]

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        """The changed commands (B, S, n_action) over S substeps, and the new memory.

        A substep lasts `substep` s, or (B, S) s where the clock is unsteady. S may cover one period or a whole episode:
        the result is the same.
        """
        raise NotImplementedError


class DynamicsEffect(Effect):
    """Adds a load, a generalised force per degree of freedom, to the physics, or changes its parameters.

    >>> import torch, visadapt as va
    >>> class Magnet(va.DynamicsEffect):
    ...     name = "doc_magnet"
    ...     systems = (va.CartPole,)
    ...     equation = "force = strength x^3"
    ...     source = "an example"
    ...     table = (va.Parameter("strength", "N/m3", 0.0, 50.0, neutral=0.0, linear=True),)
    ...     def load(self, time, state, system):
    ...         force = self.value("strength", state) * state[:, 0] ** 3
    ...         return torch.stack((force, torch.zeros_like(force)), 1)
    >>> world = va.World(va.CartPole(), [Magnet(strength=8.0)])
    >>> world.load(world.start(torch.tensor([[0.5, 0.0, 0.0, 0.0]])))[0, 0].item()
    1.0
    >>> _ = va.effects.EFFECTS.pop("doc_magnet")  # an effect of one's own stays registered; this one was an example
    """

    stage = Stage.DYNAMICS

    dry_friction_by_velocity: ClassVar[bool] = True
    """whether `dry_friction` depends on velocities; where not, it is computed once for each integration step"""

    def alter(self, system: System) -> System:
        """The system with the parameters that this effect changes; its fields may then be tensors, () or (B,)."""
        return system

    def vary(self, system: System, time: Tensor, state: Tensor) -> System:
        """The altered system at the time (B,) in s since the start of the episode, in a state (B, n_state).

        For parameters that change within an episode: called at every derivative, `alter` only once a period.
        """
        return system

    def load(self, time: Tensor, state: Tensor, system: System) -> Tensor:
        """Load (B, n_load) at the time (B,) in s since the start of the episode, in a state (B, n_state).

        `system` has been altered and varied by all effects. Dry friction is no load: see `dry_friction`.
        """
        return torch.zeros(len(state), len(system.loads), device=state.device, dtype=state.dtype)

    @classmethod
    def only_loads(cls) -> bool:
        """Whether it does nothing but add a load."""
        base = DynamicsEffect
        return cls.alter is base.alter and cls.vary is base.vary and not cls.rubs()

    @classmethod
    def rubs(cls) -> bool:
        """Whether it is, or brings, dry friction."""
        return cls.dry_friction is not DynamicsEffect.dry_friction

    def dry_friction(self, time: Tensor, state: Tensor, command: Tensor, system: System) -> Tensor:
        """The largest dry friction (B, n_load, 2), N or N m, against positive and negative motion.

        Within an integration step under `command` (B, n_action), only velocities in `state` change. The other
        arguments as in `load`.
        """
        raise NotImplementedError


Reading: TypeAlias = tuple[Tensor, Tensor]  # what is read of a row, states (B, n_state) or a frame, and the new memory


class SensingEffect(Effect):
    """Changes what is measured of the state, row by row.

    >>> import torch, visadapt as va
    >>> world = va.World(va.CartPole(), [va.effects.AngleOffset(offset=0.1)])
    >>> measured, _ = world.measure(world.start(torch.zeros(1, 4)))
    >>> round(measured[0, 2].item(), 3)
    0.1
    """

    stage = Stage.SENSING

    def memory(self, state: Tensor, period: float) -> Tensor:
        """The effect's memory (B, any, any) before the first row of an episode that begins in `state` (B, n_state).

        Before the episode, its first state is taken as measured.
        """
        return state[:, None, :0]

    def under(self, system: System, command: Tensor, rate: Tensor) -> Self:
        """The effect bound to the altered system and to what acts of the command (B, n_action) as the row is read, with
        its rate of change (B, n_action) over the period before, per s; itself where it needs none of these."""
        return self

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        """The reading of one row (B, n_state) and the new memory; rows are `period` s apart.

        Only random effects need the `generator`.
        """
        raise NotImplementedError


def require_system(system: System, effect: Effect | type[Effect]) -> Any:
    """The system, where it is one that the effect acts on.

    Raises:
        TypeError: it is not.
    """
    if not isinstance(system, effect.systems):
        kinds = " or a ".join(getattr(kind, "name", kind.__name__) for kind in effect.systems)
        raise TypeError(f"{effect.name} acts on a {kinds}, not on a {system.name}")
    return system


def check_acts_on(system: System, effect: Effect) -> None:
    """Raise TypeError where an effect does not act on a system.

    An effect of a library's system also acts on a system of one's own with the same states, in the same columns, and as
    many loads: on a cart-pole of one's own, say.
    """

    def columns(kind: type[System]) -> tuple[list[str], int]:
        return [state.name for state in getattr(kind, "states", ())], len(getattr(kind, "loads", ()))

    own = type(system)
    if own in SYSTEMS.values() or columns(own) not in map(columns, effect.systems):
        require_system(system, effect)


def inside(place: Tensor, start: Tensor, end: Tensor, width: float) -> Tensor:
    """1 between start and end and 0 outside, with logistic edges: from 10 % to 90 % in 4.4 `width`.

    Its integral is end - start whatever the width; it is 0 where end <= start.
    """
    return (((place - start) / width).sigmoid() - ((place - end) / width).sigmoid()).clamp_min(0)


EFFECTS: dict[str, type[Effect]] = {}  # Every effect by its standard name


def with_table(name: str, table: tuple[Parameter, ...]) -> type[Effect]:
    """The effect of this name with `table` in place of its own; the class in `EFFECTS` itself if both are equal."""
    effect = EFFECTS[name]
    return effect if table == effect.table else _derived(effect, table)  # type: ignore[arg-type]  # hashable, as types


@cache
def _derived(effect: type[Effect], table: tuple[Parameter, ...]) -> type[Effect]:
    return type(effect.__name__, (effect,), {"table": table, "__module__": effect.__module__})

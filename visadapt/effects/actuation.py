"""Effects on the command between the controller and the motor.

The command is held constant over each substep. Where an effect changes it inside a substep (a delay of half a substep,
a lag), the mean over the substep acts: its impulse is exact, and it is smooth in the parameters. Widths, limits and
offsets are in units of the command. Dead zone, saturation and backlash keep their piecewise linear textbook forms,
which are continuous in command and parameter, with one-sided derivatives at their kinks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from visadapt.effects.base import ActuationEffect, Effect, Parameter, Role
from visadapt.effects.recurrence import linear_recurrence
from visadapt.systems import System
from visadapt.systems.integrators import Duration

__all__ = [
    "ActuatorBacklash",
    "ActuatorBias",
    "ActuatorDeadzone",
    "ActuatorDelay",
    "ActuatorGain",
    "ActuatorLag",
    "ActuatorSaturation",
]


class ActuatorDelay(ActuationEffect):
    """A pure delay of any length, also a fraction of a substep.

    A delayed command can change inside a substep; the command that acts is constant over a substep. It is the mean of
    the delayed command, corrected by opposite impulses in neighbouring substeps, so that by the end of the period a
    mass has moved just as far and is as fast. This is differentiable in the delay. Backlash, dead zone and saturation
    commute with a delay, but would ratchet on these impulses, so the delay is computed after them. Only the start of an
    episode could separate it from measurement_delay, and only if the first state were known without noise and not at
    rest.
    """

    name = "actuator_delay"
    order = 45
    equation = "u(t) = command(t - delay)"
    source = "Franklin, Powell and Workman (1998), Digital Control of Dynamic Systems, section 4.3.3"
    table = (Parameter("delay", "s", 0.0, 0.2, 0.0),)
    indistinguishable_from = ("measurement_delay", "camera_delay")
    settled_by: ClassVar[Mapping[str, str]] = {
        "measurement_delay": (
            "time command and sensor against one clock: film the machine beside a lamp that lights with the command; a "
            "late motion is the actuator's delay, a late reading of it the sensor's"
        ),
        "camera_delay": (
            "let a lamp in the picture light with the command: if it lights late in the film, the camera is late; if "
            "the cart alone moves late, the actuator is"
        ),
        "actuator_lag": (
            "record steps of the command, large and held for several times the delay, at the highest rate that the "
            "sensors have: after a delay the acceleration jumps, after a lag it creeps up"
        ),
    }

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        # Past commands, how long each was held, and the number of substeps in a period, over twice the delay, so that
        # it suffices for substeps half as long.
        delay = self.value("delay", commands).detach().expand(len(commands))
        if not len(delay):
            return commands.new_zeros(0, 1, commands.shape[-1] + 2)
        if not bool((delay >= 0).all()):
            raise ValueError(f"actuator_delay: delay must not be negative, got {float(delay.min()):g} s")
        remembered = 2 * math.ceil(float(delay.max()) / substep) + 1
        held = torch.full_like(commands[:, :1, :1], substep)
        count = torch.full_like(held, commands.shape[1])
        return torch.cat((torch.zeros_like(commands[:, :1]), held, count), -1).expand(-1, remembered, -1)

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        batch, count, width = commands.shape
        if not batch:
            return commands, memory
        held = torch.as_tensor(substep, dtype=commands.dtype, device=commands.device).expand(batch, count)
        period = memory[:, -1:, -1:].expand(-1, count, -1)
        past = torch.cat((memory, torch.cat((commands, held[..., None], period), -1)), 1)
        command, lasting = past[..., :-2], past[..., -2:-1]
        # The command's integral, and the integral of that, up to each edge between substeps, from the first remembered.
        edge = _from_zero(lasting)[..., 0]
        once = _from_zero(command * lasting)
        twice = _from_zero(once[:, :-1] * lasting + 0.5 * command * lasting.square())
        # ... and up to a delay before each edge of the present substeps; differences of `once` are impulses.
        wanted = (edge[:, -count - 1 :] - self.value("delay", commands).expand(batch)[:, None]).clamp_min(0)
        left = (torch.searchsorted(edge.detach(), wanted.detach()) - 1).clamp(0, past.shape[1] - 1)
        columns = left[..., None].expand(-1, -1, width)
        inside = (wanted - edge.gather(1, left))[..., None]
        command, once, twice = (table.gather(1, columns) for table in (command, once, twice))
        twice = twice + once * inside + 0.5 * command * inside.square()
        once = once + command * inside
        impulse, lasting = once.diff(dim=1), held[..., None]
        # How much further the command moves a unit mass than its mean does.
        excess = twice.diff(dim=1) - lasting * (once[:, :-1] + 0.5 * impulse)
        return (impulse + _shifts(excess, lasting, int(memory[0, -1, -1]))) / lasting, past[:, count:]


def _from_zero(values: Tensor) -> Tensor:
    """Cumulative sums (B, S + 1, n) of values (B, S, n), from 0 on."""
    return pad(values.cumsum(1), (0, 0, 1, 0))


def _shifts(excess: Tensor, lasting: Tensor, period: int) -> Tensor:
    """Impulses (B, S, n), of sum zero in a period of `period` substeps, that move a unit mass further by `excess`.

    Each excess takes two opposite impulses: in its substep and the next one, or, in the last substep of a period, in
    the one before and in this one.
    """
    count = excess.shape[1]
    if period == 1 or not bool(excess.any()):
        return torch.zeros_like(excess)
    apart = 0.5 * (lasting[:, 1:] + lasting[:, :-1])
    last = (torch.arange(count, device=excess.device) % period == period - 1)[:, None]
    given = torch.where(last[:-1], 0.0, excess[:, :-1]) / apart  # in this substep, and back in the next
    taken = torch.where(last[1:], excess[:, 1:], 0.0) / apart  # in the one before the last, and back in the last
    return pad(given + taken, (0, 0, 0, 1)) - pad(given + taken, (0, 0, 1, 0))


class ActuatorBacklash(ActuationEffect):
    """Play in the transmission: the output stays until the command has crossed it, then follows at half its width.

    The output begins at 0, in the middle of the play.
    """

    name = "actuator_backlash"
    order = 20
    equation = "u_k = min(max(u_(k-1), command_k - width/2), command_k + width/2)"
    source = "Tao and Kokotovic (1996), Adaptive Control of Systems with Actuator and Sensor Nonlinearities, chapter 2"
    table = (Parameter("width", "1", 0.0, 1.0, 0.0, role=Role.COMMAND),)

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        return torch.zeros_like(commands[:, :1])

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        half = self.column("width", commands) / 2
        follows, output = memory[:, 0], []
        for low, high in zip((commands - half).unbind(1), (commands + half).unbind(1), strict=True):
            # Not clamp: without play, low = high, the gradient is that of the side the output comes from.
            follows = torch.where(follows < low, low, torch.where(follows > high, high, follows))
            output.append(follows)
        return torch.stack(output, 1), follows[:, None]


class ActuatorDeadzone(ActuationEffect):
    """Commands up to `width` do nothing (static friction in a gear, a valve's overlap); larger ones lose `width`."""

    name = "actuator_deadzone"
    order = 30
    equation = "u = sign(command) max(|command| - width, 0)"
    source = "Tao and Kokotovic (1996), Adaptive Control of Systems with Actuator and Sensor Nonlinearities, chapter 2"
    table = (Parameter("width", "1", 0.0, 0.6, 0.0, role=Role.COMMAND),)

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        # The sign stays outside: a clamp between equal limits would have no gradient in a width of 0.
        return commands.sign() * (commands.abs() - self.column("width", commands)).clamp_min(0), memory


class ActuatorSaturation(ActuationEffect):
    """A limit of the supply or the current on the command that the motor follows; without it the limit is 1."""

    name = "actuator_saturation"
    order = 40
    equation = "u = min(max(command, -limit), limit)"
    source = "Khalil (2002), Nonlinear Systems, section 1.2.7"
    table = (Parameter("limit", "1", 0.02, 1.0, 1.0, role=Role.COMMAND),)

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        limit = self.column("limit", commands)
        return torch.minimum(torch.maximum(commands, -limit), limit), memory


class ActuatorGain(ActuationEffect):
    """A motor stronger or weaker than the source's.

    If cart and pole are both heavier by a factor, the motion is that of a gain divided by this factor.
    """

    name = "actuator_gain"
    order = 50
    equation = "u = scale command"
    source = "Franklin, Powell and Emami-Naeini (2015), Feedback Control of Dynamic Systems, section 2.3"
    table = (Parameter("scale", "1", 0.2, 8.0, 1.0, linear=True),)
    settled_by: ClassVar[Mapping[str, str]] = {
        "cart_mass": (
            "push the cart by hand with the motor off, or weigh it: a heavier cart accelerates less under any force, a "
            "weaker motor only under its own"
        )
    }

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        return self.column("scale", commands) * commands, memory


class ActuatorBias(ActuationEffect):
    """A constant added to every command; on a cart-pole, a force of max_force * offset."""

    name = "actuator_bias"
    order = 60
    equation = "u = command + offset"
    source = "Ding (2013), Model-Based Fault Diagnosis Techniques, section 3.5 (additive actuator fault)"
    table = (Parameter("offset", "1", -0.35, 0.35, 0.0, linear=True),)
    indistinguishable_from = ("constant_force",)
    settled_by: ClassVar[Mapping[str, str]] = {
        "constant_force": (
            "switch the motor off, let the cart stand with the pole hanging or removed, and measure the force on it "
            "with a spring balance: a constant force is still there, an actuator bias is gone"
        )
    }

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        return commands + self.column("offset", commands), memory


class ActuatorLag(ActuationEffect):
    """A motor that follows its command as a first-order system, because of its current or its electronics."""

    name = "actuator_lag"
    order = 70
    equation = "time_constant du/dt = command - u, u(0) = 0"
    source = "Franklin, Powell and Emami-Naeini (2015), Feedback Control of Dynamic Systems, section 3.1"
    table = (Parameter("time_constant", "s", 0.0, 0.3, 0.0),)
    caveat = (
        "sensors that all lag alike, as thermocouples do, give nearly the same recording; a step of the command from "
        "rest, with its current or force measured, tells which lags"
    )

    def memory(self, commands: Tensor, substep: float) -> Tensor:
        return torch.zeros_like(commands[:, :1])

    def apply_to(self, commands: Tensor, memory: Tensor, substep: Duration) -> tuple[Tensor, Tensor]:
        substeps = substep[..., None] if isinstance(substep, Tensor) else substep
        ratio = (self.column("time_constant", commands) / substeps).expand(commands.shape[0], commands.shape[1], 1)
        # exp(-1000) is 0 in every precision, and so are its derivatives: the limit is exact, and nothing divides by 0.
        rate = ratio.clamp_min(1e-3).reciprocal()
        left = (-rate).exp()  # share of the old value that remains after a substep
        # u after each substep from an initial 0
        after, weight = linear_recurrence(left, -(-rate).expm1() * commands)
        after = after + weight * memory
        before = torch.cat((memory, after[:, :-1]), 1)
        # The mean of command + (before - command) exp(-t / time_constant) over the substep.
        return commands + (before - commands) * ratio * -(-rate).expm1(), after[:, -1:]


def follows_late(effect: type[Effect], system: System) -> bool:
    """Whether a motor under the effect follows its commands late: what acts depends on earlier ones."""
    if not issubclass(effect, ActuationEffect):
        return False
    one = effect(**{parameter.name: 0.0 for parameter in effect.table})
    return one.memory(torch.zeros(1, 1, len(system.actions)), 1.0).numel() > 0

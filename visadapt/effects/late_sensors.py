"""Late readings: of all sensors together, of one against the others, or of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from visadapt.effects.base import Effect, Parameter, Reading, SensingEffect
from visadapt.effects.camera import CameraEffect
from visadapt.systems import CartPole

__all__ = ["AngleDelay", "CameraDelay", "LateSensors", "MeasurementDelay", "PositionDelay"]

NEGLIGIBLE = 1e-3  # Delay, as a share of the largest that is searched, below which nothing is late


class Late(Effect):
    """Shows some of the states as they were `delay` s ago, and the others as they are.

    Between two rows, positions are interpolated by the cubic with the rows' positions and velocities (Hermite), and
    velocities are its slope; states without a velocity are interpolated linearly. Before the episode, its first state
    is taken as measured.
    """

    # First: it interpolates the true motion; the effects after it change the reading.
    order = 10
    source = (
        "Franklin, Powell and Workman (1998), section 4.3.3; de Boor (1978), A Practical Guide to Splines, chapter IV"
    )
    table = (Parameter("delay", "s", 0.0, 0.1, 0.0),)

    late: ClassVar[list[int]]
    """columns of the states that these sensors read; a late velocity is that of a late position"""
    positions: ClassVar[list[int]] = [CartPole.index("x"), CartPole.index("theta")]
    velocities: ClassVar[list[int]] = [CartPole.index("x_dot"), CartPole.index("theta_dot")]

    @classmethod
    def is_simpler(cls, values: Sequence[float]) -> bool:
        # Readings that are late by nothing still miss the process noise of their last period in a fit, and so may fit
        # better than those that are not late.
        return values[0] < NEGLIGIBLE * cls.table[0].high

    def memory(self, state: Tensor, period: float) -> Tensor:
        shift = self._shift(state, period).detach()
        if not len(state):
            return torch.cat((state, state[:, :1]), 1)[:, None]
        if not bool((shift >= 0).all()):
            raise ValueError(f"{self.name}: delay must not be negative, got {float(shift.min()) * period:g} s")
        # Each row carries its number, so that no row from before the episode is interpolated.
        row = torch.cat((state, torch.full_like(state[:, :1], -1)), 1)
        return row[:, None].expand(-1, int(shift.max().floor()) + 1, -1)

    def earlier(self, measured: Tensor, memory: Tensor, period: float) -> Reading:
        """The states (B, n_state) of one row, the late ones as they were, and the new memory."""
        number = memory[:, -1, -1] + 1
        rows = torch.cat((memory, torch.cat((measured, number[:, None]), 1)[:, None]), 1)
        shift = self._shift(measured, period)
        # Not torch.minimum, which halves the gradient where both are equal: in every first row without a delay.
        shift = torch.where(shift < number, shift, number)
        whole = shift.detach().floor()
        index = torch.arange(len(rows), device=rows.device), rows.shape[1] - 1 - whole.long()
        later, earlier = rows[index], rows[index[0], index[1] - 1]
        back = (shift - whole)[:, None]  # periods before the later row
        end, start = later[:, self.positions], earlier[:, self.positions]
        end_slope, start_slope = period * later[:, self.velocities], period * earlier[:, self.velocities]
        # The cubic in `back`, which runs from the later row (0) to the earlier one (1).
        bend = 3 * (start - end) + 2 * end_slope + start_slope
        twist = 2 * (end - start) - end_slope - start_slope
        position = end - back * (end_slope - back * (bend + back * twist))
        velocity = (end_slope - back * (2 * bend + 3 * back * twist)) / period
        seen = (later + back * (earlier - later))[:, :-1]
        seen[:, self.positions], seen[:, self.velocities] = position, velocity
        out = measured.clone()
        out[:, self.late] = seen[:, self.late]
        return out, rows[:, 1:]

    def _shift(self, state: Tensor, period: float) -> Tensor:
        """The delay in rows, (B,), in the precision of the state."""
        return (self.value("delay", state) / period).expand(len(state))


class LateSensors(Late, SensingEffect):
    """Sensors that read the state as it was `delay` s ago; the others read it as it is."""

    def apply_to(self, measured: Tensor, memory: Tensor, period: float, generator: torch.Generator | None) -> Reading:
        return self.earlier(measured, memory, period)


class CameraDelay(Late, CameraEffect):
    """Frames that arrive late, by any delay: a row's frame shows the scene that much earlier."""

    name = "camera_delay"
    systems = (CartPole,)
    equation = "frame(t) = picture of state(max(t - delay, 0))"
    in_one_frame = False
    table = (Parameter("delay", "s", 0.0, 0.2, 0.0),)
    indistinguishable_from = ("actuator_delay", "measurement_delay")
    late: ClassVar[list[int]] = list(range(len(CartPole.states)))

    def scene(self, state: Tensor, memory: Tensor, period: float) -> Reading:
        return self.earlier(state, memory, period)


class MeasurementDelay(LateSensors):
    """Measurements that arrive late, by any delay."""

    name = "measurement_delay"
    systems = (CartPole,)
    equation = "measured(t) = state(max(t - delay, 0))"
    table = (Parameter("delay", "s", 0.0, 0.2, 0.0),)
    indistinguishable_from = ("actuator_delay", "camera_delay")
    late: ClassVar[list[int]] = list(range(len(CartPole.states)))


class PositionDelay(LateSensors):
    """A position sensor that is late against the angle's, as when the two are read by different clocks."""

    name = "position_delay"
    systems = (CartPole,)
    equation = "(x, x_dot) measured(t) = (x, x_dot)(max(t - delay, 0))"
    late: ClassVar[list[int]] = [CartPole.index("x"), CartPole.index("x_dot")]


class AngleDelay(LateSensors):
    """An angle sensor that is late against the position's, as when the two are read by different clocks."""

    name = "angle_delay"
    systems = (CartPole,)
    equation = "(theta, theta_dot) measured(t) = (theta, theta_dot)(max(t - delay, 0))"
    late: ClassVar[list[int]] = [CartPole.index("theta"), CartPole.index("theta_dot")]

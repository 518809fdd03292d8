"""One step of dy/dt = f(t, y) for B rows: y (B, n) at times t (B,) goes on by h s, a number or (B,).

Hairer, Norsett and Wanner (1993), Solving ODEs I, section II.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from torch import Tensor

Derivative = Callable[[Tensor, Tensor], Tensor]
Duration = float | Tensor


def euler(f: Derivative, t: Tensor, y: Tensor, h: Duration) -> Tensor:
    """Explicit Euler, first order."""
    return y + _column(h) * f(t, y)


def midpoint(f: Derivative, t: Tensor, y: Tensor, h: Duration) -> Tensor:
    """Explicit midpoint rule (Runge 1895), second order."""
    step = _column(h)
    return y + step * f(t + h / 2, y + step / 2 * f(t, y))


def rk3(f: Derivative, t: Tensor, y: Tensor, h: Duration) -> Tensor:
    """Kutta's third-order method (Kutta 1901)."""
    step = _column(h)
    k1 = f(t, y)
    k2 = f(t + h / 2, y + step / 2 * k1)
    k3 = f(t + h, y + step * (2 * k2 - k1))
    return y + step / 6 * (k1 + 4 * k2 + k3)


def rk4(f: Derivative, t: Tensor, y: Tensor, h: Duration) -> Tensor:
    """The classical Runge-Kutta method (Kutta 1901), fourth order."""
    step = _column(h)
    k1 = f(t, y)
    k2 = f(t + h / 2, y + step / 2 * k1)
    k3 = f(t + h / 2, y + step / 2 * k2)
    k4 = f(t + h, y + step * k3)
    return y + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def steps_within(duration: float, longest: float) -> int:
    """The least number of equal steps, each of at most `longest` s, that make up `duration` s.

    >>> steps_within(0.1, 0.05), steps_within(0.1, 0.04)
    (2, 3)
    """
    return max(1, math.ceil(duration / longest - 1e-9))


def _column(h: Duration) -> Duration:
    return h[:, None] if isinstance(h, Tensor) else h


INTEGRATORS: dict[str, Callable[[Derivative, Tensor, Tensor, Duration], Tensor]] = {
    "euler": euler,
    "midpoint": midpoint,
    "rk3": rk3,
    "rk4": rk4,
}

"""Fixed-step integrators of dy/dt = f(t, y). Hairer, Norsett and Wanner (1993), Solving ODEs I, section II.1."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

Derivative = Callable[[Tensor, Tensor], Tensor]


def euler(f: Derivative, t: Tensor, y: Tensor, h: float) -> Tensor:
    """Explicit Euler, first order."""
    return y + h * f(t, y)


def midpoint(f: Derivative, t: Tensor, y: Tensor, h: float) -> Tensor:
    """Explicit midpoint rule (Runge 1895), second order."""
    return y + h * f(t + h / 2, y + h / 2 * f(t, y))


def rk4(f: Derivative, t: Tensor, y: Tensor, h: float) -> Tensor:
    """The classical Runge-Kutta method (Kutta 1901), fourth order."""
    k1 = f(t, y)
    k2 = f(t + h / 2, y + h / 2 * k1)
    k3 = f(t + h / 2, y + h / 2 * k2)
    k4 = f(t + h, y + h * k3)
    return y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


INTEGRATORS: dict[str, Callable[[Derivative, Tensor, Tensor, float], Tensor]] = {
    "euler": euler,
    "midpoint": midpoint,
    "rk4": rk4,
}

"""The longest step in which Runge-Kutta follows a system."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from visadapt.systems.base import Parameters, System, parameters
from visadapt.systems.contract import inputs

LARGEST_PRODUCT = 1.2
"""Largest product of step and rate. A motion that decays at that rate is then followed within 1 % of its size; beyond a
product of 2.8 the classical Runge-Kutta method is unstable (Hairer and Wanner 1996, Solving ODEs II, section IV.2)."""

SPARE = 1.25
"""How much faster than with its default parameters a system may be in the step that its class states."""

STATE_STEP = 1e-6  # Difference of a state, in its unit

Load = Callable[[Tensor], Tensor]
"""States (B, n_state) to loads (B, n_load)."""


def longest_step(system: System, load: Load | None = None) -> float:
    """s, the longest Runge-Kutta step for a system, under a load that follows its states.

    The class states a step for its default parameters; where this system is faster, the step is shorter in proportion.
    Where the class states none, it follows from the eigenvalues of the derivative by the state, in states drawn from
    their ranges.

    >>> import visadapt as va
    >>> longest_step(va.Quadrotor()), longest_step(va.Quadrotor(roll_gain=83.0))
    (0.07, 0.014)
    """
    stated = system.longest_step
    rate = _own_rate(type(system), parameters(system)) if load is None else _fastest_rate(system, load)
    if stated is None:
        return LARGEST_PRODUCT / rate if rate > 0 else math.inf
    usual = _own_rate(type(system), parameters(type(system)()))
    return stated if rate <= SPARE * usual else stated * usual / rate


@lru_cache(256)
def _own_rate(kind: type[System], values: Parameters) -> float:
    return _fastest_rate(kind(**dict(values)), None)


def _fastest_rate(system: System, load: Load | None) -> float:
    """1/s, the largest eigenvalue's magnitude, in the median over states; 0 where it cannot be computed."""
    try:
        state, command, acting = inputs(system)
        count, n = state.shape
        # By differences: tensors made in inference mode, as a diagnosis makes them, have no gradient.
        steps = torch.cat((torch.eye(n), -torch.eye(n))).to(state) * STATE_STEP
        moved = (state + steps[:, None]).flatten(0, 1)
        whole = acting.repeat(2 * n, 1)
        rates = system.derivative(moved, command.repeat(2 * n, 1), whole if load is None else whole + load(moved))
        above, below = rates.detach().reshape(2, n, count, n)
        by_state = ((above - below) / (2 * STATE_STEP)).movedim(0, -1)
        if not bool(by_state.isfinite().all()):
            return 0.0  # LAPACK crashes on numbers that are not finite
        fastest = float(torch.linalg.eigvals(by_state).abs().amax(1).median())
    except Exception:  # of the user's derivative: `contract.complaints` says what
        return 0.0
    return fastest if math.isfinite(fastest) else 0.0

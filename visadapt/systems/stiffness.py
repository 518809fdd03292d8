"""The longest step in which Runge-Kutta follows a system's own dynamics."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import torch

from visadapt.systems.base import System
from visadapt.systems.contract import inputs

LARGEST_PRODUCT = 1.2
"""Largest product of step and rate. A motion that decays at that rate is then followed within 1 % of its size; beyond a
product of 2.8 the classical Runge-Kutta method is unstable (Hairer and Wanner 1996, Solving ODEs II, section IV.2)."""


@cache
def longest_step(system: type[System]) -> float:
    """s, the longest Runge-Kutta step for a system: what its class states, or by its eigenvalues.

    These are of the derivative by the state, with the default parameters, in states drawn from their ranges.

    >>> import visadapt as va
    >>> longest_step(va.Quadrotor)
    0.07
    """
    if system.longest_step is not None:
        return system.longest_step
    try:
        own: Any = system()
        state, command, load = inputs(own)
        with torch.inference_mode(False), torch.enable_grad():
            tracked = state.clone().requires_grad_()
            rates = own.derivative(tracked, command.clone(), load.clone())
            rows = [torch.autograd.grad(rate.sum(), tracked, retain_graph=True)[0] for rate in rates.unbind(-1)]
        fastest = float(torch.linalg.eigvals(torch.stack(rows, 1)).abs().amax(1).median())
    except Exception:  # of the user's derivative: `contract.complaints` says what
        return math.inf
    return LARGEST_PRODUCT / fastest if fastest > 0 else math.inf

import math

import pytest
import torch

from visadapt.systems.integrators import INTEGRATORS

ORDERS = {"euler": 1, "midpoint": 2, "rk3": 3, "rk4": 4}


def test_every_integrator_has_a_known_order():
    assert INTEGRATORS.keys() == ORDERS.keys()


@pytest.mark.parametrize("name", INTEGRATORS)
def test_halving_the_step_divides_the_error_as_the_order_says(name):
    # dy/dt = y cos t, y(0) = 1 depends on the time and the state, and has the solution exp(sin t).
    def error(steps):
        t, y = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
        h = 2.0 / steps
        for _ in range(steps):
            y = INTEGRATORS[name](lambda t, y: y * t.cos(), t, y, h)
            t = t + h
        return abs(float(y) - math.exp(math.sin(2.0)))

    orders = [math.log2(error(steps) / error(2 * steps)) for steps in (64, 128)]
    assert orders == pytest.approx([ORDERS[name]] * 2, abs=0.15)

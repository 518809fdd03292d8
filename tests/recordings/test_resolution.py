"""The step of a sensor, from what it read."""

import math

import numpy as np
import pytest

from visadapt.recordings.resolution import smallest_step

COUNT = 2 * math.pi / 4096  # rad, of an encoder
TIME = 0.01 * np.arange(300)
SWINGS = 0.3 * np.sin(5 * TIME)
ONE_WAY = 30 * TIME + 0.3 * np.sin(10 * TIME)
"""rad; no two readings are closer than 0.25"""


@pytest.mark.parametrize("angle", [SWINGS, ONE_WAY])
@pytest.mark.parametrize("step", [COUNT, 2 * math.pi / 20])
def test_the_step_of_an_encoder_is_found(angle, step):
    read = np.round(np.round(angle / step) * step, 6)
    assert smallest_step(read) == pytest.approx(step, rel=1e-3)


def test_noise_shows_no_step_however_far_apart_the_readings_are():
    read = ONE_WAY + 1e-3 * np.random.default_rng(0).normal(size=len(TIME))
    assert smallest_step(read) < 1e-3


def test_of_equal_readings_it_is_zero():
    assert smallest_step(np.ones(30)) == 0.0

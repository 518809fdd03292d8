"""Causes beside a vibration that no effect of the catalogue describes."""

import pytest

from tests.diagnosed import record
from visadapt import diagnose
from visadapt.effects import ActuatorGain, PeriodicForce, ViscousFriction
from visadapt.systems import CartPole
from visadapt.world import World

EVERY_STATE = ("x", "x_dot", "theta", "theta_dot")


def test_friction_is_found_with_its_size_beside_a_vibration():
    """Fitted with white noise, its coefficient is 1.81 N s/m, and said to be 1.72 to 1.91."""
    effects = [ViscousFriction(coefficient=2.0), PeriodicForce(amplitude=4.0, frequency=3.3, phase=0.3, offset=0.0)]
    recording = record(effects, rows=150, seed=2, measured=EVERY_STATE, noise=(0.001,) * 4)
    found = diagnose(recording, World(CartPole()), catalogue=[ViscousFriction, ActuatorGain])
    assert found.verdict == "unexplained"
    assert [cause.effect for cause in found.partial] == ["viscous_friction"]
    coefficient = found.partial[0].parameters["coefficient"]
    assert coefficient.value == pytest.approx(2.0, rel=0.01)
    assert coefficient.ci90[0] < 2.0 < coefficient.ci90[1]

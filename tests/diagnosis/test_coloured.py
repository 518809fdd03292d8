"""Causes beside a vibration that no effect of the catalogue describes."""

from dataclasses import replace

import pytest

from tests.diagnosed import record
from visadapt import diagnose
from visadapt.diagnosis.search.coloured import colour_left_by
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.words import LASTING
from visadapt.effects import ActuatorGain, CoulombFriction, PeriodicForce, ViscousFriction
from visadapt.estimation.candidate import CandidateModel
from visadapt.estimation.fitting import fit
from visadapt.systems import CartPole
from visadapt.world import World

EVERY_STATE = ("x", "x_dot", "theta", "theta_dot")


def test_friction_is_found_with_its_size_beside_a_vibration():
    """Fitted with white noise, its coefficient is 1.81 N s/m, and said to be 1.72 to 1.91."""
    effects = [ViscousFriction(coefficient=2.0), PeriodicForce(amplitude=4.0, frequency=3.3, phase=0.3, offset=0.0)]
    recording = record(effects, rows=150, seed=2, measured=EVERY_STATE, noise=(0.001,) * 4)
    found = diagnose(recording, World(CartPole()), catalogue=[ViscousFriction, ActuatorGain])
    assert found.verdict == "unexplained"
    assert not any(one.startswith(LASTING) for one in found.warnings)  # a vibration is no error of readings
    assert [cause.effect for cause in found.partial] == ["viscous_friction"]
    coefficient = found.partial[0].parameters["coefficient"]
    assert coefficient.value == pytest.approx(2.0, rel=0.01)
    assert coefficient.ci90[0] < 2.0 < coefficient.ci90[1]


def test_dry_friction_feels_the_vibration_that_carries_the_cart_past_the_turns():
    """In a model without it the cart would stick at every turn; so fitted, its friction is 1.72 N."""
    effects = [CoulombFriction(force=2.0), PeriodicForce(amplitude=4.0, frequency=3.3, phase=0.3, offset=0.0)]
    recording = record(effects, rows=120, seed=1, measured=EVERY_STATE, noise=(0.001,) * 4)
    search = Search(CartPole(), prepare(recording, CartPole()).rows, [CoulombFriction])
    white = search.single(CoulombFriction)
    rows = replace(search.rows, colour=colour_left_by(search, white))
    coloured = fit([CandidateModel(CartPole(), [CoulombFriction], rows)], white.fits, 12)
    assert float(coloured.theta) == pytest.approx(2.0, rel=0.1)

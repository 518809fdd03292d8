"""Single effects so large that process noise stands for most of what they do, and ones that explain all."""

import pytest

from tests.diagnosed import record
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import CartMass, CoulombFriction, MeasurementDelay, QuadraticDrag, ViscousFriction
from visadapt.systems import CartPole


def test_a_delay_of_more_than_a_period_is_found_from_below_one():
    hidden = MeasurementDelay(delay=0.08)
    recording = record(
        [hidden], episodes=6, rows=30, measured=[state.name for state in CartPole.states], noise=(1e-4,) * 4
    )
    search = Search(CartPole(), prepare(recording, CartPole()).rows, [MeasurementDelay])
    (found,) = search.fit_singles()
    assert found.fits.theta.item() == pytest.approx(0.08, rel=1e-3), "with process noise it ends at 0.045"


def test_where_one_effect_explains_all_only_sets_with_it_grow():
    recording = record([ViscousFriction(coefficient=4.0)], measured=[state.name for state in CartPole.states])
    rows = prepare(recording, CartPole()).rows
    search = Search(CartPole(), rows, [CartMass, CoulombFriction, QuadraticDrag, ViscousFriction])
    search.run()
    assert search.best.names == ("viscous_friction",)
    assert search.explains_all(search.best)
    assert not search.explains_all(search.single(QuadraticDrag))
    assert all("viscous_friction" in names for names in search.fitted if len(names) > 1)

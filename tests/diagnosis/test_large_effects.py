"""Single effects so large that process noise stands for most of what they do, and ones that explain all."""

import math

import pytest

import visadapt as va
from tests.creep import Creep
from tests.diagnosed import record
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.diagnosis.verdict import CLOSES_BUT
from visadapt.effects import (
    CartMass,
    CoulombFriction,
    MeasurementDelay,
    QuadraticDrag,
    StribeckFriction,
    ViscousFriction,
)
from visadapt.estimation.fit_states import QUICK, with_effect
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


def test_an_effect_that_does_what_a_simpler_one_does_is_exchanged_for_it():
    recording = record([CoulombFriction(force=2.0)], measured=[state.name for state in CartPole.states])
    search = Search(CartPole(), prepare(recording, CartPole()).rows, [CoulombFriction, StribeckFriction])
    (stribeck,) = search.fit([((StribeckFriction,), with_effect(search.source.fits, [2.0, 1.0, 0.5]))], QUICK)
    assert stribeck.log_odds == -math.inf, "its breakaway is below its force, so it is dry friction"
    assert search.best is search.source
    search.exchange_in_rejected()
    assert search.best.names == ("coulomb_friction",)
    assert search.best.fits.theta.item() == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_what_nearly_describes_a_large_effect_is_named_with_a_warning_whatever_the_noise(noise, only_effects):
    only_effects("coulomb_friction", "viscous_friction", "actuator_gain")
    states = [state.name for state in CartPole.states]
    recording = record([Creep(0.01)], episodes=4, rows=150, measured=states, noise=(noise,) * 4)
    found = va.diagnose(recording, va.World(CartPole()))
    assert found.verdict == "identified"
    assert (found.gap.after > 3 * found.gap.floor) == (noise == 1e-3)
    (friction,) = (cause for cause in found.causes if not cause.slight)
    assert friction.effect == "coulomb_friction"
    assert friction.parameters["force"].value == pytest.approx(3.0, rel=0.05)
    assert any(warning.startswith(CLOSES_BUT) for warning in found.warnings)

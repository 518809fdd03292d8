"""Single effects so large that process noise stands for most of what they do, where a fit begins."""

import pytest

from tests.diagnosed import record
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import MeasurementDelay
from visadapt.systems import CartPole


def test_a_delay_of_more_than_a_period_is_found_from_below_one():
    hidden = MeasurementDelay(delay=0.08)
    recording = record(
        [hidden], episodes=6, rows=30, measured=[state.name for state in CartPole.states], noise=(1e-4,) * 4
    )
    search = Search(CartPole(), prepare(recording, CartPole()).rows, [MeasurementDelay])
    (found,) = search.fit_singles()
    assert found.fits.theta.item() == pytest.approx(0.08, rel=1e-3), "with process noise it ends at 0.045"

"""Which effects the screening proposes, and with which parameters, where an effect is not proportional to them."""

import pytest

from tests.diagnosed import record
from visadapt.diagnosis.search.preparation import prepare
from visadapt.diagnosis.search.search import Search
from visadapt.effects import EFFECTS
from visadapt.estimation.screening import screen
from visadapt.systems import CartPole

SYSTEM = CartPole()


def screened(effect, value):
    """The value that is proposed for the one strength of an effect that is hidden with `value`."""
    recording = record([effect(**{effect.table[0].name: value})])
    search = Search(SYSTEM, prepare(recording, SYSTEM).rows, ())
    return screen(SYSTEM, (), search.source.fits, search.rows, [effect])[0].values[0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("actuator_saturation", 0.17),
        ("actuator_deadzone", 0.055),
        ("actuator_backlash", 0.035),
        ("actuator_lag", 0.035),
        ("cart_mass", 1.3),
        ("track_tilt", 0.02),
        ("coulomb_friction", 0.6),
    ],
)
def test_a_strength_between_the_points_of_its_grid_is_found(name, value):
    assert screened(EFFECTS[name], value) == pytest.approx(value, rel=0.06)


def test_a_limit_that_only_the_largest_commands_reach_is_found():
    largest = max(float(abs(episode.action).max()) for episode in record().episodes)
    limit = 0.85 * largest
    assert screened(EFFECTS["actuator_saturation"], limit) == pytest.approx(limit, rel=0.06)

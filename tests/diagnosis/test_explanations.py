"""The explanations of an ambiguous diagnosis."""

import math

import pytest

from visadapt.diagnosis.explanations import explanations
from visadapt.diagnosis.result import Cause

DRAG, RUB, SLIDE, PUSH = "quadratic_drag", "viscous_friction", "coulomb_friction", "constant_force"


def cause(effect, *alternatives):
    return Cause(effect, {}, 0.5, math.nan, indistinguishable_from=alternatives)


ONE_OR_TWO = (cause(DRAG, RUB, SLIDE), cause(RUB, DRAG), cause(SLIDE, DRAG))


@pytest.mark.parametrize(
    ("causes", "sets"),
    [
        ((cause(DRAG),), [{DRAG}]),
        ((cause(DRAG, RUB), cause(RUB, DRAG)), [{DRAG}, {RUB}]),
        ((cause(PUSH), cause(DRAG, RUB), cause(RUB, DRAG)), [{PUSH, DRAG}, {PUSH, RUB}]),
        (ONE_OR_TWO, [{DRAG}, {RUB, SLIDE}]),
        (ONE_OR_TWO[1:] + ONE_OR_TWO[:1], [{RUB, SLIDE}, {DRAG}]),
        (
            (cause(DRAG, RUB, SLIDE, PUSH), cause(RUB, DRAG, PUSH), cause(SLIDE, DRAG), cause(PUSH, DRAG, RUB)),
            [{DRAG}, {RUB, SLIDE}, {PUSH, SLIDE}],
        ),
    ],
)
def test_a_cause_is_exchanged_for_what_fits_equally_well(causes, sets):
    assert [{one.effect for one in each} for each in explanations(causes)] == sets
